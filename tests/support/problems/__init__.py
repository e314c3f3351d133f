"""Systems with known answers, and helpers that the tests of drake_dae.dae share.

Every problem is worked out by hand: degrees, A, alpha, beta, a and B are written in NumPy, from the
derivation in its docstring, and share no code with the library.
"""

# ruff: noqa: F401

from collections.abc import Callable
from functools import cache

from problems.closed_loop import closed_loop_outputs, integrated, reference_at, wanted_outputs
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
