"""States at rest with constant outputs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.zero_dynamics.pinned.pinned_outputs import PinnedOutputs
from drake_dae.dae.zero_dynamics.pinned.pinned_point import PinnedPoint, Regularity
from drake_dae.dae.zero_dynamics.stability import ROUNDED, balanced_norm
from drake_dae.errors import InconsistentStateError
from drake_dae.trace.newton import DEPENDENT, ROUND_OFF, NewtonModel, newton, shortest_steps

AT_REST = 1e-8
"""A state is at rest if the terms of E x' cancel to this, relative to their sizes."""

ISOLATED = 1e-6
"""An equilibrium is known to this distance, relative to the scale of the states."""

BESIDE = 1e-5
"""The distance, relative to the scale, within which the slopes must be nearly constant."""

SAME = 0.5
"""The allowed relative change of the slopes there: then Newton's method contracts."""


@dataclass(frozen=True, eq=False)
class Rest:
    """Where a search for an equilibrium ends.

    Attributes:
        state: The state, shape (n,).
        rate: x' there, shape (n,).
        unrest: Why the state is not at rest; empty if it is.
        degenerate: The number of directions in which its Jacobian is singular; at an equilibrium 0.
    """

    state: FloatArray
    rate: FloatArray
    unrest: str
    degenerate: int = 0


def clock_rates(system: DaeSystem) -> FloatArray:
    """Returns the rates of states with a constant rate, such as clocks, shape (n,); else 0."""
    explicit, rates = system.explicit, np.zeros(system.num_states)
    for i in range(system.num_states):
        if explicit.f[i].is_constant() and not (explicit.g[i, :].nnz() or explicit.h[i, :].nnz()):
            rates[i] = float(explicit.f[i])
    return rates


class Equilibria:
    """The equilibria on Z(R). The arguments of all methods are arrays of the right sizes.

    An equilibrium is a state at rest whose Jacobian is not singular: Newton's step from there is
    short, and its slopes hardly change beside it. A small rate alone shows nothing: that of
    x' = exp(-x) is small for all large x, and Newton's step is 1 everywhere.

    Args:
        pinned: Z(R).

    Attributes:
        pinned: Z(R).
        sizes: The sizes of the states, shape (n,).
    """

    def __init__(self, pinned: PinnedOutputs) -> None:
        self.pinned = pinned
        examined = np.abs(pinned.structure.states).max(axis=0)
        self.sizes = np.maximum(examined, pinned.system.nominal_spread)
        self._clocks = clock_rates(pinned.system)

    def constant_outputs(self, state: FloatArray, parameters: FloatArray) -> FloatArray:
        """Returns R with the outputs of a state and zero derivatives.

        The state does not determine outputs of degree 0; they are chosen to minimize its rate.
        """
        pinned, layout = self.pinned, self.pinned.layout
        reference = np.zeros(layout.reference_size)
        chain = pinned.residual(state, reference, parameters)[-layout.chain_size :]
        if layout.chain_size:
            reference[layout.lowest[layout.dynamic]] = chain[layout.heads]
        if layout.direct.size and not self._clocks.any():
            _, slopes = pinned.slopes(state, reference, parameters)
            rate = pinned.rate(state, reference, parameters)
            if np.all(np.isfinite(slopes)) and np.all(np.isfinite(rate)):
                scale = pinned.system.scale
                nearest = -np.linalg.pinv(slopes / scale[:, None], DEPENDENT) @ (rate / scale)
                reference[layout.lowest[layout.direct]] = nearest
        return reference

    def find(self, reference: FloatArray, guess: FloatArray, parameters: FloatArray) -> FloatArray:
        """Returns the equilibrium at which a search from a guess ends, shape (n,).

        Raises:
            InconsistentStateError: It ends at none.
        """
        rest = self.search(reference, guess, parameters)
        unrest = rest.unrest
        if not unrest and rest.degenerate:
            unrest = "the Jacobian is singular"
        if unrest:
            raise InconsistentStateError(self.none(reference, rest.state, unrest), rest.rate)
        return rest.state

    def none(self, reference: FloatArray, state: FloatArray, unrest: str) -> str:
        """Returns in words that a search ended at a state that is no equilibrium."""
        return (
            f"{self.pinned.system.name}: {self.pinned.describe(reference)} have no regular state "
            f"at rest near the given one: the search ends at x = {show(state)}, where {unrest}"
        )

    def search(self, reference: FloatArray, guess: FloatArray, parameters: FloatArray) -> Rest:
        """Searches by Newton's method for C(x) = 0 and T^T x' = 0.

        T spans the tangent space of Z(R), which contains x'. Where the Jacobian is singular, the
        shortest step is taken.

        Raises:
            InconsistentStateError: There is no state on Z(R) near the guess, or a state is a clock.
        """
        pinned = self.pinned
        if self._clocks.any():
            signals = pinned.system.state_signals
            running = ", ".join(
                f"{signals[i].name}' = {self._clocks[i]:g}" for i in self._clocks.nonzero()[0]
            )
            raise InconsistentStateError(
                f"{pinned.system.name}: no state is an equilibrium, since {running} at all of "
                "them, as for a clock: time must not be a state. Take it out of the state, as an "
                "exogenous signal, or judge the zero dynamics along a motion",
                self._clocks,
            )

        scale = pinned.system.scale

        def linearize(z: FloatArray) -> NewtonModel | None:
            gradients = pinned.gradients(scale * z, parameters) * scale
            onto = shortest_steps(
                gradients, lambda z: pinned.residual(scale * z, reference, parameters)
            )
            slopes, _ = pinned.slopes(scale * z, reference, parameters)
            slopes = slopes * scale / scale[:, None]
            if onto is None or not np.all(np.isfinite(slopes)):
                return None
            tangent = scipy.linalg.null_space(gradients)
            along = tangent.T @ slopes @ tangent
            noise = ROUND_OFF * balanced_norm(slopes) / (np.linalg.norm(along) or 1.0)
            inner = tangent @ np.linalg.pinv(along, noise) @ tangent.T

            def step(z: FloatArray) -> FloatArray:
                across = onto.step(z)
                rate = pinned.rate(scale * z, reference, parameters) / scale
                return across - inner @ (rate + slopes @ across)

            return NewtonModel(step, onto.is_regular)

        start = pinned.state(reference, guess, parameters)
        z, converged = newton(start / scale, linearize)
        point = pinned.point(scale * z, reference, parameters)
        unrest = self.unrest(point, reference, parameters)
        if not converged:
            unrest = unrest or "the rates are small and do not vanish"
        if unrest:
            return Rest(point.state, point.rate, unrest)
        degenerate = self._degenerate(point.state, reference, parameters)
        return Rest(point.state, point.rate, "", degenerate)

    def find_all(
        self, reference: FloatArray, guesses: Sequence[FloatArray], parameters: FloatArray
    ) -> FloatArray:
        """Finds distinct equilibria from several guesses, shape (k, n)."""
        distinct = np.zeros((0, self.sizes.size))
        for guess in guesses:
            try:
                rest = self.find(reference, guess, parameters)
            except InconsistentStateError:
                continue
            near = np.abs(distinct - rest) <= ISOLATED * np.maximum(self.sizes, np.abs(rest))
            if not np.any(np.all(near, axis=1)):
                distinct = np.vstack([distinct, rest])
        return distinct

    def unrest(self, point: PinnedPoint, reference: FloatArray, parameters: FloatArray) -> str:
        """Returns why a point is no regular state at rest, as text; empty if it is one.

        A state that a tiny change brings to rest, as in a fast system, does not count as changing.
        """
        regularity = self.pinned.regularity(point)
        if regularity is not Regularity.REGULAR:
            return regularity.value
        slopes, _ = self.pinned.slopes(point.state, reference, parameters)
        slow = np.abs(point.rate) <= AT_REST * np.abs(slopes) @ self.sizes
        unrest = np.where(slow, 0.0, point.unrest)
        worst = int(np.argmax(unrest))
        if unrest[worst] <= AT_REST:
            return ""
        return f"{self.pinned.system.state_signals[worst].name}' = {point.rate[worst]:.3g}"

    @np.errstate(all="ignore")  # The domain may end near the state.
    def _degenerate(self, state: FloatArray, reference: FloatArray, parameters: FloatArray) -> int:
        """The number of directions on Z(R) in which the Jacobian isolates no equilibrium."""
        pinned, scale = self.pinned, self.pinned.system.scale
        free, moved = pinned.coordinates(state, parameters, scale)

        def slopes_at(x: FloatArray) -> FloatArray:
            slopes = pinned.slopes(x, reference, parameters)[0] @ moved
            return np.asarray(slopes[free] * scale[free] / scale[free][:, None])

        slopes = slopes_at(state)
        rate = (pinned.rate(state, reference, parameters) / scale)[free]
        if not (np.all(np.isfinite(slopes)) and np.all(np.isfinite(rate))):
            return free.size
        left, sizes, right = np.linalg.svd(slopes)
        terms = pinned.sizes_of_slopes(state, reference, parameters) @ np.abs(state)
        rates = np.abs(left.T @ rate) + ROUNDED * np.abs(left.T) @ (terms / scale)[free]
        count = 0
        for u, size, v, rest in zip(left.T, sizes, right, rates, strict=True):
            isolated = size > 0.0 and rest <= ISOLATED * size
            if isolated:
                along = moved @ (scale[free] * v)
                along *= BESIDE / np.max(np.abs(along) / scale)
                changes = [u @ (slopes_at(x) - slopes) @ v for x in (state + along, state - along)]
                isolated = all(abs(change) <= SAME * size for change in changes)
            count += not isolated
        return count
