"""The first Newton steps from a state to N*, as one function: enough in a simulation."""

from collections.abc import Sequence

import casadi as ca

from drake_dae.dae.manifold.residual import Residual, shortest_step
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.newton import PRECISION, ROUNDING
from drake_dae.trace.round_off import positive

STEPS = 6
"""So many Newton steps are one function: one or two to N* from where a step of a simulation ends,
the others polish; one projection in a thousand takes more."""

STAYS, FOUND, NOT_FOUND = 0.0, 1.0, 2.0
"""What a projection's first steps lead to: the state itself, another one, or not yet to one."""

DOUBT = 0.03
"""Where a gradient, less its part along those before it, is this much shorter than usual it is
worth while to look whether they are nearly dependent."""


def trace_first_steps(residual: Residual) -> TracedFunction:
    """Where the first Newton steps from a state lead, all by the gradients there.

    First stand what `_followed` says and their lengths, in states over their scale; then where they
    lead, and the first step. They are doubted where gradients nearly depend on each other.
    """
    system, heads = residual.system, residual.layout.heads.tolist()
    usual = positive(residual.lengths)
    state, p, scale = system.state, system.parameter_symbol, ca.SX(residual.scale)
    # The steps hold them often: what is common goes once, and not from all of it.
    left, gradient = ca.cse([residual.expression, residual.gradient])
    function = ca.Function("residual", [state, p], [left], {"cse": False})
    (step_for, pivots), steps = shortest_step(gradient, scale), []
    for _ in range(STEPS):
        steps.append(scale * step_for(function(state, p)))
        state += steps[-1]
    start = system.state
    unit = ca.fmax(scale, ca.fabs(start))
    lengths = [ca.norm_2(step / scale) for step in steps]
    sizes = [ca.norm_2(step / unit) for step in steps[:2]]
    found, outcome = _followed(start, steps, lengths, *sizes)
    outputs = {"sizes": ca.vertcat(outcome, *lengths), "found": found, "step": steps[0]}
    # For next to nothing, like the sines, which are looked at where this fails.
    doubt = ca.mmin(ca.vertcat(1, *[ca.fabs(pivots[i]) / usual[i] for i in heads])) - DOUBT
    return system.trace("projection onto the manifold", outputs, doubt=doubt, lean=True)


def _followed(
    start: ca.SX, steps: Sequence[ca.SX], lengths: Sequence[ca.SX], size: ca.SX, left: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """What `newton` finds from a start by these first steps, and STAYS, FOUND or NOT_FOUND.

    Args:
        start: The state, shape (n, 1).
        steps: The Newton steps that follow each other from there.
        lengths: Their lengths, in states over their scale.
        size, left: The sizes of the first two, relative to the state.
    """
    # Newton's method ends at the start, or after its first step; then it is polished.
    at_start = size <= ROUNDING
    after_one = ca.logic_and(ca.logic_not(at_start), left * left <= PRECISION * size)
    goes_on = ca.logic_and(at_start, lengths[0] > 0)
    found = start + ca.if_else(ca.logic_or(after_one, goes_on), steps[0], 0)
    for number in range(1, len(steps)):
        shorter = ca.logic_and(goes_on, lengths[number] < 0.5 * lengths[number - 1])
        goes_on = shorter if number > 1 else ca.logic_or(after_one, shorter)
        goes_on = ca.logic_and(goes_on, lengths[number] > 0)
        found += ca.if_else(goes_on, steps[number], 0)
    ends = ca.logic_and(ca.logic_or(at_start, after_one), ca.logic_not(goes_on))
    # What is at the start and has no length may be there, or nowhere.
    moves = ca.logic_or(after_one, lengths[0] > 0)
    outcome = ca.if_else(ca.logic_and(ends, moves), FOUND, NOT_FOUND)
    stays = ca.logic_and(lengths[0] > 0, lengths[0] <= ROUNDING)
    return found, ca.if_else(stays, STAYS, outcome)
