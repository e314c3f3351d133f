"""The long-term behavior of a motion with pinned outputs."""

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.zero_dynamics.disturbances import DisturbanceFlow, MotionLost, StateTransition
from drake_dae.dae.zero_dynamics.equilibria import Equilibria
from drake_dae.dae.zero_dynamics.pinned.pinned_motion import EndCause
from drake_dae.dae.zero_dynamics.returns import PeriodicMotion, find_multiple, find_return
from drake_dae.dae.zero_dynamics.stability import (
    Stability,
    Verdict,
    judge,
)
from drake_dae.errors import InconsistentStateError

FOLDINGS = 40.0
"""A motion is followed until its fastest disturbance could have grown by e to this power."""

BESIDE = 1e-3
"""The initial distance from an unstable motion, relative to the scale of the states."""

PATIENCE = 10.0
"""The factor by which the search for a return lasts longer than that for the growth of
disturbances."""

PLAIN = float(np.log(10.0))
"""Disturbances count as growing or decaying if the logarithm of their size changes by more than
this."""


LONGEST = 1500.0
"""The largest angle through which a motion is followed, in rad: some hundred turns."""

SLOWEST = 1e-4
"""Rates below this, relative to the fastest, are ignored."""


class Behavior(Enum):
    """The long-term behaviors of a motion; the enum value is a description."""

    GROWS = "grows without bound"
    SETTLES = "converges to another stable motion"
    CIRCLES = "converges to a limit cycle"
    LEAVES = "approaches an unstable periodic motion"
    WANDERS = "attracts nearby motions but did not return: it may drift"
    SPREADS = "is unstable: small disturbances grow exponentially"
    UNCLEAR = "was not followed long enough to decide"


VERDICTS = {
    Behavior.GROWS: Verdict.UNSTABLE,
    Behavior.LEAVES: Verdict.UNSTABLE,
    Behavior.CIRCLES: Verdict.BOUNDED,
    Behavior.WANDERS: Verdict.UNDECIDED,
}
"""The verdicts that follow from a long-term behavior."""


@dataclass(frozen=True, eq=False)
class LongTerm:
    """The long-term behavior of a motion, with its evidence.

    Attributes:
        behavior: The behavior.
        state: The last state; None if it is not known.
        closed: The periodic motion to which it converges; None without one.
    """

    behavior: Behavior
    state: FloatArray | None = None
    closed: PeriodicMotion | None = None

    def __str__(self) -> str:
        periodic = "" if self.closed is None else f" ({self.closed})"
        return self.behavior.value + periodic

    def verdict_on_unstable(self, reason: str) -> tuple[Verdict, str]:
        """Returns verdict and reason for an unstable motion that other motions leave in this way.

        Args:
            reason: Why the motion is unstable; the returned reason may add the behavior.
        """
        if self.behavior in (Behavior.UNCLEAR, Behavior.GROWS, Behavior.SPREADS):
            return Verdict.UNSTABLE, reason
        verdict = VERDICTS.get(self.behavior, Verdict.UNSTABLE)
        return verdict, f"{reason}; a motion that leaves it {self}"


def behavior_of(passage: StateTransition, *halves: StateTransition) -> Behavior:
    """Returns the behavior of a motion by the growth of its disturbances in a late interval.

    If a motion attracts its neighbours, disturbances decay in all directions. On a limit cycle,
    disturbances along the motion neither grow nor decay while volumes shrink; the same holds for a
    motion that drifts. Growth proportional to time, from neighbours with a slightly different
    speed, is not exponential: then the growth of the two halves adds up to much more than the
    whole.

    Args:
        passage: The interval.
        halves: Its two halves.
    """
    grows = passage.growth > 0.8 * sum(max(half.growth, 0.0) for half in halves)
    if passage.growth > PLAIN and grows:
        return Behavior.SPREADS
    if passage.growth < -PLAIN:
        return Behavior.SETTLES
    if abs(passage.growth) < 0.7 * PLAIN and passage.volume < -2.0 * PLAIN:
        return Behavior.WANDERS
    return Behavior.UNCLEAR


def watch(
    flow: DisturbanceFlow, state: FloatArray, begin: float, end: float, period: float | None = None
) -> LongTerm:
    """Returns the long-term behavior of the motion from a state.

    Args:
        flow: The flow of a reference that is defined at all times.
        state: The state, shape (n,).
        begin, end: The interval of observation, in s; the second half decides.
        period: The period of the reference; None if it is constant.
    """
    middle = 0.5 * (begin + end)
    try:
        later = flow.carry(state, begin, middle, disturbed=False).state
        passage, halves = carry_in_halves(flow, later, middle, end)
    except MotionLost as lost:
        return LongTerm(Behavior.GROWS if lost.cause is EndCause.UNBOUNDED else Behavior.UNCLEAR)
    behavior, last = behavior_of(passage, *halves), passage.state
    if behavior is not Behavior.WANDERS:
        return LongTerm(behavior, last)
    if period is None:
        closed = find_return(flow, last, PATIENCE * (end - begin))
    else:
        closed = find_multiple(flow, last, end, period)
    if closed is not None and closed.attracts:
        return LongTerm(Behavior.CIRCLES, closed.state, closed)
    if closed is not None and closed.repels:
        return LongTerm(Behavior.LEAVES, closed.state, closed)
    return LongTerm(behavior, last)


def carry_in_halves(
    flow: DisturbanceFlow, state: FloatArray, begin: float, end: float
) -> tuple[StateTransition, tuple[StateTransition, StateTransition]]:
    """Integrates over both halves of an interval, and combines them.

    Raises:
        MotionLost: The motion cannot be followed.
    """
    middle = 0.5 * (begin + end)
    first = flow.carry(state, begin, middle)
    second = flow.carry(first.state, middle, end)
    transition = second.transition @ first.transition
    size = max(float(np.linalg.norm(transition, 2)), 1e-300)
    whole = StateTransition(
        second.state,
        second.basis,
        transition / size,
        first.growth + second.growth + float(np.log(size)),
        first.volume + second.volume,
    )
    return whole, (first, second)


def watch_from(flow: DisturbanceFlow, state: FloatArray) -> LongTerm:
    """Returns the long-term behavior from a state that is not at rest, for constant R.

    The duration follows from the rates of its disturbances.
    """
    basis = flow.basis(state, 0.0) / flow.scale[:, None]
    slopes, _ = flow.pinned.slopes(state, flow.goal(0.0), flow.parameters(0.0))
    slopes = slopes * flow.scale / flow.scale[:, None]
    if not np.all(np.isfinite(slopes)):
        return LongTerm(Behavior.UNCLEAR)
    rates = np.abs(np.linalg.eigvals(basis.T @ slopes @ basis))
    rates = rates[rates > SLOWEST * np.linalg.norm(slopes, 2)]
    if not rates.size:
        return LongTerm(Behavior.UNCLEAR)
    return watch(flow, state, 0.0, FOLDINGS / float(rates.min()))


def leave(
    flow: DisturbanceFlow,
    state: FloatArray,
    time: float,
    rate: float,
    fastest: float,
    period: float | None = None,
) -> LongTerm:
    """Returns the long-term behavior of motions that start on both sides of an unstable motion.

    Args:
        flow: The flow of a reference that is defined at all times.
        state: A state of the unstable motion, shape (n,).
        time: The time of that state.
        rate: The largest exponent of its disturbances, in 1/s, positive.
        fastest: Its fastest frequency in rad/s; motions of too many turns are not followed.
        period: The period of the reference; None if it is constant.

    Returns:
        The worse behavior of both sides; a limit cycle only if both sides converge to one.
    """
    duration = FOLDINGS / rate
    if duration * fastest > LONGEST:
        return LongTerm(Behavior.UNCLEAR)
    basis = flow.basis(state, 0.0)
    aside = basis @ np.random.default_rng(0).standard_normal(basis.shape[1])
    aside *= BESIDE / np.max(np.abs(aside) / flow.scale)
    courses = []
    for side in (aside, -aside):
        try:
            start = flow.onto(state + side, time)
        except MotionLost:
            return LongTerm(Behavior.UNCLEAR)
        courses.append(watch(flow, start, time, time + duration, period))
        if courses[-1].behavior not in (Behavior.CIRCLES, Behavior.SETTLES, Behavior.WANDERS):
            return courses[-1]
    order = (Behavior.WANDERS, Behavior.SETTLES, Behavior.CIRCLES)
    return min(courses, key=lambda course: order.index(course.behavior))


def judge_at_rest(
    equilibria: Equilibria, goal: FloatArray, rest: FloatArray, parameters: FloatArray
) -> Stability:
    """Judges an equilibrium by eigenvalues; if unstable, also by the motions that leave it.

    Args:
        equilibria: The states at rest on Z(R).
        goal: R with constant outputs.
        rest: The equilibrium, shape (n,).
        parameters: Values of all parameters.
    """
    pinned, sizes = equilibria.pinned, equilibria.sizes
    values, errors, _ = equilibria.eigenvalues(goal, rest, parameters)
    place = f"at the equilibrium with {pinned.describe(goal)}"
    at_rest = judge(values, errors, rest, place)
    if at_rest.verdict is not Verdict.UNSTABLE:
        return at_rest
    flow = DisturbanceFlow(pinned, lambda time: goal, lambda time: parameters, sizes)
    course = leave(flow, rest, 0.0, float(values[0].real), float(np.max(np.abs(values.imag))))
    verdict, reason = course.verdict_on_unstable(at_rest.reason)
    return replace(at_rest, verdict=verdict, reason=reason)


def judge_without_rest(
    equilibria: Equilibria,
    goal: FloatArray,
    start: FloatArray,
    parameters: FloatArray,
    reason: str,
) -> Stability:
    """Judges by the motion from a state if no equilibrium is found near it.

    Args:
        equilibria: The states at rest on Z(R).
        goal: R with constant outputs.
        start: A state near Z(R), shape (n,).
        parameters: Values of all parameters.
        reason: Why there is no equilibrium.
    """
    pinned = equilibria.pinned
    flow = DisturbanceFlow(pinned, lambda time: goal, lambda time: parameters, equilibria.sizes)
    try:
        course = watch_from(flow, pinned.state(goal, start, parameters))
        if course.behavior is Behavior.SETTLES and course.state is not None:
            rest = equilibria.find(goal, course.state, parameters)
            return judge_at_rest(equilibria, goal, rest, parameters)
    except InconsistentStateError:
        return Stability(Verdict.UNDECIDED, reason)
    if course.behavior not in VERDICTS:
        return Stability(Verdict.UNDECIDED, reason)
    return Stability(VERDICTS[course.behavior], f"{reason}; the motion from there {course}")
