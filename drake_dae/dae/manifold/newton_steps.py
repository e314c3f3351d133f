"""The first Newton steps from a state to N* as one function. A simulation rarely needs more."""

from collections.abc import Callable, Sequence

import casadi as ca

from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import DerivativeLayout
from drake_dae.dae.system import DaeSystem
from drake_dae.trace.factorization import PositiveDefiniteFactorization
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.newton import PRECISION, ROUNDING

NEWTON_STEPS = 6
"""The number of Newton steps in the function. One or two lead from the end of a simulation step to
N*, the others reduce the error to round-off. One projection in a thousand takes more."""

STAYS, FOUND, NOT_FOUND = 0.0, 1.0, 2.0
"""The outcome of the first steps: the state is already consistent, they converged to a consistent
state, or they did not converge."""

DOUBT = 0.03
"""Gradients are checked for near dependence if the part of one that is orthogonal to those before
it is shorter than usual by this factor."""


def trace_first_steps(
    system: DaeSystem,
    layout: DerivativeLayout,
    residual: ca.SX,
    gradient: ca.SX,
    usual: FloatArray,
) -> TracedFunction:
    """Traces the first Newton steps from a state, all with the gradients at that state.

    The outputs are the outcome of `_followed` and the lengths of the steps (in states over their
    scale), the state that they reach, and the first step. The result is not valid where gradients
    are nearly dependent, by their usual lengths.
    """
    heads = layout.heads.tolist()
    state, p, scale = system.state, system.parameter_symbol, ca.SX(system.scale)
    # The steps hold them often: common subexpressions are removed once here, not from the whole.
    expression, gradient = ca.cse([residual, gradient])
    function = ca.Function("residual", [state, p], [expression], {"cse": False})
    (step_for, pivots), steps = shortest_step(gradient, scale), []
    for _ in range(NEWTON_STEPS):
        steps.append(scale * step_for(function(state, p)))
        state += steps[-1]
    start = system.state
    unit = ca.fmax(scale, ca.fabs(start))
    lengths = [ca.norm_2(step / scale) for step in steps]
    sizes = [ca.norm_2(step / unit) for step in steps[:2]]
    moved, outcome = _followed(start, steps, lengths, *sizes)
    outputs = {"sizes": ca.vertcat(outcome, *lengths), "found": moved, "step": steps[0]}
    # A cheap test in place of the sines, which are computed only where this one fails.
    doubt = ca.mmin(ca.vertcat(1, *[ca.fabs(pivots[i]) / usual[i] for i in heads])) - DOUBT
    return system.trace("projection onto the manifold", outputs, doubt=doubt, lean=True)


def _followed(
    start: ca.SX, steps: Sequence[ca.SX], lengths: Sequence[ca.SX], size: ca.SX, left: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Returns the state that `newton` reaches by these first steps, and the outcome."""
    # Newton's method ends at the start, or after its first step; then it is polished.
    at_start = size <= ROUNDING
    after_one = ca.logic_and(ca.logic_not(at_start), left * left <= PRECISION * size)
    goes_on = ca.logic_and(at_start, lengths[0] > 0)
    moved = start + ca.if_else(ca.logic_or(after_one, goes_on), steps[0], 0)
    for number in range(1, len(steps)):
        shorter = ca.logic_and(goes_on, lengths[number] < 0.5 * lengths[number - 1])
        goes_on = shorter if number > 1 else ca.logic_or(after_one, shorter)
        goes_on = ca.logic_and(goes_on, lengths[number] > 0)
        moved += ca.if_else(goes_on, steps[number], 0)
    ends = ca.logic_and(ca.logic_or(at_start, after_one), ca.logic_not(goes_on))
    # A first step of length zero does not tell whether the start is consistent.
    moves = ca.logic_or(after_one, lengths[0] > 0)
    outcome = ca.if_else(ca.logic_and(ends, moves), FOUND, NOT_FOUND)
    stays = ca.logic_and(lengths[0] > 0, lengths[0] <= ROUNDING)
    return moved, ca.if_else(stays, STAYS, outcome)


def shortest_step(
    gradient: ca.SX, scale: ca.SX
) -> tuple[Callable[[ca.SX], ca.SX], Sequence[ca.SX]]:
    """residual -> the shortest dz with C S dz = -residual, where dx = S dz and S is the scale.

    It is -(C S)' N^-1 residual with N = C S (C S)', each row by its largest entry. An error of N^-1
    grows with the square of the condition of C, and only makes Newton's method slower. The lengths
    of the parts of the gradients that are orthogonal to those before are returned as well.
    """
    if not gradient.shape[0]:
        return (lambda residual: ca.SX(gradient.shape[1], 1)), ()
    scaled = ca.mtimes(gradient, ca.diag(scale))
    # By their largest entries: the squares of entries may be too large for a number.
    largest = [ca.norm_inf(row) for row in ca.vertsplit(scaled)]
    sizes = ca.vertcat(*[ca.if_else(size > 0, size, 1) for size in largest])
    scaled = ca.sparsify(scaled / ca.repmat(sizes, 1, scaled.shape[1]))
    normal = PositiveDefiniteFactorization(ca.mtimes(scaled, scaled.T))
    lengths = [size * length for size, length in zip(largest, normal.lengths, strict=True)]
    # CasADi lets the infinities of constant gradients cancel each other.
    regular = ca.if_else(normal.pivot > 0, 0, ca.SX.nan())
    return lambda residual: regular - ca.mtimes(scaled.T, normal.solve(residual / sizes)), lengths
