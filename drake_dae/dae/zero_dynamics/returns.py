"""Periodic motions, which prove that a motion is bounded.

Decaying disturbances do not prove that a motion is bounded: those of x' = 1 do not grow, but x
does. A motion that returns to a state is periodic and so bounded. It attracts neighbouring motions
if all its multipliers, except that along the motion itself, are inside the unit circle.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.zero_dynamics.disturbances import DisturbanceFlow, MotionLost
from drake_dae.dae.zero_dynamics.stability import ComplexArray, eigenvalues_of

CLOSED = 1e-7
"""A motion is periodic if it returns to within this, relative to the scale of the states."""

CARRIED = 1e-6
"""The error of a transition matrix, relative to its norm."""

NEAR = 0.05
"""A motion is near its start within this fraction of its extent."""

MULTIPLES = 6
"""The multiples of the period of a reference that are tried for a periodic motion."""

LEAST = 1e-4
"""A motion of smaller extent than this, relative to the scale of the states, is at rest."""

NEWTON_STEPS = 12
"""The largest number of Newton steps."""

CROSSINGS = 6
"""The largest number of near returns that are tried."""


@dataclass(frozen=True, eq=False)
class PeriodicMotion:
    """A periodic motion.

    Attributes:
        state: Its start, shape (n,).
        period: Its period, in s.
        multipliers: The eigenvalues of the transition matrix of disturbances over the period, the
            largest first; for autonomous motions without the one that is 1 along the motion.
        errors: The error bound of each.
    """

    state: FloatArray
    period: float
    multipliers: ComplexArray
    errors: FloatArray

    @property
    def attracts(self) -> bool:
        """Whether it attracts neighbouring motions."""
        return bool(np.all(np.abs(self.multipliers) < 1.0 - self.errors))

    @property
    def repels(self) -> bool:
        """Whether some neighbouring motions leave it."""
        return bool(np.any(np.abs(self.multipliers) > 1.0 + self.errors))

    def __str__(self) -> str:
        text = f"period {self.period:.6g} s"
        if not self.multipliers.size:
            return text
        return f"{text}, largest multiplier {np.abs(self.multipliers[0]):.7g}"


def close(
    flow: DisturbanceFlow,
    state: FloatArray,
    begin: float,
    period: float,
    *,
    free: bool = False,
    patient: bool = False,
) -> PeriodicMotion | None:
    """Finds the periodic motion close to a state by Newton's method; None if there is none.

    Newton's method for the distance from the start after a period, along the tangent space.

    Args:
        flow: The flow of a reference that has the period, or is constant.
        state: The start, shape (n,).
        begin: The start time, in s.
        period: In s.
        free: Whether the period is unknown, as in autonomous systems.
        patient: Whether to continue if the distance does not decrease for some steps.
    """
    scale, before = flow.scale, np.inf
    for _ in range(NEWTON_STEPS):
        basis = flow.basis(state, begin)
        try:
            passage = flow.carry(state, begin, begin + period)
        except MotionLost:
            return None
        scaled = (basis / scale[:, None]).T
        with np.errstate(over="ignore"):
            monodromy = np.exp(passage.growth) * (
                scaled @ (passage.basis / scale[:, None]) @ passage.transition
            )
        if not np.all(np.isfinite(monodromy)):
            return None
        gap = scaled @ ((passage.state - state) / scale)
        missed = float(np.linalg.norm(gap))
        if not patient and missed > max(0.5 * before, CLOSED):
            return None  # For example if the motion drifts.
        matrix, right, before = monodromy - np.eye(gap.size), -gap, missed
        if free:
            # A little later, and not along the motion.
            rate = flow.pinned.rate(passage.state, flow.goal(begin), flow.parameters(begin))
            onward = scaled @ (rate / scale)
            size = float(np.linalg.norm(onward))
            if not size > 0.0:
                return None
            matrix = np.block(
                [[matrix, onward[:, None] / size], [onward[None] / size, np.zeros((1, 1))]]
            )
            right = np.append(right, 0.0)
        change = np.linalg.lstsq(matrix, right, rcond=CARRIED)[0]
        later = float(change[gap.size]) / size if free else 0.0
        step = basis @ change[: gap.size]
        if np.max(np.abs(step) / scale, initial=0.0) <= CLOSED and abs(later) <= CLOSED * period:
            off = np.max(np.abs(passage.state - state) / scale)
            if off > 1e3 * CLOSED * max(1.0, passage.growth):
                return None
            return _judged(state, period, monodromy, free)
        try:
            state, period = flow.onto(state + step, begin), period + later
        except MotionLost:
            return None
        if not period > 0.0:
            return None
    return None


def find_return(flow: DisturbanceFlow, state: FloatArray, duration: float) -> PeriodicMotion | None:
    """Finds the periodic motion on or close to a motion of an autonomous system.

    Candidates are crossings of a section, the plane normal to its rate, near the start.

    Args:
        flow: The flow of a constant reference.
        state: A state of the motion, shape (n,).
        duration: The longest time to follow, in s.
    """
    periods = islice(_near(flow, state, duration), CROSSINGS)
    motions = (close(flow, state, 0.0, period, free=True) for period in periods)
    return next((motion for motion in motions if motion is not None), None)


def find_multiple(
    flow: DisturbanceFlow, state: FloatArray, begin: float, period: float
) -> PeriodicMotion | None:
    """Finds an attracting motion near a state with a multiple of the reference's period."""
    motions = (close(flow, state, begin, count * period) for count in range(1, MULTIPLES + 1))
    return next((motion for motion in motions if motion is not None and motion.attracts), None)


def _near(flow: DisturbanceFlow, state: FloatArray, duration: float) -> Iterator[float]:
    """Generates the times of near returns through the section at a state, in the same direction."""
    rate = flow.pinned.rate(state, flow.goal(0.0), flow.parameters(0.0)) / flow.scale
    if not np.any(rate):
        return
    normal, extent = rate / np.linalg.norm(rate), 0.0
    time, before = 0.0, 0.0
    try:
        for later, there in flow.way(state, 0.0, duration):
            off = (there - state) / flow.scale
            ahead, extent = float(normal @ off), max(extent, float(np.linalg.norm(off)))
            if before < 0.0 <= ahead:
                across = np.linalg.norm(off - ahead * normal)
                if across <= NEAR * extent and extent >= LEAST:
                    yield time + (later - time) * before / (before - ahead)
            time, before = later, ahead
    except MotionLost:
        return


def _judged(state: FloatArray, period: float, monodromy: FloatArray, free: bool) -> PeriodicMotion:
    noise = CARRIED * max(1.0, float(np.linalg.norm(monodromy, 2)))
    values, errors = eigenvalues_of(monodromy, np.full(monodromy.shape, noise))
    if free:
        along = int(np.argmin(np.abs(values - 1.0)))
        values, errors = np.delete(values, along), np.delete(errors, along)
    order = np.argsort(-np.abs(values), kind="stable")
    return PeriodicMotion(state, period, values[order], errors[order])
