"""Whether the result of a search for an equilibrium is one, and how well it is isolated.

A small rate does not prove an equilibrium: that of x' = exp(-x) is small for all large x. Near an
equilibrium the rate grows with the distance from it, and a Newton step is that distance. If the
slope vanishes, as at the equilibrium of x' = -x^3, the rate still grows, and the state is known up
to a radius.
"""

from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.zero_dynamics.pinned.pinned_outputs import PinnedOutputs
from drake_dae.dae.zero_dynamics.stability import ROUNDED, ComplexArray

ISOLATED = 1e-6
"""An equilibrium is isolated if its distance is at most this, relative to the scale of the
states."""

BESIDE = 1e-5
"""The distance, relative to the scale, within which the slopes must be nearly constant."""

SAME = 0.5
"""The allowed relative change of the slopes: then Newton's method contracts."""

GROWTH = 1e3
"""The growth of the rate, from that at the state, that shows that it is not zero along a
direction."""

RADII = tuple(0.5**k for k in range(30))
"""The radii of this test, relative to the scale of the states."""

AFAR = 64.0
"""A rate that vanishes along a direction must vanish up to this distance, or up to the size of the
state."""

STRAIGHT = 0.1
"""The rate is tested where the projection onto Z(R) moves a state by less than this fraction of its
distance."""


@dataclass(frozen=True, eq=False)
class Isolation:
    """The accuracy to which an equilibrium is known.

    Attributes:
        degenerate: The number of directions in which its linearization does not isolate it.
        radius: The largest distance from the state, relative to the scale; infinite on a continuum
            of equilibria.
    """

    degenerate: int
    radius: float

    def errors(self, values: ComplexArray, errors: FloatArray) -> FloatArray:
        """Returns the errors of eigenvalues, widened for degenerate directions."""
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
    """Returns the accuracy of the equilibrium at which a search ends; None if it is none.

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
        distance = rest.radius(i)
        if distance is None:
            return None
        radius = max(radius, distance)
    return Isolation(len(weak), radius)


class _Rest:
    """The rate close to a state, and its derivatives, in scaled coordinates of Z(R)."""

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
        """Returns a state at a scaled distance along a direction, not projected onto Z(R)."""
        along = self._moved @ (self._scale[self._free] * self._v[index])
        along /= np.max(np.abs(along) / self._scale)
        return np.asarray(self._state + distance * along)

    @np.errstate(all="ignore")  # The domain may end near the state.
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
        """Returns the distance to which the equilibrium is known in a degenerate direction.

        Infinite if the rate vanishes along the whole direction, None if it vanishes nowhere. An
        analytic function that vanishes on a part of a line vanishes on all of it; one that is only
        flat at the state, like exp(-x), grows farther away.
        """
        noise = max(self._noise[index], ROUNDED * self._usual(index))
        visible = GROWTH * max(self._left[index], noise)
        radius = None
        for distance in RADII:
            # On both sides: a function that grows on one and decreases on the other does not
            # vanish.
            if not min(self._at_distance(index, distance)) > visible:
                break
            radius = distance
        if radius is not None or self._left[index] > GROWTH * noise:
            return radius
        longest = max(AFAR, 2.0 * float(np.max(np.abs(self._state) / self._scale)))
        distances = 2.0 ** np.arange(1, np.log2(longest) + 1)
        far = (max(self._at_distance(index, float(distance))) for distance in distances)
        return None if any(rate > visible for rate in far) else np.inf

    def _at_distance(self, index: int, distance: float) -> tuple[float, float]:
        """The size of the rate on both sides; 0 where no state on Z(R) is near."""
        rates = []
        for side in (distance, -distance):
            aside = self._beside(index, side)
            state, converged = self._pinned.project(aside, *self._at)
            moved = np.max(np.abs(state - aside) / self._scale)
            is_near = converged and moved <= STRAIGHT * distance
            rates.append(self._left_at(state, index) if is_near else 0.0)
        return rates[0], rates[1]

    def _left_at(self, state: FloatArray, index: int) -> float:
        rate = self._rate(state)
        return abs(float(self._u[:, index] @ rate)) if np.all(np.isfinite(rate)) else 0.0

    def _usual(self, index: int) -> float:
        """The usual rate in this direction, at the states of the structure."""
        return max(self._left_at(state, index) for state in self._pinned.structure.states)
