"""Systems with known answers, and helpers that the tests of drake_dae.dae share.

Every problem is worked out by hand: degrees, A, alpha, beta, a and B are written in NumPy, from the
derivation in its docstring, and share no code with the library.
"""

from collections.abc import Callable
from functools import cache

from problems.closed_loop import closed_loop_outputs, integrated, reference_at, wanted_outputs
from problems.hidden import Hidden, hidden_normal_form
from problems.made_up import (
    bead,
    changed,
    double_integrator,
    early_control,
    held_point,
    in_other_units,
    linear,
    mixed_degrees,
    pushed_mass,
    redundant,
    system_of,
    third_order,
)
from problems.mechanisms import (
    aircraft,
    gantry,
    hanging_pendulum,
    pendulum,
    pendulum_known,
    pendulum_tension,
    two_link_arm,
)
from problems.nonholonomic import knife_edge, knife_edge_force
from problems.problem import Array, Known, Problem, known, unconstrained

__all__ = [
    "PROBLEMS",
    "Array",
    "Hidden",
    "Known",
    "Problem",
    "bead",
    "changed",
    "closed_loop_outputs",
    "double_integrator",
    "early_control",
    "hanging_pendulum",
    "hidden_normal_form",
    "in_other_units",
    "integrated",
    "knife_edge",
    "known",
    "linear",
    "pendulum",
    "pendulum_known",
    "pendulum_tension",
    "pushed_mass",
    "redundant",
    "reference_at",
    "system_of",
    "unconstrained",
    "wanted_outputs",
]

PROBLEMS: dict[str, Callable[[], Problem]] = {
    function.__name__: cache(function)
    for function in (
        pendulum,
        pendulum_tension,
        two_link_arm,
        linear,
        third_order,
        mixed_degrees,
        knife_edge,
        knife_edge_force,
        aircraft,
        gantry,
        held_point,
    )
}
