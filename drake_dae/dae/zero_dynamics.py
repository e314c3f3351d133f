"""What the system does while its outputs follow a reference: Assumption 2.2.        (35)-(36)

On Z(R), see `pinned_motion`, the state moves by x' = f* + h* u. All is done in the state x: nothing
depends on the choice of xi in (22).
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers, positive, show, vector
from drake_dae.dae.manifold import coordinates
from drake_dae.dae.pinned_motion import PinnedMotion, PinnedOutputs, PinnedSet, TimeFunction, follow
from drake_dae.dae.stability import (
    ROUNDED,
    PeriodicMotions,
    Stability,
    StabilityAlong,
    Verdict,
    balanced_matrix,
    judge,
    linearized_eigenvalues,
    without_dynamics,
)
from drake_dae.dae.structure import Structure, find_structure, structure_of
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.numerics import DEPENDENT, ROUND_OFF, NewtonModel, newton, shortest_steps

AT_REST = 1e-8  # A state is at rest if the terms of E x' cancel to this, relative to their sizes.
ISOLATED = 1e-6  # An equilibrium is known to this distance, relative to the scale of the states.
# The distance, relative to the scale, within which the slopes must be nearly constant.
NEARBY = 1e-5
SAME = 0.5  # The allowed relative change of the slopes there: then Newton's method contracts.


@checked(ModelError)
class ZeroDynamics:
    """The dynamics (35) that remain if the outputs are pinned to a reference.

    In all methods states have shape (n,), outputs z shape (p,); `reference` is R = (r_1, r_1',
    ..., r_1^(mu_1), r_2, ...), shape (sum (mu_i + 1),), as for `TrackingLaw`; `guess` is a state,
    the nominal one if None; and `parameters` are values of all parameters, the defaults if None.

    Args:
        system: The system (1)-(3).
        structure: The structure of the system; found if None.

    Attributes:
        dimension: dim xi = n - sum r_i - sum mu_i.
        residual_signals: What is zero on Z(R): the constraints, then the output errors, each with
            its derivatives.
    """

    def __init__(self, system: DaeSystem, *, structure: Structure | None = None) -> None:
        self.structure = structure = structure_of(system, structure, find_structure)
        self.system, self.dimension = system, structure.zero_dynamics_dimension
        self._pinned = PinnedOutputs(structure)
        self.residual_signals = self._pinned.residual_signals
        examined = np.abs(structure.states).max(axis=0)
        self._sizes = np.maximum(examined, system.spread_around(system.nominal_state))

    def __repr__(self) -> str:
        return f"ZeroDynamics('{self.system.name}', dimension={self.dimension})"

    @checked(ModelError)
    def state(
        self,
        reference: ArrayLike,
        guess: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
    ) -> FloatArray:
        """Returns a state on Z(R), to round-off, by Newton's method from a guess.

        Raises:
            InconsistentStateError: Newton's method does not reach Z(R) from there.
        """
        goal = self._vector("reference", reference, self._pinned.layout.reference_size)
        pinned = PinnedSet(self._pinned, goal, self.system.parameter_vector(parameters))
        return pinned.state(self._guess(guess))

    @checked(ModelError)
    def motion(
        self,
        reference: TimeFunction,
        times: ArrayLike,
        guess: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
        exogenous: Sequence[Any] = (),
    ) -> PinnedMotion:
        """Computes the motion on Z(R(t)) from a state close to the guess, until it ends.

        Without zero dynamics each state follows from the one before by Newton's method. Else
        x' = f* + h* u is integrated (Radau IIA of order 5) and projected after each step. Why it
        ends before the last time is in `PinnedMotion.ending`.

        Args:
            reference: The function t -> R(t); it is also evaluated between the times.
            times: Times in s, increasing, shape (k,).
            guess: A state near the first one; it decides which of several solutions is followed.
            exogenous: The references of the exogenous signals; without any they stand still.

        Raises:
            ReferenceSignalError: An exogenous signal is not smooth enough.
            ModelError: A shape is wrong, or the times do not increase.
        """
        grid = self._vector("times", times)
        if grid.size == 0 or np.any(np.diff(grid) <= 0.0):
            raise ModelError(f"{self.system.name}: times must increase, got {times!r}")
        start, p = self._guess(guess), self.system.parameter_vector(parameters)
        return follow(self._pinned, reference, grid, start, self._moving(p, exogenous))

    @checked(ModelError)
    def stability(
        self,
        state: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
        outputs: ArrayLike | None = None,
    ) -> Stability:
        """Judges by linearization whether Assumption 2.2 holds near an equilibrium.

        The derivative of f* + h* u(x, R) maps the tangent space of Z(R) into itself; its
        eigenvalues there decide, of a linear system its invariant zeros.

        Args:
            state: The initial guess of the equilibrium.
            outputs: z at the equilibrium. If None those of the state, where outputs with mu_i = 0,
                which depend on the control, are as brings it nearest to rest.

        Raises:
            InconsistentStateError: The state is not near N*.
        """
        if self.dimension == 0:
            return without_dynamics(self.structure)
        p = self.system.parameter_vector(parameters)
        start = self.structure.manifold.project(self._guess(state), p)
        pinned = self._resting(start, outputs, p)
        try:
            rest, degenerate = self._at_rest(pinned, start, regular=False)
        except InconsistentStateError as error:
            return Stability(Verdict.UNDECIDED, str(error))
        values, errors = linearized_eigenvalues(pinned, self._sizes, rest)
        where = "at rest" if degenerate else "at the equilibrium"
        return judge(values, errors, rest, f"{where} with {pinned.describe()}", degenerate)

    @checked(ModelError)
    def equilibria(
        self,
        guesses: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
        outputs: ArrayLike | None = None,
    ) -> FloatArray:
        """Returns states at rest, x' = 0, with constant outputs, found from guesses, shape (l, n).

        The Jacobian is not singular there: of states at rest that are not isolated none is
        returned. The guesses have shape (k, n), `structure.states` if None; if `outputs` are None,
        those of the first guess are taken, which must be near N*.
        """
        p = self.system.parameter_vector(parameters)
        rows = self.structure.states if guesses is None else numbers("guesses", guesses)
        starts = [self._guess(row) for row in np.atleast_2d(rows)]
        first = starts[0] if outputs is not None else self.structure.manifold.project(starts[0], p)
        pinned = self._resting(first, outputs, p)
        distinct = np.zeros((0, self.system.num_states))
        for start in starts:
            try:
                rest, _ = self._at_rest(pinned, start)
            except InconsistentStateError:
                continue
            sizes = np.maximum(self._sizes, np.abs(rest))
            if not np.any(np.all(np.abs(distinct - rest) <= ISOLATED * sizes, axis=1)):
                distinct = np.vstack([distinct, rest])
        return distinct

    @checked(ModelError)
    def stability_along(
        self,
        reference: TimeFunction,
        motion: PinnedMotion,
        period: float,
        parameters: ArrayLike | None = None,
        exogenous: Sequence[Any] = (),
    ) -> StabilityAlong:
        """Judges by Floquet multipliers whether Assumption 2.2 holds along a periodic reference.

        The motion with the same period is sought by Newton's method from the given one. The
        multipliers are the eigenvalues of the matrix that takes small disturbances of it,
        delta' = (dx'/dx) delta on Z(R(t)), through one period.

        Args:
            reference, exogenous: As for `motion`.
            motion: The result of `motion` for this reference.
            period: The period of R(t) and of the exogenous signals, in s.

        Raises:
            ModelError: The period is not one of the reference.
        """
        period = positive(f"{self.system.name}: period", period)
        if self.dimension == 0:
            at_rest = without_dynamics(self.structure)
            return StabilityAlong(at_rest.verdict, at_rest.reason, period)
        p = self.system.parameter_vector(parameters)
        at = partial(self._pinned.at_time, reference, self._moving(p, exogenous))
        return PeriodicMotions(at, self._sizes, period).judge(motion)

    def _moving(
        self, parameters: FloatArray, exogenous: Sequence[Any]
    ) -> Callable[[float], FloatArray]:
        """Returns the function t -> values of all parameters."""
        if not exogenous:
            return lambda time: parameters
        system = self.system
        degrees = system.exogenous.degrees(*self._pinned.expressions)
        ends = np.cumsum([0, *(reference.size for reference in exogenous)])
        if ends[-1] != len(degrees):
            raise ModelError(
                f"{system.name}: exogenous covers {ends[-1]} signals, the system has {len(degrees)}"
            )
        signals = [
            reference.derivatives(degrees[first:last])
            for reference, (first, last) in zip(exogenous, pairwise(ends), strict=True)
        ]
        places = system.exogenous.places(degrees)

        def at(time: float) -> FloatArray:
            values = parameters.copy()
            values[places] = np.concatenate([signal(time) for signal in signals])
            return values

        return at

    def _vector(self, what: str, value: ArrayLike, size: int | None = None) -> FloatArray:
        return vector(f"{self.system.name}: {what}", np.ravel(value), size)

    def _guess(self, guess: ArrayLike | None) -> FloatArray:
        nominal = self.system.nominal_state
        return self._vector("state", nominal if guess is None else guess, nominal.size)

    def _resting(
        self, state: FloatArray, outputs: ArrayLike | None, parameters: FloatArray
    ) -> PinnedSet:
        """Returns Z(R) with constant outputs; with those of the state if None."""
        layout, scale = self._pinned.layout, self.system.scale
        if outputs is not None:
            goal = layout.constant(self._vector("outputs", outputs, self.system.num_outputs))
            return PinnedSet(self._pinned, goal, parameters)
        reference = np.zeros(layout.reference_size)
        pinned = PinnedSet(self._pinned, reference, parameters)
        if layout.chain_size:
            chain = pinned.residual(state)[-layout.chain_size :]
            reference[layout.lowest[layout.dynamic]] = chain[layout.heads]
        direct = layout.lowest[layout.direct]
        if direct.size:
            still, by = np.zeros((state.size, direct.size)), np.eye(reference.size)[:, direct]
            slopes, rate = pinned.slopes(state, still, by), pinned.rate(state)
            if np.all(np.isfinite(slopes)) and np.all(np.isfinite(rate)):
                inverse = np.linalg.pinv(slopes / scale[:, None], DEPENDENT)
                reference[direct] = -inverse @ (rate / scale)
        return pinned

    def _at_rest(
        self, pinned: PinnedSet, guess: FloatArray, regular: bool = True
    ) -> tuple[FloatArray, int]:
        """Returns a state at rest, by Newton's method for C(x) = 0 and T^T x' = 0 from a guess.

        T spans the tangent space of Z(R). Also returns the number of directions in which the
        Jacobian is singular at the state, where steps are shortest; none if it must be regular.
        """
        system, scale = self.system, self.system.scale

        def linearize(z: FloatArray) -> NewtonModel | None:
            gradients = pinned.gradients(scale * z) * scale
            onto = shortest_steps(gradients, lambda z: pinned.residual(scale * z))
            slopes = pinned.slopes(scale * z) * scale / scale[:, None]
            if onto is None or not np.all(np.isfinite(slopes)):
                return None
            basis = scipy.linalg.null_space(gradients)
            along = basis.T @ slopes @ basis
            size = np.linalg.norm(balanced_matrix(slopes)[0], 2)
            noise = ROUND_OFF * float(size) / (np.linalg.norm(along) or 1.0)
            inner = basis @ np.linalg.pinv(along, noise) @ basis.T

            def step(z: FloatArray) -> FloatArray:
                across = onto.step(z)
                return across - inner @ (pinned.rate(scale * z) / scale + slopes @ across)

            return NewtonModel(step, onto.is_regular)

        z, converged = newton(pinned.state(guess) / scale, linearize)
        point = pinned.point(scale * z)
        unrest, degenerate = point.flaw, 0
        if not unrest:
            slow = np.abs(point.rate) <= AT_REST * np.abs(pinned.slopes(point.state)) @ self._sizes
            worst = int(np.argmax(np.where(slow, 0.0, point.unrest)))
            if not slow[worst] and point.unrest[worst] > AT_REST:
                unrest = f"{system.state_signals[worst].name}' = {point.rate[worst]:.3g}"
        if not converged:
            unrest = unrest or "the rates are small and do not vanish"
        if not unrest:
            degenerate = self._degenerate(pinned, point.state)
            unrest = "the Jacobian is singular" if regular and degenerate else ""
        if unrest:
            raise InconsistentStateError(
                f"{system.name}: {pinned.describe()} have no regular state at rest near the given "
                f"one: the search ends at x = {show(point.state)}, where {unrest}",
                point.rate,
            )
        return point.state, degenerate

    @np.errstate(all="ignore")  # The domain may end near the state.
    def _degenerate(self, pinned: PinnedSet, state: FloatArray) -> int:
        """The number of directions on Z(R) in which the Jacobian isolates no equilibrium."""
        scale = self.system.scale
        free, moved = coordinates(pinned.gradients(state), scale)

        def slopes_at(x: FloatArray) -> FloatArray:
            slopes = pinned.slopes(x) @ moved
            return np.asarray(slopes[free] * scale[free] / scale[free][:, None])

        slopes, rate = slopes_at(state), (pinned.rate(state) / scale)[free]
        if not (np.all(np.isfinite(slopes)) and np.all(np.isfinite(rate))):
            return free.size
        left, sizes, right = np.linalg.svd(slopes)
        terms = np.abs(pinned.slopes(state)) @ np.abs(state)
        rates = np.abs(left.T @ rate) + ROUNDED * np.abs(left.T) @ (terms / scale)[free]
        count = 0
        for u, size, v, rest in zip(left.T, sizes, right, rates, strict=True):
            along = moved @ (scale[free] * v)
            along *= NEARBY / np.max(np.abs(along) / scale)
            change = [abs(u @ (slopes_at(state + x) - slopes) @ v) for x in (along, -along)]
            count += not (size > 0.0 and rest <= ISOLATED * size and max(change) <= SAME * size)
        return count
