"""States at rest with constant outputs."""

from collections.abc import Sequence

import numpy as np
import scipy.linalg

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.zero_dynamics.isolation import Isolation, isolation
from drake_dae.dae.zero_dynamics.pinned.pinned_outputs import PinnedOutputs
from drake_dae.dae.zero_dynamics.pinned.pinned_point import PinnedPoint, Regularity
from drake_dae.dae.zero_dynamics.stability import (
    ComplexArray,
    balanced_norm,
    linearized_eigenvalues,
)
from drake_dae.errors import InconsistentStateError
from drake_dae.trace.newton import DEPENDENT, ROUND_OFF, NewtonModel, newton, shortest_steps

AT_REST = 1e-8
"""A state is at rest if the terms of E x' cancel to this, relative to their sizes."""


FAR = 1e8
"""A search fails if it leaves the known states by this factor of their sizes: relative to such
large states any rate looks like zero."""

APART = 1e-6
"""States at rest that are nearer than this, relative to their sizes, are the same."""


def clock_rates(system: DaeSystem) -> FloatArray:
    """Returns the rates of states with a constant rate, such as clocks, shape (n,); else 0."""
    explicit, rates = system.explicit, np.zeros(system.num_states)
    for i in range(system.num_states):
        if explicit.f[i].is_constant() and not (explicit.g[i, :].nnz() or explicit.h[i, :].nnz()):
            rates[i] = float(explicit.f[i])
    return rates


class Equilibria:
    """The equilibria on Z(R). The arguments of all methods are arrays of the right sizes.

    Args:
        pinned: Z(R).

    Attributes:
        pinned: Z(R).
        sizes: How large the states are, shape (n,).
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
        """Finds an equilibrium by Newton's method for C(x) = 0 and T^T x' = 0.

        T spans the tangent space of Z(R), which contains x'. On a continuum of equilibria the
        shortest step is taken.
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
        state = scale * z
        point = pinned.point(state, reference, parameters)
        unrest = self.unrest(point, reference, parameters)
        if np.any(np.abs(state) > FAR * np.maximum(self.sizes, np.abs(start))):
            unrest = "it grows without bound"
        if converged and not unrest:
            if isolation(pinned, state, reference, parameters):
                return state
            unrest = "the rates are small and do not vanish"
        raise InconsistentStateError(
            f"{pinned.system.name}: {pinned.describe(reference)} have no regular state at rest "
            f"near the given one: the search ends at x = {show(state)}, where "
            f"{unrest or 'the equations are singular'}",
            point.rate,
        )

    def find_all(
        self, reference: FloatArray, guesses: Sequence[FloatArray], parameters: FloatArray
    ) -> FloatArray:
        """Finds distinct equilibria from several guesses, shape (k, n).

        Of equilibria that are not isolated (with a zero eigenvalue) only the first is returned.
        """
        distinct = np.zeros((0, self.sizes.size))
        radii: list[float] = []
        for guess in guesses:
            try:
                rest = self.find(reference, guess, parameters)
            except InconsistentStateError:
                continue
            near = np.abs(distinct - rest) <= APART * np.maximum(self.sizes, np.abs(rest))
            if np.any(np.all(near, axis=1)):
                continue
            values, errors, accuracy = self.eigenvalues(reference, rest, parameters)
            radius = 0.0
            if not np.all(np.abs(values) > errors):
                # Infinite if the linearization is singular up to round-off.
                radius = accuracy.radius if accuracy.degenerate else np.inf
            off = np.max(np.abs(distinct - rest) / self.pinned.system.scale, axis=1)
            if np.any(off <= radius + np.array(radii)) or (radius == np.inf and len(distinct)):
                continue
            distinct = np.vstack([distinct, rest])
            radii.append(radius if radius < np.inf else 0.0)
        return distinct

    def eigenvalues(
        self, reference: FloatArray, rest: FloatArray, parameters: FloatArray
    ) -> tuple[ComplexArray, FloatArray, Isolation]:
        """Returns the eigenvalues at an equilibrium, their errors, and its accuracy."""
        accuracy = isolation(self.pinned, rest, reference, parameters) or Isolation(0, 0.0)
        values, errors = linearized_eigenvalues(
            self.pinned, self.sizes, rest, reference, parameters
        )
        return values, accuracy.errors(values, errors), accuracy

    def unrest(self, point: PinnedPoint, reference: FloatArray, parameters: FloatArray) -> str:
        """Returns why a point is no regular equilibrium, as text; empty if it is one.

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
