"""Motions with pinned outputs, and the growth of their small disturbances.            (35)

To first order a disturbance delta of a state on Z(R(t)) moves by delta' = (dx'/dx) delta, with the
derivative of x' = f* + h* u at fixed R, and stays tangent to Z(R(t)). In bases T of the tangent
spaces an interval of time takes it from T_0 c to T_1 M c. Over a period of a periodic motion the
eigenvalues of M are the Floquet multipliers.
"""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import scipy  # SciPy loads its large parts when they are used.
import scipy.linalg

from drake_dae.arrays import FloatArray, vector
from drake_dae.dae.zero_dynamics.periods import find_period
from drake_dae.dae.zero_dynamics.pinned.pinned_motion import EndCause
from drake_dae.dae.zero_dynamics.pinned.pinned_outputs import PinnedOutputs
from drake_dae.dae.zero_dynamics.pursuit import GROWN, Reference
from drake_dae.trace.given import result_of

ACCURACY = 1e-9
"""The error of an integration step, relative to the scale of the states."""

MOST_STEPS = 5000
"""The largest number of steps in one interval."""

LATE, HARDLY = 200, 1e-5
"""A motion ends if LATE steps together cover less than the fraction HARDLY of a section and do not
double the state: it would take millions of them."""

SECTIONS = 16
"""The number of parts of an interval; after each, the state is projected onto Z(R) and bases are
renewed."""


class MotionLost(Exception):
    """The exception for a motion that cannot be followed to the end of an interval."""

    def __init__(self, cause: EndCause) -> None:
        super().__init__(cause.value)
        self.cause = cause


@dataclass(frozen=True, eq=False)
class StateTransition:
    """The motion of a state on Z(R) and of its small disturbances over an interval of time.

    Attributes:
        state: The state at the end, shape (n,).
        basis: T_1, of the tangent space there, orthonormal relative to the scale, shape (n, d).
        transition: M divided by exp(growth), shape (d, d); the identity if it was not computed.
        growth: The logarithm of the norm of M, the largest growth of a disturbance.
        volume: The logarithm of |det M|, the growth of volumes.
    """

    state: FloatArray
    basis: FloatArray
    transition: FloatArray
    growth: float
    volume: float


class DisturbanceFlow:
    """Integrates states on Z(R(t)) and their small disturbances.

    Args:
        pinned: Z(R).
        reference: The function t -> R(t).
        parameters: The function t -> values of all parameters.
        scale: The sizes of the states, shape (n,).
    """

    def __init__(
        self,
        pinned: PinnedOutputs,
        reference: Reference,
        parameters: Callable[[float], FloatArray],
        scale: FloatArray,
    ) -> None:
        self.pinned, self.parameters, self.scale = pinned, parameters, scale
        self._reference = reference

    def basis(self, state: FloatArray, time: float) -> FloatArray:
        """Returns the basis T of the tangent space at a state, shape (n, d)."""
        return self.pinned.tangent(state, self.parameters(time), self.scale)

    def goal(self, time: float) -> FloatArray:
        """Returns the reference vector R at a time, shape (sum (mu_i + 1),).

        Raises:
            ModelError: The reference has another size, or is not finite.
        """
        goal = np.ravel(result_of("reference", self._reference, time))
        return vector(f"reference({time:g})", goal, self.pinned.layout.reference_size)

    def period(self, begin: float, end: float) -> float | None:
        """Returns the period of reference and parameters in an interval; see `find_period`."""
        return find_period(
            lambda time: np.concatenate([self.goal(time), self.parameters(time)]), begin, end
        )

    def repeating(self, begin: float, period: float) -> "DisturbanceFlow":
        """Returns the same flow for a reference and parameters that repeat one period."""

        def within(time: float) -> float:
            return begin + (time - begin) % period

        return DisturbanceFlow(
            self.pinned,
            lambda time: self.goal(within(time)),
            lambda time: self.parameters(within(time)),
            self.scale,
        )

    def onto(self, state: FloatArray, time: float) -> FloatArray:
        """Projects a state onto Z(R(t)).

        Raises:
            MotionLost: There is none, or it is not near.
        """
        projected, converged = self.pinned.project(state, self.goal(time), self.parameters(time))
        is_near = np.abs(projected - state) <= 0.1 * (self.scale + np.abs(state))
        if not (converged and np.all(is_near)):
            raise MotionLost(EndCause.NO_WAY_ON)
        return projected

    def carry(
        self, state: FloatArray, begin: float, end: float, *, disturbed: bool = True
    ) -> StateTransition:
        """Integrates a state and its disturbances over an interval.

        Raises:
            MotionLost: The motion grows without bound, is too fast, or leaves the domain.
        """
        d = self.pinned.structure.zero_dynamics_dimension
        basis, transition, growth, volume = self.basis(state, begin), np.eye(d), 0.0, 0.0
        budget = iter(range(MOST_STEPS))
        for start, stop in _sections(begin, end):
            columns = basis if disturbed else basis[:, :0]
            for _, later, moved in self._steps(state, columns, start, stop, budget):
                state, columns = later, moved
            state = self.onto(state, stop)
            basis = self.basis(state, stop)
            if disturbed:
                scaled = (basis / self.scale[:, None]).T @ (columns / self.scale[:, None])
                transition = scaled @ transition
                size = max(float(np.linalg.norm(transition, 2)), 1e-300)
                transition, growth = transition / size, growth + float(np.log(size))
                volume += max(float(np.linalg.slogdet(scaled)[1]), -700.0)
        return StateTransition(state, basis, transition, growth, volume)

    def way(
        self, state: FloatArray, begin: float, end: float
    ) -> Iterator[tuple[float, FloatArray]]:
        """Generates the times and states after each integration step from a state.

        Raises:
            MotionLost: As `carry`.
        """
        budget = iter(range(MOST_STEPS))
        for start, stop in _sections(begin, end):
            for time, later, _ in self._steps(
                state, np.zeros((state.size, 0)), start, stop, budget
            ):
                state = later
                yield time, state
            state = self.onto(state, stop)

    def _steps(
        self,
        state: FloatArray,
        columns: FloatArray,
        begin: float,
        end: float,
        budget: Iterator[int],
    ) -> Iterator[tuple[float, FloatArray, FloatArray]]:
        """Generates the time, the state and the directions after each step of a section.

        Raises:
            MotionLost: As `carry`; also if the budget of steps is used up.
        """
        n, unit = state.size, self.scale[:, None]
        bound = GROWN * np.maximum(1.0, np.max(np.abs(state) / self.scale))

        def split(both: FloatArray) -> tuple[FloatArray, FloatArray]:
            parts = both.reshape(-1, n).T * unit
            return parts[:, 0], parts[:, 1:]

        def joined(first: FloatArray, rest: FloatArray) -> FloatArray:
            both = np.empty((1 + rest.shape[1], n))
            both[0], both[1:] = first, rest.T
            return (both / self.scale).reshape(-1)

        def rate(time: float, both: FloatArray) -> FloatArray:
            (x, along), goal, p = split(both), self.goal(time), self.parameters(time)
            moved = joined(
                self.pinned.rate(x, goal, p), self.pinned.slopes_along(x, goal, p, along)
            )
            if not np.all(np.isfinite(moved)):
                raise MotionLost(EndCause.NO_WAY_ON)
            return moved

        def slopes(time: float, both: FloatArray) -> FloatArray:
            # Without second derivatives, for which the iteration of the integrator compensates.
            goal, p = self.goal(time), self.parameters(time)
            matrix = self.pinned.slopes(split(both)[0], goal, p)[0]
            blocks = [matrix * self.scale / unit] * (1 + columns.shape[1])
            return np.asarray(scipy.linalg.block_diag(*blocks), dtype=np.float64)

        def quietly(work: Callable[[], Any]) -> Any:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # A failed step raises MotionLost.
                return work()

        y = joined(state, columns)
        solver = quietly(
            lambda: scipy.integrate.LSODA(
                rate, begin, y, end, rtol=ACCURACY, atol=ACCURACY, jac=slopes
            )
        )
        marks = [(begin, np.max(np.abs(y[:n])))]
        while solver.status == "running":
            quietly(solver.step)
            largest = np.max(np.abs(solver.y[:n]))
            if not largest <= bound:
                raise MotionLost(EndCause.UNBOUNDED)
            marks.append((solver.t, largest))
            if len(marks) > LATE:
                before, size = marks[-1 - LATE]
                if solver.t - before < HARDLY * (end - begin) and largest < 2.0 * size:
                    raise MotionLost(EndCause.TOO_FAST)
            if solver.status == "failed" or next(budget, None) is None:
                raise MotionLost(EndCause.TOO_FAST)
            yield solver.t, *split(solver.y)


def _sections(begin: float, end: float) -> Iterator[tuple[float, float]]:
    """Returns the begin and end of each section of an interval."""
    return pairwise(np.linspace(begin, end, SECTIONS + 1).tolist())
