"""Whether a state at which a search for rest ends is an equilibrium, and which one it is.

A rate that is small proves no rest: that of x' = exp(-x) is small wherever x is large. Next to an
equilibrium the rate grows with the distance from it, and Newton's step from a state is that
distance. Where the slope vanishes, as at the one equilibrium of x' = -x^3, the rate still grows,
and the state is known up to a radius.
"""

from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.zero_dynamics.pinned.pinned_outputs import PinnedOutputs
from drake_dae.dae.zero_dynamics.stability import ROUNDED, ComplexArray

ISOLATED = 1e-6
"""An equilibrium is isolated if it is this near, relative to the scale of the states."""

BESIDE = 1e-5
"""At this distance from it, relative to the scale, the slopes must still be about the same."""

SAME = 0.5
"""How much they may differ, relative to themselves: then Newton's method contracts."""

GROWTH = 1e3
"""By so much the rate grows from a state at rest to where it is seen not to be at rest."""

RADII = tuple(0.5**k for k in range(30))
"""Radii at which that is looked for, relative to the scale of the states."""

AFAR = 64.0
"""Up to such a distance, or as far as the state is from zero, a rate that vanishes all along a
direction still vanishes."""

STRAIGHT = 0.1
"""Which holds for states that the way back to Z(R) moves by less than this part of the distance."""


@dataclass(frozen=True, eq=False)
class Isolation:
    """How well an equilibrium is known.

    Attributes:
        degenerate: In how many directions its linearization does not isolate it.
        radius: How far it may be from the state, relative to the scale of the states; infinite if
            it is one of a continuum.
    """

    degenerate: int
    radius: float

    def errors(self, values: ComplexArray, errors: FloatArray) -> FloatArray:
        """Errors of eigenvalues: in directions that are degenerate there is none but 0."""
        widened = errors.copy()
        smallest = np.argsort(np.abs(values))[: self.degenerate]
        widened[smallest] = np.maximum(errors[smallest], 2.0 * np.abs(values[smallest]))
        return widened


def isolation(
    pinned: PinnedOutputs,
    state: FloatArray,
    reference: FloatArray,
    parameters: FloatArray,
) -> Isolation | None:
    """How well the equilibrium is known at which a search ends; None if there is none.

    Args:
        pinned: Z(R).
        state: Where the search ends, shape (n,).
        reference: R.
        parameters: Values of all parameters.
    """
    rest = _Rest(pinned, state, reference, parameters)
    if not rest.is_finite:
        return None
    weak = [i for i in range(rest.sizes.size) if not rest.isolates(i)]
    if not weak:
        return Isolation(0, 0.0)
    radius = 0.0
    for i in weak:
        found = rest.radius(i)
        if found is None:
            return None
        radius = max(radius, found)
    return Isolation(len(weak), radius)


class _Rest:
    """The rate and its slopes beside a state, in coordinates of Z(R) over their scale."""

    def __init__(
        self,
        pinned: PinnedOutputs,
        state: FloatArray,
        reference: FloatArray,
        parameters: FloatArray,
    ) -> None:
        self._pinned, self._state = pinned, state
        self._at = reference, parameters
        self._scale = pinned.system.scale
        self._free, self._moved = pinned.coordinates(state, parameters, self._scale)
        slopes, rate = self._slopes(state), self._rate(state)
        self.is_finite = bool(np.all(np.isfinite(slopes)) and np.all(np.isfinite(rate)))
        if not self.is_finite:
            return
        self._u, self.sizes, self._v = np.linalg.svd(slopes)
        self._slope = slopes
        self._left = np.abs(self._u.T @ rate)
        terms = pinned.sizes_of_slopes(state, reference, parameters) @ np.abs(state)
        self._noise = ROUNDED * np.abs(self._u.T) @ (terms / self._scale)[self._free]

    def _rate(self, state: FloatArray) -> FloatArray:
        return (self._pinned.rate(state, *self._at) / self._scale)[self._free]

    def _slopes(self, state: FloatArray) -> FloatArray:
        slopes = self._pinned.slopes(state, *self._at)[0] @ self._moved
        return slopes[self._free] * self._scale[self._free] / self._scale[self._free][:, None]

    def _beside(self, index: int, distance: float) -> FloatArray:
        """A state at a distance along a direction, relative to the scale; not put on Z(R)."""
        along = self._moved @ (self._scale[self._free] * self._v[index])
        along /= np.max(np.abs(along) / self._scale)
        return np.asarray(self._state + distance * along)

    @np.errstate(all="ignore")  # Beside the state the domain may end.
    def isolates(self, index: int) -> bool:
        """Whether the linearization isolates the equilibrium in a singular direction of it."""
        size = float(self.sizes[index])
        if not (size > 0.0 and self._left[index] + self._noise[index] <= ISOLATED * size):
            return False
        u, v = self._u[:, index], self._v[index]
        for side in (BESIDE, -BESIDE):
            changed = self._slopes(self._beside(index, side)) - self._slope
            if not abs(u @ changed @ v) <= SAME * size:
                return False
        return True

    @np.errstate(all="ignore")
    def radius(self, index: int) -> float | None:
        """How far the equilibrium is in a direction in which it is not isolated.

        Infinite where the rate vanishes all along, None where it vanishes nowhere. A function that
        is analytic vanishes on a whole line if it does on a part of it; one that is only flat where
        the state is, like exp(-x), is seen to grow farther away.
        """
        noise = max(self._noise[index], ROUNDED * self._usual(index))
        seen = GROWTH * max(self._left[index], noise)
        found = None
        for distance in RADII:
            # On both sides: what grows on one and falls on the other vanishes nowhere.
            if not min(self._at_distance(index, distance)) > seen:
                break
            found = distance
        if found is not None or self._left[index] > GROWTH * noise:
            return found
        longest = max(AFAR, 2.0 * float(np.max(np.abs(self._state) / self._scale)))
        distances = 2.0 ** np.arange(1, np.log2(longest) + 1)
        far = (max(self._at_distance(index, float(distance))) for distance in distances)
        return None if any(rate > seen for rate in far) else np.inf

    def _at_distance(self, index: int, distance: float) -> tuple[float, float]:
        """How large the rate in a direction is on both sides along it; 0 where nothing is known."""
        found = []
        for side in (distance, -distance):
            aside = self._beside(index, side)
            state, converged = self._pinned.project(aside, *self._at)
            moved = np.max(np.abs(state - aside) / self._scale)
            is_near = converged and moved <= STRAIGHT * distance
            found.append(self._left_at(state, index) if is_near else 0.0)
        return found[0], found[1]

    def _left_at(self, state: FloatArray, index: int) -> float:
        rate = self._rate(state)
        return abs(float(self._u[:, index] @ rate)) if np.all(np.isfinite(rate)) else 0.0

    def _usual(self, index: int) -> float:
        """How large the rate in this direction is at the states of the structure."""
        return max(self._left_at(state, index) for state in self._pinned.structure.states)
