"""Stability of the zero dynamics along a reference: Floquet multipliers, and exponents.   (35)"""

from dataclasses import dataclass, field

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
        reason: The reason for the verdict, in words.
        period: The period of the reference in s, or of the motion if that is a multiple of it; None
            without a period, 0 if the reference is constant.
        multipliers: The Floquet multipliers of the periodic motion, the largest first, shape
            (dimension,); empty if there is no such motion.
        exponents: The rates at which disturbances grow, in 1/s, the largest first: log |multiplier|
            per period, or of the singular values of the transition matrix over the second half
            of the time, shape (dimension,); empty if the motion ends. If the reference is constant
            the real parts of the eigenvalues at rest.
        state: The start of the periodic motion, shape (n,); None without one.
    """

    verdict: Verdict
    reason: str
    period: float | None = None
    multipliers: ComplexArray = field(default_factory=lambda: np.zeros(0, dtype=complex))
    exponents: FloatArray = field(default_factory=lambda: np.zeros(0))
    state: FloatArray | None = None


def judge_along(
    flow: DisturbanceFlow, motion: PinnedMotion, period: float | None
) -> StabilityAlong:
    """Judges whether disturbances of a motion with pinned outputs grow.

    Args:
        flow: Along the reference.
        motion: The motion on it.
        period: The period of the reference; None if it has none.
    """
    if motion.ending is not None:
        unbounded = motion.ending.cause is EndCause.UNBOUNDED
        verdict = Verdict.UNSTABLE if unbounded else Verdict.UNDECIDED
        return StabilityAlong(verdict, f"the motion ends: {motion.ending}", period)
    if motion.times.size < 2:
        reason = "one time alone is no motion; give more times"
        return StabilityAlong(Verdict.UNDECIDED, reason, period)
    if period is not None:
        # Late, when decaying disturbances are gone; or early, when growing ones are still small.
        late = int(np.flatnonzero(motion.times <= motion.times[-1] - period)[-1])
        closed = None
        for first in dict.fromkeys((late, 0)):
            begin = float(motion.times[first])
            closed = close(flow, motion.states[first], begin, period, patient=True)
            if closed is not None:
                break
        if closed is None or closed.repels:
            # The motion itself may have a period of several periods of the reference.
            begin_late = float(motion.times[late])
            repeating = flow.repeating(begin_late, period)
            several = find_multiple(repeating, motion.states[late], begin_late, period)
            if several is not None:
                return _by_multipliers(repeating, several, begin_late)
        if closed is not None:
            return _by_multipliers(flow, closed, begin)
    return _by_exponents(flow, motion, period)


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
        verdict, reason = course.verdict_on_unstable(reason)
    else:
        count = np.count_nonzero(np.abs(sizes - 1.0) <= errors)
        verdict = Verdict.UNDECIDED
        reason = (
            f"{count} of {sizes.size} Floquet multipliers are on the unit circle, up to the error "
            f"of integration, over {period:.6g} s"
        )
    return StabilityAlong(verdict, reason, period, values, exponents, closed.state)


def _by_exponents(
    flow: DisturbanceFlow, motion: PinnedMotion, period: float | None
) -> StabilityAlong:
    """Judges by the growth of disturbances over the second half of the time."""
    middle = int(np.searchsorted(motion.times, 0.5 * (motion.times[0] + motion.times[-1])))
    middle = min(middle, motion.times.size - 2)
    begin, end = float(motion.times[middle]), float(motion.times[-1])
    try:
        passage, halves = carry_in_halves(flow, motion.states[middle], begin, end)
    except MotionLost as lost:
        verdict = Verdict.UNSTABLE if lost.cause is EndCause.UNBOUNDED else Verdict.UNDECIDED
        reason = f"from x = {show(motion.states[middle])}: {lost}"
        return StabilityAlong(verdict, reason, period)
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
    return StabilityAlong(verdict, reason, period, exponents=exponents)
