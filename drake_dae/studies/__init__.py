"""Many runs of one scenario: what varies, processes, tables."""

from drake_dae.studies.study import Study as Study
from drake_dae.studies.sweep import sweep as sweep
from drake_dae.studies.variations import make_variations as make_variations
