"""What is found of a system: its degrees, the assumption that it violates, all findings."""

import casadi as ca
import pytest

from drake_dae.analysis import Analysis, Finding
from drake_dae.dae import DaeSystem, find_structure
from drake_dae.errors import AssumptionError


def degrees(system: DaeSystem, **options) -> tuple[tuple[int, ...], tuple[int, ...]]:
    structure = find_structure(system, **options)
    return structure.constraint_degrees, structure.output_degrees


def violation(system: DaeSystem, **options) -> AssumptionError:
    with pytest.raises(AssumptionError) as caught:
        find_structure(system, **options)
    return caught.value


def untidy_one(x: ca.SX) -> ca.SX:
    """1, but CasADi does not see it, and it is off by round-off."""
    return ca.exp(x) * ca.exp(-x)


def findings(analysis: Analysis) -> list[Finding]:
    return [assumption.finding for assumption in analysis.assumptions]


YES, NO = Finding.SATISFIED, Finding.VIOLATED
