"""The command `drake-dae`, as `python -m drake_dae`."""

import sys

from drake_dae.cli import main

sys.exit(main())
