"""The first Newton steps from a state to N* as one function. A simulation rarely needs more."""

from collections.abc import Sequence

import casadi as ca

from drake_dae.dae.manifold.residual import Residual, shortest_step
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.newton import PRECISION, ROUNDING
from drake_dae.trace.round_off import positive

NEWTON_STEPS = 6
"""The number of Newton steps in the function. One or two lead from the end of a simulation step to
N*, the others reduce the error to round-off. One projection in a thousand takes more."""

STAYS, FOUND, NOT_FOUND = 0.0, 1.0, 2.0
"""The outcome of the first steps: the state is already consistent, they converged to a consistent
state, or they did not converge."""

DOUBT = 0.03
"""Gradients are checked for near dependence if the part of one that is orthogonal to those before
it is shorter than usual by this factor."""


def trace_first_steps(residual: Residual) -> TracedFunction:
    """Traces the first Newton steps from a state, all with the gradients at that state.

    The outputs are the outcome of `_followed` and the lengths of the steps (in states over their
    scale), the state that they reach, and the first step. The result is not valid where gradients
    are nearly dependent.
    """
    system, heads = residual.system, residual.layout.heads.tolist()
    usual = positive(residual.lengths)
    state, p, scale = system.state, system.parameter_symbol, ca.SX(residual.scale)
    # The steps hold them often: common subexpressions are removed once here, not from the whole.
    expression, gradient = ca.cse([residual.residual_expression, residual.short_gradient])
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
