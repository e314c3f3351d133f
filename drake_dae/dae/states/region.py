"""A box of the state space: consistent states in it, and minima of functions."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.manifold import Manifold
from drake_dae.errors import InconsistentStateError
from drake_dae.trace.newton import NewtonModel, newton

_SLACK = 1e-6
"""The allowed distance of a state from the box after Newton's method, relative to the box."""


_FLAT = 1e-3
"""A gradient that changes a function by less than this fraction across the box counts as zero."""


@dataclass(frozen=True, eq=False)
class Region:
    """The states x with low <= x <= high."""

    low: FloatArray
    high: FloatArray

    def holds(self, state: FloatArray) -> bool:
        """Returns whether a state is in the region."""
        bounds = np.where(np.isfinite([self.low, self.high]), [self.low, self.high], 0.0)
        slack = _SLACK * np.maximum(np.abs(bounds).max(axis=0), bounds[1] - bounds[0])
        return bool(np.all((state >= self.low - slack) & (state <= self.high + slack)))


class ConsistentRegion:
    """The consistent states in a region, with the default parameters."""

    def __init__(self, manifold: Manifold, region: Region | None) -> None:
        self.manifold = manifold
        self.region = region

    def project(self, guess: FloatArray) -> FloatArray:
        """Returns a consistent state in the region, near a guess."""
        region = self.region
        if region is None:
            return self.manifold.project(guess)
        try:
            state = self.manifold.project(guess)
            if region.holds(state):
                return state
        except InconsistentStateError:
            pass
        state = self.manifold.project(self._newton(region, guess))
        if not region.holds(state):
            raise InconsistentStateError(
                f"{self.manifold.system.name}: no consistent state found in the region",
                self.manifold.residual(np.clip(state, region.low, region.high)),
            )
        return state

    def draw(self, guess: FloatArray) -> FloatArray:
        """Returns a consistent state with the bounded states of a guess, if there is one.

        So random values cover the region, although the projection changes other states.
        """
        region = self.region
        if region is None:
            return self.project(guess)
        bounded = np.isfinite(region.low)
        bounded_region = Region(np.where(bounded, guess, -np.inf), np.where(bounded, guess, np.inf))
        try:
            state = self.manifold.project(self._newton(bounded_region, guess))
        except InconsistentStateError:
            return self.project(guess)
        return state if region.holds(state) else self.project(guess)

    def descend(
        self, function: Callable[[FloatArray], tuple[float, FloatArray]], start: FloatArray
    ) -> FloatArray:
        """Minimizes a nonnegative function along N* inside the region.

        Each step leads to the zero of the linearized function, so that zeros are found in a few
        steps. A positive minimum is only approached.
        """
        region = self.region
        if region is None:
            return start
        scale = self.manifold.system.scale
        width = np.where(np.isfinite(region.high - region.low), region.high - region.low, scale)
        state, (value, gradient) = start, function(start)
        for _ in range(40):
            direction = self._downhill(region, state, gradient, width)
            slope = float(direction @ direction)
            # In units of the box: the state moves by the width times this.
            if not value > 0.0 or not np.sqrt(slope) > _FLAT * value:
                break
            length = min(value / slope, self._room(region, state, width * direction))
            for _ in range(6):
                try:
                    trial = self.project(state + length * width * direction)
                except InconsistentStateError:
                    length /= 4.0
                    continue
                trial_value, trial_gradient = function(trial)
                if trial_value < value:
                    break
                length /= 4.0
            else:
                break
            state, value, gradient = trial, trial_value, trial_gradient
        return state

    def _downhill(
        self, region: Region, state: FloatArray, gradient: FloatArray, width: FloatArray
    ) -> FloatArray:
        """Returns the descent direction along N* that stays in the box, in units of the box."""
        rows = self.manifold.gradients(state) * width
        slope = gradient * width
        fixed = np.zeros(state.size, dtype=bool)
        while True:
            normal = np.vstack([rows, np.eye(state.size)[fixed]])
            length = np.linalg.norm(normal, axis=1)
            normal = normal[length > 0.0] / length[length > 0.0, None]
            direction = normal.T @ np.linalg.lstsq(normal.T, slope)[0] - slope
            edge = _SLACK * width
            blocked = (direction < 0.0) & (state <= region.low + edge)
            blocked |= (direction > 0.0) & (state >= region.high - edge)
            if not np.any(blocked & ~fixed):
                return np.where(fixed, 0.0, direction)
            fixed |= blocked

    @staticmethod
    def _room(region: Region, state: FloatArray, step: FloatArray) -> float:
        """Returns the factor by which a step reaches the boundary of the box."""
        edge = np.where(step < 0.0, region.low, region.high)
        moving = step != 0.0
        with np.errstate(over="ignore"):
            return float(np.min((edge - state)[moving] / step[moving], initial=np.inf))

    def _newton(self, region: Region, guess: FloatArray) -> FloatArray:
        """The result of Newton's method for the constraints, with steps inside the box."""
        scale = self.manifold.system.scale
        low, high = region.low / scale, region.high / scale

        def linearize(z: FloatArray) -> NewtonModel | None:
            gradient = self.manifold.gradients(scale * z) * scale
            if not np.all(np.isfinite(gradient)):
                return None

            def step(z: FloatArray) -> FloatArray:
                residual = self.manifold.residual(scale * z)
                return _bounded_step(gradient, residual, low - z, high - z)

            return NewtonModel(step, True)

        return scale * newton(np.clip(guess / scale, low, high), linearize)[0]


def _bounded_step(
    gradient: FloatArray, residual: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """A short dx with C dx + r = 0; components are limited by the bounds."""
    step, free = np.zeros(low.size), low < high
    while free.any():
        remaining = residual + gradient[:, ~free] @ step[~free]
        step[free] = -np.linalg.lstsq(gradient[:, free], remaining)[0]
        past = free & ((step < low) | (step > high))
        if not past.any():
            break
        step[past] = np.clip(step[past], low[past], high[past])
        free &= ~past
    return step
