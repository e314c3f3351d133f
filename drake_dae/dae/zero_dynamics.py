"""What the system does while its outputs follow a reference: Assumption 2.2.        (35)-(36)

Pinned outputs leave the states

    Z(R) = {x in N*: L_f*^j l*_i(x) = r_i^(j), j = 0, ..., mu_i - 1},

and the control u = B^-1 (-a + r^(mu)), which is (28) without an error. On Z(R) the state moves by
x' = f* + h* u. Its dimension is that of xi; where that is 0, the reference alone determines the
motion. All is done in the state x: nothing depends on the choice of xi in (22).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import casadi as ca
import numpy as np
import scipy.integrate
import scipy.linalg
from numpy.typing import ArrayLike

from drake_dae.dae.expressions import Factorization, TracedFunction
from drake_dae.dae.manifold import CONSISTENT, DEPENDENT, ROUND_OFF
from drake_dae.dae.samples import show
from drake_dae.dae.structure import Structure
from drake_dae.errors import FloatArray, InconsistentStateError, ModelError, NonFiniteError

CONVERGED = 1e-9
"""A Newton step of this size, relative to the state, that does not get smaller is round-off."""

AT_REST = 1e-8
"""A state is at rest if its forces balance to this, relative to their sizes."""

LINEARIZED = 1e-11
"""The error of a linearization, relative to its norm: that of the equilibrium, and round-off."""

TOLERANCE = 1e-6
"""Of an integration step, relative to the state; the method's estimate is two orders too high."""

SHORTEST = 1e-6
"""The part of a time step at which a search for the way on ends."""

JUMP = 0.1
"""A correction of this size, relative to the state, may lead to another solution."""

STEPS = 20_000
"""The most steps of one motion, beside its times."""

GROWN = 1e8
"""By this factor a state grows only without bound."""

SINGULAR = 1e-12
"""Below this sine between its columns A or B has no inverse; see `expressions.Factorization`."""

VANISHED = 1e-9
"""Nor has it below this part of its usual margin, which tells for a single number."""

LOST = 1e-2
"""A margin below this part of its largest value on the way tends to zero."""

ComplexArray = np.typing.NDArray[np.complex128]

Reference = Callable[[float], FloatArray]
"""t -> R(t) = (r_1, r_1', ..., r_1^(mu_1), r_2, ...), shape (sum (mu_i + 1),)."""

_Correction = Callable[[FloatArray], FloatArray]
_Linearization = tuple[_Correction, bool]
"""The Newton step of a state by the matrix of another; whether that matrix has full rank."""


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
            found. Without zero dynamics: stable.
        eigenvalues: Of the zero dynamics in 1/s, largest real part first, shape (dimension,);
            empty if no equilibrium is found.
        state: The equilibrium, shape (n,); None if none is needed, or found.
        reason: A sentence.
    """

    verdict: Verdict
    eigenvalues: ComplexArray
    state: FloatArray | None
    reason: str


@dataclass(frozen=True, eq=False)
class PinnedMotion:
    """The motion with the outputs on a reference, as far as there is one.

    Attributes:
        times: In s, those of the wanted times that were reached, shape (k,).
        states: x, shape (k, n).
        controls: u, shape (k, p).
        constraint_inputs: v, shape (k, m).
        constraint_margins: The smallest singular value of A(x), shape (k,); infinite if m = 0.
        control_margins: The smallest singular value of B(x), shape (k,).
        failure: Why the last time was not reached; empty if it was.
        failure_time: Up to where there is a motion, in s; None if that is the end.
    """

    times: FloatArray
    states: FloatArray
    controls: FloatArray
    constraint_inputs: FloatArray
    constraint_margins: FloatArray
    control_margins: FloatArray
    failure: str
    failure_time: float | None


class ZeroDynamics:
    """The dynamics (35) that are left when the outputs are pinned to a reference.

    In all methods `reference` is R = (r_1, r_1', ..., r_1^(mu_1), r_2, ...), shape
    (sum (mu_i + 1),), as for `TrackingLaw`; `guess` is a state, shape (n,), the nominal one if
    None; and `parameters` are the values of all parameters, the defaults if None.

    Args:
        structure: Of the system.

    Attributes:
        dimension: dim xi = n - sum r_i - sum mu_i.
        residual_signals: What is zero on Z(R): the constraints, then the output errors, each with
            its derivatives.
    """

    def __init__(self, structure: Structure) -> None:
        self.structure = structure
        self.system = system = structure.system
        self.dimension = structure.zero_dynamics_dimension
        starts = np.cumsum([0, *[degree + 1 for degree in structure.output_degrees]])
        self._values = starts[:-1]  # Where r_1, r_2, ... stand in R.
        self._met = [i for i, degree in enumerate(structure.output_degrees) if degree == 0]
        self._R = goal = ca.SX.sym("R", int(starts[-1]))
        errors, signals = [], list(structure.manifold.residual_signals)
        for chain, start, signal in zip(
            structure.output_chains, self._values, system.output_signals, strict=True
        ):
            errors += [element - goal[int(start) + j] for j, element in enumerate(chain)]
            signals += [signal.derivative(j) for j in range(len(chain))]
        self.residual_signals = tuple(signals)
        residual = ca.vertcat(structure.manifold.residual_expression, *errors)

        motion, highest = structure.motion, goal[(starts[1:] - 1).tolist()]
        factors = Factorization(structure.control_matrix)
        control = factors.solve(highest - structure.drift)
        self._rate, force = (
            ca.substitute(motion.expand(unknown), motion.control, control)
            for unknown in (motion.rate, motion.constraint_input)
        )
        x, p = system.state, system.parameter_symbol
        self._inputs = {"state": x, "reference": goal, "parameters": p}
        self._residual = TracedFunction(
            f"{system.name} pinned outputs", self._inputs, {"residual": residual}
        )
        self._gradient = TracedFunction(
            f"{system.name} gradient of the pinned outputs",
            {"state": x, "parameters": p},
            {"gradient": ca.jacobian(ca.cse(residual), x)},
            often=False,  # It shares what the residual does; to find more takes long.
        )
        # E x' = f + g v + h u, and the sizes of what cancels in it at rest.
        mass, g, h = (ca.fabs(e) for e in (system.mass_matrix, system.g, system.h))
        sizes = ca.mtimes(mass, ca.fmax(1.0, ca.fabs(x))) + ca.fabs(system.f)
        sizes += ca.mtimes(g, ca.fabs(force)) + ca.mtimes(h, ca.fabs(control))
        self._motion = TracedFunction(
            f"{system.name} pinned motion",
            self._inputs,
            {
                "rate": self._rate,
                "control": control,
                "force": force,
                "constraint_matrix": structure.elimination.constraint_matrix,
                "control_matrix": structure.control_matrix,
                "pivot": ca.fmin(factors.pivot, structure.elimination.pivot),
                "imbalance": ca.mtimes(system.mass_matrix, self._rate),
                "sizes": sizes,
            },
        )

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
        name, goal = self.system.name, self._vector("reference", reference, self._R.numel())
        p = self._parameters(parameters)
        found, converged = self._project(self._guess(guess), goal, p)
        if converged:
            return found
        residual = self._residual(found, goal, p)[0]
        if not np.all(np.isfinite(residual)):
            raise InconsistentStateError(
                f"{name}: {self._outputs(goal)} have no value near the given state; start inside "
                "the domain of the system",
                residual,
            )
        # The distances by which they are missed, if these are small.
        length = np.linalg.norm(self._gradients(found, p), axis=1)
        missed = np.abs(residual) / np.where(length > 0.0, length, 1.0)
        worst = int(np.argmax(missed))
        if missed[worst] <= CONSISTENT:
            raise InconsistentStateError(
                f"{name}: {self._outputs(goal)} lead to x = {show(found)}, where A(x) or B(x) is "
                "singular",
                residual,
            )
        raise InconsistentStateError(
            f"{name}: {self._outputs(goal)} are not reached near the given state: "
            f"{self.residual_signals[worst].name} stays off by {residual[worst]:.3g}. Ask for "
            "outputs that the system can have, or start nearer to the state that has them",
            residual,
        )

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
        points: list[_Point] = []
        failure, failure_time = "", None
        try:
            with np.errstate(all="ignore"):  # As in _newton.
                for point in _Pursuit(self, reference, p).points(grid.tolist(), start):
                    points.append(point)
        except _MotionEnd as end:
            failure, failure_time = str(end), end.time
        m, controls = self.system.num_constraints, self.system.num_controls

        def stack(values: list[FloatArray], *shape: int) -> FloatArray:
            return np.array(values).reshape(len(points), *shape)

        return PinnedMotion(
            times=grid[: len(points)],
            states=stack([point.state for point in points], self.system.num_states),
            controls=stack([point.control for point in points], controls),
            constraint_inputs=stack([point.force for point in points], m),
            constraint_margins=np.array([point.margins[0] for point in points]),
            control_margins=np.array([point.margins[1] for point in points]),
            failure=failure,
            failure_time=failure_time,
        )

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
        goal = np.zeros(self._R.numel())
        goal[self._values] = self._vector("outputs", outputs, self.system.num_controls)
        return self._rest(goal, self._guess(guess), self._parameters(parameters))

    def eigenvalues(self, state: ArrayLike, parameters: ArrayLike | None = None) -> ComplexArray:
        """Of the zero dynamics, linearized at an equilibrium whose outputs are held.

        The derivative of f* + h* u(x, R) maps the tangent space of Z(R) into itself; these are its
        eigenvalues there. In closed loop they stand beside the roots of (32). Of a linear system
        they are the invariant zeros.

        Returns:
            In 1/s, largest real part first, shape (dimension,).

        Raises:
            ModelError: The state is not an equilibrium on N*.
        """
        x, p = self._guess(state), self._parameters(parameters)
        goal = self._held(x, p)
        onto, _ = self._project(x, goal, p)
        _, unrest = self._unrest(x, goal, p)
        if np.any(np.abs(onto - x) > AT_REST * np.maximum(1.0, np.abs(x))):
            unrest = "it is off N*, or its outputs change"
        if unrest:
            raise ModelError(
                f"{self.system.name}: x = {show(x)} is no regular equilibrium: {unrest}. "
                "Eigenvalues belong to an equilibrium; 'equilibrium' finds one"
            )
        return self._eigenvalues(x, goal, p)[0]

    def stability(
        self, state: ArrayLike | None = None, parameters: ArrayLike | None = None
    ) -> Stability:
        """Whether Assumption 2.2 holds near an equilibrium, by linearization.

        Args:
            state: Where to look for the equilibrium. Outputs with mu_i >= 1 are held as they are
                there; those with mu_i = 0, which depend on the control, as brings that state
                nearest to rest.
            parameters: Values of all parameters.

        Raises:
            InconsistentStateError: The state is not near N*.
            ModelError: A wrong shape, or a number that is not finite.
        """
        if self.dimension == 0:
            reason = "no zero dynamics: the reference alone determines the motion"
            return Stability(Verdict.STABLE, np.zeros(0, dtype=complex), None, reason)
        p = self._parameters(parameters)
        start = self.structure.manifold.project(self._guess(state), p)
        try:
            goal = self._held(start, p)
            rest = self._rest(goal, start, p)
        except InconsistentStateError as error:
            nothing = np.zeros(0, dtype=complex)
            return Stability(Verdict.UNDECIDED, nothing, None, str(error))
        values, errors = self._eigenvalues(rest, goal, p)
        place = f"at the equilibrium with {self._outputs(goal)}"
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

    def _outputs(self, reference: FloatArray) -> str:
        """The outputs of a reference, for a message."""
        values = zip(self.system.output_signals, reference[self._values], strict=True)
        return "the outputs " + ", ".join(f"{signal.name} = {v:.6g}" for signal, v in values)

    def _project(
        self, start: FloatArray, reference: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, bool]:
        """The state on Z(R) next to a start; or where Newton's method ended, and False."""

        def linearize(x: FloatArray) -> _Linearization | None:
            solved = _right_inverse(self._gradients(x, parameters))
            if solved is None:
                return None
            inverse, regular = solved
            evaluate = self._residual.evaluate
            return lambda trial: -inverse(evaluate(trial, reference, parameters)[0]), regular

        return _newton(start, linearize)

    def _gradients(self, state: FloatArray, parameters: FloatArray) -> FloatArray:
        """C, the gradients of all chains, shape (n - dimension, n)."""
        gradients = self._gradient.evaluate(state, parameters)[0]
        return gradients.reshape(-1, self.system.num_states)

    @cached_property
    def _slope(self) -> TracedFunction:
        """The derivative of x' along a direction of state and reference."""
        dx, dr = ca.SX.sym("dx", self.system.num_states), ca.SX.sym("dR", self._R.numel())
        at, along = ca.vertcat(self.system.state, self._R), ca.vertcat(dx, dr)
        return TracedFunction(
            f"{self.system.name} slope of the pinned motion",
            {**self._inputs, "dx": dx, "dR": dr},
            {"slope": ca.jtimes(ca.cse(self._rate), at, along)},
            often=False,
        )

    def _slopes(
        self, state: FloatArray, reference: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """dx'/dx, shape (n, n), and dx'/dr_i for the outputs of degree 0."""
        n, directions = state.size, np.eye(state.size + reference.size)
        chosen = directions[[*range(n), *(n + self._values[self._met])]]
        columns = [
            self._slope.evaluate(state, reference, parameters, along[:n], along[n:])[0].copy()
            for along in chosen
        ]
        slopes = np.array(columns).T
        return slopes[:, :n], slopes[:, n:]

    def _eigenvalues(
        self, state: FloatArray, reference: FloatArray, parameters: FloatArray
    ) -> tuple[ComplexArray, FloatArray]:
        """Of d(f* + h* u)/dx on the tangent space of Z(R), and how far off each may be."""
        slopes, _ = self._slopes(state, reference, parameters)
        tangent = scipy.linalg.null_space(self._gradients(state, parameters))
        return _eigenvalues(tangent.T @ slopes @ tangent, LINEARIZED * _scale(slopes))

    def _held(self, state: FloatArray, parameters: FloatArray) -> FloatArray:
        """R of constant outputs as they are at a state.

        The state does not tell outputs of degree 0; they are as brings it nearest to rest.
        """
        reference = np.zeros(self._R.numel())
        errors = self._residual(state, reference, parameters)[0]
        first = sum(self.structure.constraint_degrees)
        for i, degree in enumerate(self.structure.output_degrees):
            if degree:
                reference[self._values[i]] = errors[first]
            first += degree
        if self._met:
            _, slopes = self._slopes(state, reference, parameters)
            rate = self._motion(state, reference, parameters)[0]
            if np.all(np.isfinite(slopes)) and np.all(np.isfinite(rate)):
                reference[self._values[self._met]] = -np.linalg.pinv(slopes, DEPENDENT) @ rate
        return reference

    def _rest(self, reference: FloatArray, guess: FloatArray, parameters: FloatArray) -> FloatArray:
        """An equilibrium by Newton's method for C(x) = 0 and T^T x' = 0.

        T spans the tangent space of Z(R), in which x' is. Where there is a continuum, the step
        along it is the shortest.
        """

        def linearize(x: FloatArray) -> _Linearization | None:
            gradients = self._gradients(x, parameters)
            solved = _right_inverse(gradients)
            slopes, _ = self._slopes(x, reference, parameters)
            if solved is None or not np.all(np.isfinite(slopes)):
                return None
            inverse, regular = solved
            tangent = scipy.linalg.null_space(gradients)
            along = tangent.T @ slopes @ tangent
            noise = ROUND_OFF * _scale(slopes) / (np.linalg.norm(along) or 1.0)
            inner = tangent @ np.linalg.pinv(along, noise) @ tangent.T

            def correct(trial: FloatArray) -> FloatArray:
                across = -inverse(self._residual.evaluate(trial, reference, parameters)[0])
                rate = self._motion.evaluate(trial, reference, parameters)[0]
                return across - inner @ (rate + slopes @ across)

            return correct, regular

        start = self.state(reference, guess, parameters)
        state, converged = _newton(start, linearize)
        rate, unrest = self._unrest(state, reference, parameters)
        if converged and not unrest:
            return state
        raise InconsistentStateError(
            f"{self.system.name}: {self._outputs(reference)} have no regular state at rest near "
            f"the given one: the search ends at x = {show(state)}, where "
            f"{unrest or 'the equations are singular'}",
            rate,
        )

    @cached_property
    def _usual_margins(self) -> tuple[float, float]:
        """The largest margins of A and B at the states of the structure."""
        reference, parameters = np.zeros(self._R.numel()), self.system.parameter_values
        margins = [
            _margins(*self._motion.evaluate(state, reference, parameters)[3:5])
            for state in self.structure.states
        ]
        return max(a for a, _ in margins), max(b for _, b in margins)

    def _is_regular(self, margins: tuple[float, float], pivot: float) -> bool:
        """Whether A and B have an inverse."""
        pairs = zip(margins, self._usual_margins, strict=True)
        return pivot > SINGULAR and all(now >= VANISHED * usual for now, usual in pairs)

    @np.errstate(all="ignore")  # As in _newton.
    def _unrest(
        self, state: FloatArray, reference: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, str]:
        """x', and what moves, or is singular, if anything is."""
        rate, _, _, a, b, pivot, imbalance, sizes = self._motion(state, reference, parameters)
        if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
            return rate, "A(x) or B(x) is not finite"
        if not self._is_regular(_margins(a, b), pivot[0]):
            return rate, "A(x) or B(x) is singular"
        share = np.abs(imbalance) / sizes
        worst = int(np.argmax(share))
        if share[worst] <= AT_REST:
            return rate, ""
        return rate, f"{self.system.state_signals[worst].name}' = {rate[worst]:.3g}"


@dataclass(frozen=True, eq=False)
class _Point:
    """A state on Z(R(t)), and what belongs to it; margins and signs of det A and det B."""

    time: float
    state: FloatArray
    rate: FloatArray
    control: FloatArray
    force: FloatArray
    margins: tuple[float, float]
    signs: tuple[float, ...]


class _MotionEnd(Exception):
    """A motion does not go on."""

    def __init__(self, message: str, time: float) -> None:
        super().__init__(message)
        self.time = time


class _Pursuit:
    """Follows a reference from point to point; raises _MotionEnd where that ends."""

    def __init__(
        self, dynamics: ZeroDynamics, reference: Reference, parameters: FloatArray
    ) -> None:
        self._dynamics = dynamics
        self._reference = reference
        self._parameters = parameters
        self._name = dynamics.system.name

    def points(self, grid: list[float], guess: FloatArray) -> Iterator[_Point]:
        """One point for each time."""
        time = grid[0]
        goal = self._goal(time)
        try:
            state = self._dynamics.state(goal, guess, self._parameters)
        except InconsistentStateError as error:
            raise _MotionEnd(f"{error} (t = {time:.6g} s)", time) from error
        start = self._point(time, state, goal)
        if start is None:
            raise _MotionEnd(
                f"{self._name}: at the start, t = {time:.6g} s, x = {show(state)}, A(x) or B(x) is "
                "singular, or the domain of the system ends",
                time,
            )
        self._largest = start.margins
        self._remaining = STEPS + len(grid)
        yield start
        yield from (self._integrate if self._dynamics.dimension else self._continue)(start, grid)

    def _continue(self, start: _Point, grid: list[float]) -> Iterator[_Point]:
        """Without zero dynamics: predictor and Newton's method."""
        before = last = start
        step = np.inf
        for end in grid[1:]:
            interval = end - last.time
            while last.time < end:
                step = min(step, end - last.time)
                time = end if step == end - last.time else last.time + step
                # Adams and Bashforth: x' and its change since the step before.
                change = step * (last.rate - before.rate) / ((last.time - before.time) or np.inf)
                predicted = last.state + step * (last.rate + 0.5 * change)
                point = self._corrected(time, predicted, last)
                if point is None:
                    step *= 0.5
                    if step < SHORTEST * interval:
                        raise self._end(last, interval, grid[-1])
                else:
                    before, last = last, point
                    step *= 2.0
            yield last

    def _integrate(self, start: _Point, grid: list[float]) -> Iterator[_Point]:
        """With zero dynamics: an implicit integrator, since they may be stiff."""
        dynamics, last = self._dynamics, start

        def rate(time: float, state: FloatArray) -> FloatArray:
            return dynamics._motion.evaluate(state, self._goal(time), self._parameters)[0].copy()

        def slopes(time: float, state: FloatArray) -> FloatArray:
            matrix = dynamics._slopes(state, self._goal(time), self._parameters)[0]
            if not np.all(np.isfinite(matrix)):
                raise self._end(last, np.inf, time)
            return matrix

        def integrator_from(last: _Point, end: float, step: float | None) -> scipy.integrate.Radau:
            return scipy.integrate.Radau(
                rate,
                last.time,
                last.state,
                end,
                rtol=TOLERANCE,
                atol=0.01 * TOLERANCE,
                jac=slopes,
                first_step=step,
            )

        bound = GROWN * max(1.0, float(np.max(np.abs(start.state))))
        integrator: scipy.integrate.Radau | None = None
        for end in grid[1:]:
            integrator = integrator or integrator_from(last, end, None)
            interval = end - last.time
            integrator.t_bound, integrator.status = end, "running"
            while last.time < end:
                integrator.step()
                if integrator.status == "failed":
                    raise self._end(last, interval, grid[-1])
                worst = int(np.argmax(np.abs(integrator.y)))
                if abs(integrator.y[worst]) > bound:
                    raise _MotionEnd(
                        f"{self._name}: the internal states grow without bound while the outputs "
                        f"follow: {dynamics.system.state_signals[worst].name} = "
                        f"{integrator.y[worst]:.3g} at t = {integrator.t:.6g} s",
                        last.time,
                    )
                point = self._corrected(integrator.t, integrator.y, last)
                if point is None:
                    step = 0.5 * (integrator.t - last.time)
                    if step < SHORTEST * interval:
                        raise self._end(last, interval, grid[-1])
                    integrator = integrator_from(last, end, step)
                else:
                    last = point
                    integrator.y, integrator.f = point.state.copy(), point.rate.copy()
            yield last

    def _goal(self, time: float) -> FloatArray:
        """R(t)."""
        try:
            goal = np.asarray(self._reference(time), dtype=float).reshape(-1)
        except NonFiniteError as error:
            raise _MotionEnd(str(error), time) from error
        if goal.size != self._dynamics._R.numel():
            raise ModelError(
                f"{self._name}: the reference must have size {self._dynamics._R.numel()} (each "
                f"output and its derivatives up to its degree "
                f"{self._dynamics.structure.output_degrees}), got {goal.size}"
            )
        if not np.all(np.isfinite(goal)):
            raise _MotionEnd(f"{self._name}: the reference is not finite at t = {time:.6g} s", time)
        return goal

    def _point(self, time: float, state: FloatArray, goal: FloatArray) -> _Point | None:
        """None where the motion is not finite, or not determined."""
        function = self._dynamics._motion
        values = [value.copy() for value in function.evaluate(state, goal, self._parameters)]
        if not function.is_finite:
            return None
        rate, control, force, a, b, pivot, *_ = values
        margins = _margins(a, b)
        if not self._dynamics._is_regular(margins, pivot[0]):
            return None
        signs = tuple(float(np.linalg.slogdet(_square(matrix))[0]) for matrix in (a, b))
        return _Point(time, state, rate, control, force, margins, signs)

    def _corrected(self, time: float, state: FloatArray, last: _Point) -> _Point | None:
        """The point on Z(R(t)) next to a state, unless it is on another branch than the last."""
        self._remaining -= 1
        if self._remaining < 0:
            raise _MotionEnd(
                f"{self._name}: after {STEPS} steps the motion is at t = {last.time:.6g} s; it is "
                "too fast to be followed so far",
                last.time,
            )
        goal = self._goal(time)
        found, converged = self._dynamics._project(state, goal, self._parameters)
        near = JUMP * np.maximum(1.0, np.abs(last.state)) + np.abs(state - last.state)
        if not converged or np.any(np.abs(found - state) > near):
            return None
        point = self._point(time, found, goal)
        if point is None or point.signs != last.signs:
            return None
        (a, b), (c, d) = self._largest, point.margins
        self._largest = max(a, c), max(b, d)
        return point

    def _end(self, last: _Point, interval: float, final: float) -> _MotionEnd:
        """Why there is no way on from a point, between times with an interval."""
        shares = [
            now / largest if largest < np.inf else 1.0
            for now, largest in zip(last.margins, self._largest, strict=True)
        ]
        which = int(np.argmin(shares))
        when = f"t = {last.time:.6g} s"
        if shares[which] > LOST:
            why = (
                f"no state that continues the motion is found beyond {when}, x = "
                f"{show(last.state)}: the reference jumps, or the domain of the system ends"
            )
            return _MotionEnd(f"{self._name}: {why}", last.time)
        ahead = min(0.1 * interval, final - last.time)
        goal = self._goal(last.time + ahead)
        beyond = any(
            self._dynamics._project(guess, goal, self._parameters)[1]
            for guess in (last.state, last.state + ahead * last.rate)
        )
        smallest = f"smallest singular value {last.margins[which]:.2g}"
        singular = f"{'AB'[which]}(x) becomes singular, {smallest}"
        if beyond:
            why = f"at {when} {singular}: the control would be unbounded. Lead the reference around"
        else:
            why = f"the reference leaves what the system can reach at {when}: {singular}"
        return _MotionEnd(f"{self._name}: {why}", last.time)


@np.errstate(all="ignore")  # Iterates out of the domain are tried, and refused.
def _newton(
    start: FloatArray, linearize: Callable[[FloatArray], _Linearization | None]
) -> tuple[FloatArray, bool]:
    """Damped Newton's method; a step must make the next one, by the same matrix, shorter.

    That test does not depend on the units of the equations (Deuflhard, 2004, section 3.3).

    Args:
        start: The first iterate.
        linearize: The linearization at an iterate, None if it is not finite.

    Returns:
        The last iterate, and whether it is a regular solution up to round-off.
    """
    x, unit = start, np.maximum(1.0, np.abs(start))

    def size(step: FloatArray) -> float:
        return float(np.linalg.norm(step / unit))

    fresh = True
    for _ in range(100):
        if fresh:
            linearization = linearize(x)
            if linearization is None:
                return x, False
            correct, regular = linearization
            step = correct(x)
        before = size(step)
        if before <= ROUND_OFF:
            return x + step, regular
        length, shorter = 1.0, False
        while length > 1e-4 and not shorter:
            trial = x + length * step
            following = correct(trial)
            after = size(following)
            shorter = after <= (1.0 - 0.25 * length) * before
            if not shorter and before <= CONVERGED:
                return x, regular
            length *= 0.5
        if shorter:
            x, step = trial, following
        elif fresh:
            return x, False
        fresh = not shorter or after > 0.1 * before
    return x, False


def _right_inverse(gradients: FloatArray) -> _Linearization | None:
    """r -> the shortest dx with C dx = r, and whether C has full rank; None if it is not finite.

    The rows are scaled to length one. Where they depend on each other, which may be where a search
    starts, dx is that of least squares.
    """
    if not np.all(np.isfinite(gradients)):
        return None
    length = np.linalg.norm(gradients, axis=1)
    length[length == 0.0] = 1.0
    rows = gradients / length[:, None]
    q, r = scipy.linalg.qr(rows.T, mode="economic", check_finite=False)
    if np.min(np.abs(np.diag(r)), initial=1.0) <= DEPENDENT:
        inverse = np.linalg.pinv(rows, DEPENDENT)
        return lambda residual: inverse @ (residual / length), False
    solve = scipy.linalg.solve_triangular
    return lambda residual: q @ solve(r, residual / length, trans="T", check_finite=False), True


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


def _square(matrix: FloatArray) -> FloatArray:
    """A square matrix, which came as a vector if it has one column."""
    return matrix.reshape(round(matrix.size**0.5), round(matrix.size**0.5))


def _margins(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """The smallest singular values of A and B; that of a matrix without columns is infinite."""
    smallest = [
        float(np.min(np.linalg.svd(_square(matrix), compute_uv=False), initial=np.inf))
        for matrix in (a, b)
    ]
    return smallest[0], smallest[1]
