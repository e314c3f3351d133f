"""Stability of the zero dynamics along a reference: Floquet multipliers, and exponents.   (35)"""

from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.zero_dynamics.disturbances import DisturbanceFlow, MotionLost
from drake_dae.dae.zero_dynamics.long_term import Behavior, behavior_of, carry_in_halves, leave
from drake_dae.dae.zero_dynamics.pinned.pinned_motion import EndCause, PinnedMotion
from drake_dae.dae.zero_dynamics.returns import PeriodicMotion, close, find_multiple
from drake_dae.dae.zero_dynamics.stability import ComplexArray, Verdict


@dataclass(frozen=True, eq=False)
class StabilityAlong:
    """The stability of the internal states while the outputs follow a reference.

    Attributes:
        verdict: With a period: exponentially stable if all multipliers are inside the unit circle;
            unstable if one is outside; bounded if motions that leave converge to a periodic one;
            undecided if they converge to a motion that does not return, or if a multiplier is on
            the circle up to the error. Without a period: by the exponents of the disturbances over
            the second half of the time; undecided if they neither grow nor decay.
        period: The period of the reference in s, or of the motion if that is a multiple of it; None
            without a period, 0 if the reference is constant.
        multipliers: The Floquet multipliers of the periodic motion, the largest first, shape
            (dimension,); empty if there is no such motion.
        exponents: The rates at which disturbances grow, in 1/s, the largest first: log |multiplier|
            per period, or of the singular values of the transition matrix over the second half
            of the time, shape (dimension,); empty if the motion ends. If the reference is constant
            the real parts of the eigenvalues at rest.
        state: The start of the periodic motion, shape (n,); None without one.
        reason: The reason for the verdict, in words.
    """

    verdict: Verdict
    period: float | None
    multipliers: ComplexArray
    exponents: FloatArray
    state: FloatArray | None
    reason: str

    @classmethod
    def without_numbers(
        cls, verdict: Verdict, reason: str, period: float | None = None
    ) -> "StabilityAlong":
        """A result without numbers."""
        return cls(verdict, period, np.zeros(0, dtype=complex), np.zeros(0), None, reason)


def judge_along(
    flow: DisturbanceFlow, motion: PinnedMotion, period: float | None
) -> StabilityAlong:
    """Whether disturbances of a motion with pinned outputs grow.

    Args:
        flow: Along the reference.
        motion: The motion on it.
        period: The period of the reference; None if it has none.
    """
    if motion.ending is not None:
        unbounded = motion.ending.cause is EndCause.UNBOUNDED
        verdict = Verdict.UNSTABLE if unbounded else Verdict.UNDECIDED
        return StabilityAlong.without_numbers(verdict, f"the motion ends: {motion.ending}", period)
    if motion.times.size < 2:
        reason = "one time alone is no motion; give more times"
        return StabilityAlong.without_numbers(Verdict.UNDECIDED, reason, period)
    if period is not None:
        # Late, when decaying disturbances are gone; or early, when growing ones are still small.
        late = int(np.flatnonzero(motion.times <= motion.times[-1] - period)[-1])
        starts = dict.fromkeys((late, 0))
        found = (_closed(flow, motion, first, period) for first in starts)
        closed = next((one for one in found if one is not None), None)
        if closed is None or closed[0].repels:
            # The motion itself may have a period of several periods of the reference.
            begin = float(motion.times[late])
            repeating = flow.repeating(begin, period)
            several = find_multiple(repeating, motion.states[late], begin, period)
            if several is not None:
                return _by_multipliers(repeating, several, begin)
        if closed is not None:
            return _by_multipliers(flow, *closed)
    return _by_exponents(flow, motion, period)


def _closed(
    flow: DisturbanceFlow, motion: PinnedMotion, first: int, period: float
) -> tuple[PeriodicMotion, float] | None:
    """The periodic motion near one of the states of a motion, and its start time."""
    begin = float(motion.times[first])
    found = close(flow, motion.states[first], begin, period, patient=True)
    return None if found is None else (found, begin)


def _by_multipliers(flow: DisturbanceFlow, closed: PeriodicMotion, begin: float) -> StabilityAlong:
    values, errors, period = closed.multipliers, closed.errors, closed.period
    sizes = np.abs(values)
    exponents = np.log(np.maximum(sizes, 1e-300)) / period
    largest = f"the largest Floquet multiplier is {sizes[0]:.4g} over {period:.6g} s"
    if closed.attracts:
        verdict, reason = Verdict.STABLE, largest
    elif closed.repels:
        verdict, reason = Verdict.UNSTABLE, f"small disturbances of the motion grow: {largest}"
        repeating, turning = flow.repeating(begin, period), 2.0 * np.pi / period
        rate = float(exponents[0])
        course = leave(repeating, closed.state, begin, rate, turning, period)
        verdict = {Behavior.CIRCLES: Verdict.BOUNDED, Behavior.WANDERS: Verdict.UNDECIDED}.get(
            course.behavior, verdict
        )
        if course.behavior not in (Behavior.UNCLEAR, Behavior.GROWS, Behavior.SPREADS):
            reason += f"; motions that leave it: {course}"
    else:
        count = np.count_nonzero(np.abs(sizes - 1.0) <= errors)
        verdict = Verdict.UNDECIDED
        reason = (
            f"{count} of {sizes.size} Floquet multipliers are on the unit circle, up to the error "
            f"of integration, over {period:.6g} s"
        )
    return StabilityAlong(verdict, period, values, exponents, closed.state, reason)


def _by_exponents(
    flow: DisturbanceFlow, motion: PinnedMotion, period: float | None
) -> StabilityAlong:
    """The growth of disturbances over the second half of the time."""
    middle = int(np.searchsorted(motion.times, 0.5 * (motion.times[0] + motion.times[-1])))
    middle = min(middle, motion.times.size - 2)
    begin, end = float(motion.times[middle]), float(motion.times[-1])
    try:
        passage, halves = carry_in_halves(flow, motion.states[middle], begin, end)
    except MotionLost as lost:
        verdict = Verdict.UNSTABLE if lost.cause is EndCause.UNBOUNDED else Verdict.UNDECIDED
        reason = f"from x = {show(motion.states[middle])}: {lost}"
        return StabilityAlong.without_numbers(verdict, reason, period)
    behavior = behavior_of(passage, *halves)
    verdict = {
        Behavior.SPREADS: Verdict.UNSTABLE,
        Behavior.SETTLES: Verdict.STABLE,
    }.get(behavior, Verdict.UNDECIDED)
    sizes = np.linalg.svd(passage.transition, compute_uv=False)
    exponents = (np.log(np.maximum(sizes, 1e-300)) + passage.growth) / (end - begin)
    reason = (
        f"from {begin:.6g} to {end:.6g} s disturbances of the motion change by a factor "
        f"{np.exp(min(passage.growth, 700.0)):.3g} at most, {exponents[0]:.3g} 1/s"
    )
    if behavior is Behavior.WANDERS:
        reason += f"; the motion {behavior.value}"
    elif verdict is Verdict.UNDECIDED:
        reason += "; that is too short to decide"
    none = np.zeros(0, dtype=complex)
    return StabilityAlong(verdict, period, none, exponents, None, reason)
