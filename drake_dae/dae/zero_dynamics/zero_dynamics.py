"""What the system does while its outputs follow a reference: Assumption 2.2.        (35)-(36)

On Z(R), see `pinned_outputs`, the state moves by x' = f* + h* u. Its dimension is that of xi; where
that is 0, the reference alone determines the motion. All is done in the state x: nothing depends
on the choice of xi in (22).
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.states.samples import default_spread
from drake_dae.dae.structure import Structure, find_structure
from drake_dae.dae.system import DaeSystem
from drake_dae.dae.zero_dynamics.pinned_motion import PinnedMotion, Reference, follow
from drake_dae.dae.zero_dynamics.pinned_outputs import PinnedOutputs, Point
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.newton import DEPENDENT, ROUND_OFF, Linearization, newton, shortest_steps

AT_REST = 1e-8
"""A state is at rest if its forces balance to this, relative to their sizes."""


LINEARIZED = 1e-11
"""The error of a linearization, relative to its norm: that of the equilibrium, and round-off."""


SHIFT = 1e-7
"""How far off an equilibrium may be, relative to the size of the states."""


ComplexArray = np.typing.NDArray[np.complex128]


class Verdict(StrEnum):
    """What the linearization says of the zero dynamics."""

    STABLE = "exponentially stable"
    UNSTABLE = "unstable"
    UNDECIDED = "undecided"


@dataclass(frozen=True, eq=False)
class Stability:
    """Whether the internal states stay near an equilibrium while the outputs are held.

    The verdict is local: it is about states near this equilibrium and outputs near its outputs.
    What suffices for Assumption 2.2 everywhere, (i) and (ii) below (36), is not examined.

    Attributes:
        verdict: Stable if all eigenvalues have negative real parts, unstable if one has a positive
            one; undecided if one is on the imaginary axis up to round-off, or if no equilibrium is
            found. Without zero dynamics: stable, or undecided if A(x) or B(x) is singular.
        eigenvalues: Of the zero dynamics in 1/s, largest real part first, shape (dimension,);
            empty if no equilibrium is found.
        state: The equilibrium, shape (n,); None if none is needed, or found.
        reason: A sentence.
    """

    verdict: Verdict
    eigenvalues: ComplexArray
    state: FloatArray | None
    reason: str


class ZeroDynamics:
    """The dynamics (35) that are left when the outputs are pinned to a reference.

    In all methods `reference` is R = (r_1, r_1', ..., r_1^(mu_1), r_2, ...), shape
    (sum (mu_i + 1),), as for `TrackingLaw`; `guess` is a state, shape (n,), the nominal one if
    None; and `parameters` are the values of all parameters, the defaults if None.

    Args:
        structure: Of the system, or the system.

    Attributes:
        dimension: dim xi = n - sum r_i - sum mu_i.
        residual_signals: What is zero on Z(R): the constraints, then the output errors, each with
            its derivatives.
    """

    def __init__(self, structure: Structure | DaeSystem) -> None:
        if not isinstance(structure, Structure):
            structure = find_structure(structure)
        self.structure = structure
        self.system = structure.system
        self.dimension = structure.zero_dynamics_dimension
        self._pinned = PinnedOutputs(structure)
        self.residual_signals = self._pinned.residual_signals
        examined = np.abs(structure.states).max(axis=0)
        self._sizes = np.maximum(examined, default_spread(self.system.nominal_state))

    def state(
        self,
        reference: ArrayLike,
        guess: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
    ) -> FloatArray:
        """A state on Z(R), to round-off, by Newton's method with shortest steps from a guess.

        Returns:
            Shape (n,).

        Raises:
            InconsistentStateError: Newton's method does not reach Z(R) from there.
            ModelError: A wrong shape, or a number that is not finite.
        """
        goal = self._vector("reference", reference, self._pinned.size)
        return self._pinned.state(goal, self._guess(guess), self._parameters(parameters))

    def motion(
        self,
        reference: Reference,
        times: ArrayLike,
        guess: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
    ) -> PinnedMotion:
        """The motion on Z(R(t)) from a state next to the guess, as far as it exists.

        Without zero dynamics each state follows from the one before by Newton's method. Else
        x' = f* + h* u is integrated (Radau IIA of order 5) and projected after each step.

        Args:
            reference: t -> R(t); it is also asked between the times.
            times: In s, increasing, shape (k,).
            guess: For the first state; decides which of several solutions is followed.
            parameters: Values of all parameters.

        Raises:
            ModelError: A wrong shape, or times that do not increase. Any other failure is told by
                the motion that comes back; see `PinnedMotion.failure`.
        """
        grid = self._vector("times", times)
        if grid.size == 0 or np.any(np.diff(grid) <= 0.0):
            raise ModelError(f"{self.system.name}: times must increase, got {times!r}")
        start, p = self._guess(guess), self._parameters(parameters)
        return follow(self._pinned, reference, grid, start, p)

    def equilibrium(
        self,
        outputs: ArrayLike,
        guess: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
    ) -> FloatArray:
        """A state at rest, x' = 0, with constant outputs, by Newton's method from a guess.

        Where there is a continuum of equilibria, it is one near the guess.

        Args:
            outputs: z, shape (p,).
            guess: Where to start.
            parameters: Values of all parameters.

        Returns:
            Shape (n,).

        Raises:
            InconsistentStateError: No state near the guess has these outputs; or such states, but
                none at rest: `residual` is then x', shape (n,).
            ModelError: A wrong shape, or a number that is not finite.
        """
        goal = self._constant(outputs)
        return self._rest(goal, self._guess(guess), self._parameters(parameters))

    def eigenvalues(
        self,
        state: ArrayLike,
        parameters: ArrayLike | None = None,
        outputs: ArrayLike | None = None,
    ) -> ComplexArray:
        """Of the zero dynamics, linearized at an equilibrium whose outputs are held.

        The derivative of f* + h* u(x, R) maps the tangent space of Z(R) into itself; these are its
        eigenvalues there. In closed loop they stand beside the roots of (32). Of a linear system
        they are the invariant zeros.

        Args:
            state: x, shape (n,).
            parameters: Values of all parameters.
            outputs: z, shape (p,). If None those of the state, where outputs with mu_i = 0, which
                depend on the control, are as brings it nearest to rest: give them where several
                values do, such as the force on a surface that nothing else moves.

        Returns:
            In 1/s, largest real part first, shape (dimension,).

        Raises:
            ModelError: The state is not an equilibrium on N*.
        """
        x, p = self._guess(state), self._parameters(parameters)
        goal = self._held(x, p) if outputs is None else self._constant(outputs)
        onto, _ = self._pinned.project(x, goal, p)
        unrest = self._unrest(self._pinned.point(x, goal, p), goal, p)
        if np.any(np.abs(onto - x) > AT_REST * np.maximum(1.0, np.abs(x))):
            unrest = "it is off N*, or its outputs change"
        if unrest:
            raise ModelError(
                f"{self.system.name}: x = {show(x)} is no regular equilibrium: {unrest}. "
                "Eigenvalues belong to an equilibrium; 'equilibrium' finds one"
            )
        return self._eigenvalues(x, goal, p)[0]

    def stability(
        self,
        state: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
        outputs: ArrayLike | None = None,
    ) -> Stability:
        """Whether Assumption 2.2 holds near an equilibrium, by linearization.

        Args:
            state: Where to look for the equilibrium.
            parameters: Values of all parameters.
            outputs: z at the equilibrium, shape (p,). If None those of the state, where outputs
                with mu_i = 0, which depend on the control, are as brings it nearest to rest.

        Raises:
            InconsistentStateError: The state is not near N*.
            ModelError: A wrong shape, or a number that is not finite.
        """
        nothing = np.zeros(0, dtype=complex)
        if self.dimension == 0:
            margins = {
                "A(x) of (2)": self.structure.constraint_margin,
                "B(x) of (16)": self.structure.control_margin,
            }
            for matrix, margin in margins.items():
                if margin is not None and margin.is_singular:
                    reason = (
                        "no zero dynamics, but the reference does not determine the motion: "
                        f"{matrix} is singular at x = {show(margin.state)}"
                    )
                    return Stability(Verdict.UNDECIDED, nothing, None, reason)
            reason = "no zero dynamics: the reference alone determines the motion"
            return Stability(Verdict.STABLE, nothing, None, reason)
        p = self._parameters(parameters)
        start = self.structure.manifold.project(self._guess(state), p)
        try:
            goal = self._held(start, p) if outputs is None else self._constant(outputs)
            rest = self._rest(goal, start, p)
        except InconsistentStateError as error:
            return Stability(Verdict.UNDECIDED, nothing, None, str(error))
        values, errors = self._eigenvalues(rest, goal, p)
        place = f"at the equilibrium with {self._pinned.describe(goal)}"
        largest = f"the largest real part of an eigenvalue is {values[0].real:.4g} 1/s {place}"
        if np.any(values.real > errors):
            return Stability(Verdict.UNSTABLE, values, rest, f"non-minimum phase: {largest}")
        if np.all(values.real < -errors):
            return Stability(Verdict.STABLE, values, rest, f"minimum phase: {largest}")
        count = np.count_nonzero(np.abs(values.real) <= errors)
        return Stability(
            Verdict.UNDECIDED,
            values,
            rest,
            f"the linearization does not decide: {count} of {values.size} eigenvalues are on the "
            f"imaginary axis, up to round-off, {place}",
        )

    def _vector(self, what: str, value: ArrayLike, size: int | None = None) -> FloatArray:
        try:
            vector = np.array(value, dtype=float).reshape(-1)
        except (TypeError, ValueError):
            raise ModelError(f"{self.system.name}: {what} must be numbers, got {value!r}") from None
        if size not in (None, vector.size):
            raise ModelError(f"{self.system.name}: {what} must have size {size}, got {vector.size}")
        if not np.all(np.isfinite(vector)):
            raise ModelError(f"{self.system.name}: {what} must be finite, got {vector}")
        return vector

    def _guess(self, guess: ArrayLike | None) -> FloatArray:
        given = self.system.nominal_state if guess is None else guess
        return self._vector("state", given, self.system.num_states)

    def _parameters(self, parameters: ArrayLike | None) -> FloatArray:
        default = self.system.parameter_values
        given = default if parameters is None else parameters
        return self._vector("parameters", given, default.size)

    def _eigenvalues(
        self, state: FloatArray, reference: FloatArray, parameters: FloatArray
    ) -> tuple[ComplexArray, FloatArray]:
        """Of d(f* + h* u)/dx on the tangent space of Z(R), and how far off each may be.

        That is by the round-off of what cancels in it, and by what a shift of the equilibrium
        changes, which is not known better where Newton's method converges slowly.
        """
        pinned, scale = self._pinned, self._sizes
        slopes, _ = pinned.slopes(state, reference, parameters)
        tangent = scipy.linalg.null_space(pinned.gradients(state, parameters))
        sizes = pinned.sizes_of_slopes(state, reference, parameters) / scale[:, None] * scale
        noise = LINEARIZED * max(_scale(slopes), float(np.linalg.norm(sizes)))
        values, errors = _eigenvalues(tangent.T @ slopes @ tangent, noise)
        along = tangent @ np.random.default_rng(0).standard_normal(tangent.shape[1])
        along /= np.max(np.abs(along) / scale, initial=0.0) or 1.0
        beside, _ = pinned.slopes(state + SHIFT * along, reference, parameters)
        if np.all(np.isfinite(beside)):
            others = np.linalg.eigvals(tangent.T @ beside @ tangent)
            errors += np.min(np.abs(values[:, None] - others), axis=1, initial=np.inf)
        return values, errors

    def _constant(self, outputs: ArrayLike) -> FloatArray:
        """R of outputs that stay as they are."""
        reference = np.zeros(self._pinned.size)
        values = self._vector("outputs", outputs, self.system.num_controls)
        reference[self._pinned.starts] = values
        return reference

    def _held(self, state: FloatArray, parameters: FloatArray) -> FloatArray:
        """R of constant outputs as they are at a state.

        The state does not tell outputs of degree 0; they are as brings it nearest to rest.
        """
        pinned, reference = self._pinned, np.zeros(self._pinned.size)
        errors = pinned.residual(state, reference, parameters)
        first = sum(self.structure.constraint_degrees)
        for start, degree in zip(pinned.starts, self.structure.output_degrees, strict=True):
            if degree:
                reference[start] = errors[first]
            first += degree
        if pinned.met:
            _, slopes = pinned.slopes(state, reference, parameters)
            rate = pinned.rate(state, reference, parameters)
            if np.all(np.isfinite(slopes)) and np.all(np.isfinite(rate)):
                reference[pinned.starts[pinned.met]] = -np.linalg.pinv(slopes, DEPENDENT) @ rate
        return reference

    def _rest(self, reference: FloatArray, guess: FloatArray, parameters: FloatArray) -> FloatArray:
        """An equilibrium by Newton's method for C(x) = 0 and T^T x' = 0.

        T spans the tangent space of Z(R), in which x' is. Where there is a continuum, the step
        along it is the shortest.
        """
        pinned = self._pinned

        def linearize(x: FloatArray) -> Linearization | None:
            gradients = pinned.gradients(x, parameters)
            onto = shortest_steps(gradients, lambda x: pinned.residual(x, reference, parameters))
            slopes, _ = pinned.slopes(x, reference, parameters)
            if onto is None or not np.all(np.isfinite(slopes)):
                return None
            step_onto, regular = onto
            tangent = scipy.linalg.null_space(gradients)
            along = tangent.T @ slopes @ tangent
            noise = ROUND_OFF * _scale(slopes) / (np.linalg.norm(along) or 1.0)
            inner = tangent @ np.linalg.pinv(along, noise) @ tangent.T

            def step(x: FloatArray) -> FloatArray:
                across = step_onto(x)
                return across - inner @ (pinned.rate(x, reference, parameters) + slopes @ across)

            return step, regular

        start = pinned.state(reference, guess, parameters)
        state, converged = newton(start, linearize)
        point = pinned.point(state, reference, parameters)
        unrest = self._unrest(point, reference, parameters)
        if converged and not unrest:
            return state
        raise InconsistentStateError(
            f"{self.system.name}: {pinned.describe(reference)} have no regular state at rest near "
            f"the given one: the search ends at x = {show(state)}, where "
            f"{unrest or 'the equations are singular'}",
            point.rate,
        )

    def _unrest(self, point: Point, reference: FloatArray, parameters: FloatArray) -> str:
        """What moves at a point, or is singular, if anything is.

        Neither moves what a tiny change of the state brings to rest, as in a fast system.
        """
        flaw = self._pinned.flaw(point)
        if flaw:
            return flaw
        slopes, _ = self._pinned.slopes(point.state, reference, parameters)
        slow = np.abs(point.rate) <= AT_REST * np.abs(slopes) @ self._sizes
        unrest = np.where(slow, 0.0, point.unrest)
        worst = int(np.argmax(unrest))
        if unrest[worst] <= AT_REST:
            return ""
        return f"{self.system.state_signals[worst].name}' = {point.rate[worst]:.3g}"


def first_outputs(structure: Structure, reference: ArrayLike) -> FloatArray:
    """r_1, ..., r_p of R = (r_1, r_1', ..., r_1^(mu_1), r_2, ...), shape (p,)."""
    starts = np.cumsum([0, *[degree + 1 for degree in structure.output_degrees[:-1]]])
    return np.asarray(reference, dtype=float).reshape(-1)[starts]


def _scale(matrix: FloatArray) -> float:
    """The norm of a matrix without the units of its state."""
    return float(np.linalg.norm(scipy.linalg.matrix_balance(matrix, permute=False)[0], 2))


def _eigenvalues(matrix: FloatArray, error: float) -> tuple[ComplexArray, FloatArray]:
    """Eigenvalues, largest real part first, and how far off each may be.

    To first order an error E of the matrix moves an eigenvalue by at most |E| / |y^H x|, with its
    left and right eigenvectors y and x of length one. Balancing takes the units out first.
    """
    if not matrix.size:
        return np.zeros(0, dtype=complex), np.zeros(0)
    balanced = scipy.linalg.matrix_balance(matrix, permute=False)[0]
    values, left, right = scipy.linalg.eig(balanced, left=True, right=True)
    errors = error / np.maximum(np.abs(np.sum(left.conj() * right, axis=0)), 1e-300)
    order = np.lexsort((values.imag, -values.real))
    return values[order], errors[order]
