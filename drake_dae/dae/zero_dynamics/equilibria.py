"""States at rest with constant outputs."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.manifold.manifold import coordinates
from drake_dae.dae.zero_dynamics.pinned_outputs import PinnedOutputs, PinnedPoint, PinnedSet
from drake_dae.dae.zero_dynamics.stability import ROUNDED, balanced_matrix
from drake_dae.errors import InconsistentStateError
from drake_dae.trace.newton import ROUND_OFF, NewtonModel, newton, shortest_steps
from drake_dae.trace.round_off import DEPENDENT

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
    """Where a search for an equilibrium ends: a state, x' there, and why it is not at rest, if so.

    `degenerate` is the number of directions in which the Jacobian of a state at rest is singular.
    """

    state: FloatArray
    rate: FloatArray
    unrest: str
    degenerate: int = 0


class Equilibria:
    """The equilibria on Z(R).

    An equilibrium is a state at rest whose Jacobian is not singular: Newton's step from there is
    short, and its slopes hardly change beside it. A small rate alone shows nothing: that of
    x' = exp(-x) is small for all large x, and Newton's step is 1 everywhere.
    """

    def __init__(self, pinned: PinnedOutputs) -> None:
        self.pinned, system = pinned, pinned.system
        examined = np.abs(pinned.structure.states).max(axis=0)
        self.sizes = np.maximum(examined, system.spread_around(system.nominal_state))
        # The rates of states with a constant rate, such as clocks.
        explicit, self._clocks = system.explicit, np.zeros(system.num_states)
        for i in range(system.num_states):
            still = not (explicit.g[i, :].nnz() or explicit.h[i, :].nnz())
            if still and explicit.f[i].is_constant():
                self._clocks[i] = float(explicit.f[i])

    def constant_outputs(self, state: FloatArray, parameters: FloatArray) -> FloatArray:
        """Returns R with the outputs of a state and zero derivatives.

        The state does not determine outputs of degree 0; they are chosen to minimize its rate.
        """
        layout, scale = self.pinned.layout, self.pinned.system.scale
        reference = np.zeros(layout.reference_size)
        chain = self.pinned.at(reference, parameters).residual(state)[-layout.chain_size :]
        if layout.chain_size:
            reference[layout.lowest[layout.dynamic]] = chain[layout.heads]
        direct = layout.lowest[layout.direct]
        if direct.size and not self._clocks.any():
            pinned = self.pinned.at(reference, parameters)
            still, by = np.zeros((state.size, direct.size)), np.eye(reference.size)[:, direct]
            slopes, rate = pinned.slopes_along(state, still, by), pinned.rate(state)
            if np.all(np.isfinite(slopes)) and np.all(np.isfinite(rate)):
                nearest = -np.linalg.pinv(slopes / scale[:, None], DEPENDENT) @ (rate / scale)
                reference[direct] = nearest
        return reference

    def find(self, pinned: PinnedSet, guess: FloatArray) -> FloatArray:
        """Returns the equilibrium at which a search from a guess ends, shape (n,)."""
        rest = self.search(pinned, guess)
        unrest = rest.unrest or ("the Jacobian is singular" if rest.degenerate else "")
        if unrest:
            raise InconsistentStateError(self.none(pinned, rest.state, unrest), rest.rate)
        return rest.state

    def none(self, pinned: PinnedSet, state: FloatArray, unrest: str) -> str:
        """Returns in words that a search ended at a state that is no equilibrium."""
        return (
            f"{self.pinned.system.name}: {pinned.describe()} have no regular state at rest near "
            f"the given one: the search ends at x = {show(state)}, where {unrest}"
        )

    def search(self, pinned: PinnedSet, guess: FloatArray) -> Rest:
        """Searches by Newton's method for C(x) = 0 and T^T x' = 0.

        T spans the tangent space of Z(R), which contains x'. Where the Jacobian is singular, the
        shortest step is taken.
        """
        system, scale = self.pinned.system, self.pinned.system.scale
        if self._clocks.any():
            running = ", ".join(
                f"{system.state_signals[i].name}' = {self._clocks[i]:g}"
                for i in self._clocks.nonzero()[0]
            )
            raise InconsistentStateError(
                f"{system.name}: no state is an equilibrium, since {running} at all of "
                "them, as for a clock: time must not be a state. Take it out of the state, as an "
                "exogenous signal, or judge the zero dynamics along a motion",
                self._clocks,
            )

        def linearize(z: FloatArray) -> NewtonModel | None:
            gradients = pinned.gradients(scale * z) * scale
            onto = shortest_steps(gradients, lambda z: pinned.residual(scale * z))
            slopes = pinned.slopes(scale * z) * scale / scale[:, None]
            if onto is None or not np.all(np.isfinite(slopes)):
                return None
            tangent = scipy.linalg.null_space(gradients)
            along = tangent.T @ slopes @ tangent
            size = np.linalg.norm(balanced_matrix(slopes)[0], 2)
            noise = ROUND_OFF * float(size) / (np.linalg.norm(along) or 1.0)
            inner = tangent @ np.linalg.pinv(along, noise) @ tangent.T

            def step(z: FloatArray) -> FloatArray:
                across = onto.step(z)
                return across - inner @ (pinned.rate(scale * z) / scale + slopes @ across)

            return NewtonModel(step, onto.is_regular)

        z, converged = newton(pinned.state(guess) / scale, linearize)
        point = pinned.point(scale * z)
        unrest = self.unrest(pinned, point)
        if not converged:
            unrest = unrest or "the rates are small and do not vanish"
        degenerate = 0 if unrest else self._degenerate(pinned, point.state)
        return Rest(point.state, point.rate, unrest, degenerate)

    def unrest(self, pinned: PinnedSet, point: PinnedPoint) -> str:
        """Returns why a point is no regular state at rest, as text; empty if it is one.

        A state that a tiny change brings to rest, as in a fast system, does not count as changing.
        """
        if flaw := pinned.flaw(point):
            return flaw
        slow = np.abs(point.rate) <= AT_REST * np.abs(pinned.slopes(point.state)) @ self.sizes
        unrest = np.where(slow, 0.0, point.unrest)
        worst = int(np.argmax(unrest))
        if unrest[worst] <= AT_REST:
            return ""
        return f"{self.pinned.system.state_signals[worst].name}' = {point.rate[worst]:.3g}"

    @np.errstate(all="ignore")  # The domain may end near the state.
    def _degenerate(self, pinned: PinnedSet, state: FloatArray) -> int:
        """The number of directions on Z(R) in which the Jacobian isolates no equilibrium."""
        scale = self.pinned.system.scale
        free, moved = coordinates(pinned.gradients(state), scale)

        def slopes_at(x: FloatArray) -> FloatArray:
            slopes = pinned.slopes(x) @ moved
            return np.asarray(slopes[free] * scale[free] / scale[free][:, None])

        slopes = slopes_at(state)
        rate = (pinned.rate(state) / scale)[free]
        if not (np.all(np.isfinite(slopes)) and np.all(np.isfinite(rate))):
            return free.size
        left, sizes, right = np.linalg.svd(slopes)
        terms = pinned.sizes_of_slopes(state) @ np.abs(state)
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
