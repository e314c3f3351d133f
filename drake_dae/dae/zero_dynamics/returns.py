"""Motions that return to where they were: what shows that one is bounded.

That small disturbances do not grow shows no bound: x' = 1 has none that do, and no bound. A motion
that comes back to a state repeats itself for ever, and is bounded; motions next to it are drawn to
it where all its multipliers, except that along the motion itself, are inside the unit circle.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.zero_dynamics.disturbances import Flow, Lost
from drake_dae.dae.zero_dynamics.stability import ComplexArray, eigenvalues_of

CLOSED = 1e-7
"""A motion is closed if it comes back to this, relative to the scale of the states."""

CARRIED = 1e-6
"""The error of a transition matrix, relative to its norm."""

NEAR = 0.05
"""A motion comes near to where it was at this part of the way that it goes about."""

MULTIPLES = 6
"""After so many periods of a reference a motion along it is looked for that repeats itself."""

LEAST = 1e-4
"""What goes about by less than this, relative to the scale of the states, is at rest."""

STEPS = 12
"""So many of Newton's steps are tried."""

CROSSINGS = 6
"""So many times that a motion comes near to where it was are tried."""


@dataclass(frozen=True, eq=False)
class Return:
    """A motion that comes back to where it was.

    Attributes:
        state: Where it begins, shape (n,).
        period: After what time it is there again, in s.
        monodromy: What that makes of disturbances, in the basis there, shape (d, d).
        multipliers: Its eigenvalues, the largest first; without the one that is 1 along the motion
            if nothing else gives the time.
        errors: How far off each may be.
    """

    state: FloatArray
    period: float
    monodromy: FloatArray
    multipliers: ComplexArray
    errors: FloatArray

    @property
    def attracts(self) -> bool:
        """Whether motions beside it are drawn to it."""
        return bool(np.all(np.abs(self.multipliers) < 1.0 - self.errors))

    @property
    def repels(self) -> bool:
        """Whether some motions beside it leave it."""
        return bool(np.any(np.abs(self.multipliers) > 1.0 + self.errors))

    def __str__(self) -> str:
        text = f"period {self.period:.6g} s"
        if not self.multipliers.size:
            return text
        return f"{text}, largest multiplier {np.abs(self.multipliers[0]):.7g}"


def close(
    flow: Flow,
    state: FloatArray,
    begin: float,
    period: float,
    *,
    free: bool = False,
    patient: bool = False,
) -> Return | None:
    """The motion near a state that comes back after a period; None if none is found.

    Newton's method for the way that is left after a period, along the tangent space.

    Args:
        flow: Of a reference that repeats itself after the period, or is constant.
        state: Where to begin, shape (n,).
        begin: When, in s.
        period: In s.
        free: Whether the period is found as well, where nothing depends on time.
        patient: Whether to go on where what is left does not get less for a while.
    """
    scale, before = flow.scale, np.inf
    for _ in range(STEPS):
        basis = flow.basis(state, begin)
        try:
            passage = flow.carry(state, begin, begin + period)
        except Lost:
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
            return None  # As where the motion drifts.
        matrix, left, before = monodromy - np.eye(gap.size), -gap, missed
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
            left = np.append(left, 0.0)
        change = np.linalg.lstsq(matrix, left, rcond=CARRIED)[0]
        later = float(change[gap.size]) / size if free else 0.0
        step = basis @ change[: gap.size]
        if np.max(np.abs(step) / scale, initial=0.0) <= CLOSED and abs(later) <= CLOSED * period:
            off = np.max(np.abs(passage.state - state) / scale)
            if off > 1e3 * CLOSED * max(1.0, passage.growth):
                return None
            return _judged(state, period, monodromy, free)
        try:
            state, period = flow.onto(state + step, begin), period + later
        except Lost:
            return None
        if not period > 0.0:
            return None
    return None


def find_return(flow: Flow, state: FloatArray, duration: float) -> Return | None:
    """The closed motion that a motion is on, or next to, where nothing depends on time.

    It is sought where the motion crosses a section near where it was: the plane across its rate.

    Args:
        flow: Of a constant reference.
        state: A state of the motion, shape (n,).
        duration: How long to wait for it, in s.
    """
    periods = islice(_near(flow, state, duration), CROSSINGS)
    found = (close(flow, state, 0.0, period, free=True) for period in periods)
    return next((one for one in found if one is not None), None)


def find_multiple(flow: Flow, state: FloatArray, begin: float, period: float) -> Return | None:
    """The motion near a state that comes back after some periods of the reference, and attracts."""
    found = (close(flow, state, begin, count * period) for count in range(1, MULTIPLES + 1))
    return next((one for one in found if one is not None and one.attracts), None)


def _near(flow: Flow, state: FloatArray, duration: float) -> Iterator[float]:
    """When a motion crosses the section at a state in the same direction, near the state."""
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
    except Lost:
        return


def _judged(state: FloatArray, period: float, monodromy: FloatArray, free: bool) -> Return:
    noise = CARRIED * max(1.0, float(np.linalg.norm(monodromy, 2)))
    values, errors = eigenvalues_of(monodromy, np.full(monodromy.shape, noise))
    if free:
        along = int(np.argmin(np.abs(values - 1.0)))
        values, errors = np.delete(values, along), np.delete(errors, along)
    order = np.argsort(-np.abs(values), kind="stable")
    return Return(state, period, monodromy, values[order], errors[order])
