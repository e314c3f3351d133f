"""Motions with the outputs on a reference.                                          (35)-(36)"""

from collections.abc import Callable, Iterator

import numpy as np
import scipy  # SciPy loads its large parts when they are used.

from drake_dae.arrays import FloatArray, numbers, show
from drake_dae.dae.zero_dynamics.pinned.pinned_motion import EndCause, MotionEnd, PinnedMotion
from drake_dae.dae.zero_dynamics.pinned.pinned_outputs import PinnedOutputs
from drake_dae.dae.zero_dynamics.pinned.pinned_point import PinnedPoint, Regularity
from drake_dae.errors import InconsistentStateError, ModelError, NonFiniteError
from drake_dae.trace.given import result_of

TOLERANCE = 1e-6
"""The tolerance of an integration step; the method overestimates its error by two orders."""


SHORTEST = 1e-6
"""The smallest step, as a fraction of a time step, at which the motion ends."""


JUMP = 0.1
"""A correction above this, relative to the state, may lead to another solution."""


MOST_STEPS = 20_000
"""The largest number of steps of one motion, besides its given times."""


GROWN = 1e8
"""A state that has grown by this factor grows without bound."""


LOST = 1e-2
"""A margin below this fraction of its largest value along the motion counts as tending to zero."""


Reference = Callable[[float], FloatArray]
"""A function t -> R(t) = (r_1, r_1', ..., r_1^(mu_1), r_2, ...), shape (sum (mu_i + 1),)."""


def follow(
    pinned: PinnedOutputs,
    reference: Reference,
    times: FloatArray,
    guess: FloatArray,
    parameters: Callable[[float], FloatArray],
) -> PinnedMotion:
    """Computes the motion on Z(R(t)) from a state close to a guess; see `ZeroDynamics.motion`.

    Args:
        pinned: The system with its outputs pinned.
        reference: The function t -> R(t).
        times: Times in s, increasing, shape (k,).
        guess: A state near the first one, shape (n,).
        parameters: The function t -> values of all parameters.
    """
    points: list[PinnedPoint] = []
    ending = None
    try:
        with np.errstate(all="ignore"):  # States outside the domain are tried and rejected.
            pursuit = _Pursuit(pinned, reference, parameters, times.tolist(), guess)
            for point in pursuit.points():
                points.append(point)
    except _MotionEnded as end:
        ending = end.ending
    system, count = pinned.system, len(points)

    def column(values: list[FloatArray], width: int) -> FloatArray:
        return np.array(values).reshape(count, width)

    parameter_count = system.parameter_symbol.numel()
    margins = column([np.array(point.margins) for point in points], 2)
    return PinnedMotion(
        times=times[:count],
        states=column([point.state for point in points], system.num_states),
        controls=column([point.control for point in points], system.num_controls),
        constraint_inputs=column(
            [point.constraint_input for point in points], system.num_constraints
        ),
        parameters=column([parameters(time) for time in times[:count]], parameter_count),
        constraint_margins=margins[:, 0],
        control_margins=margins[:, 1],
        ending=ending,
    )


class _MotionEnded(Exception):
    """The exception at the end of a motion with pinned outputs."""

    def __init__(self, ending: MotionEnd) -> None:
        super().__init__(str(ending))
        self.ending = ending


class _Pursuit:
    """Follows a reference from point to point. It raises _MotionEnded where the motion ends."""

    def __init__(
        self,
        pinned: PinnedOutputs,
        reference: Reference,
        parameters: Callable[[float], FloatArray],
        times: list[float],
        guess: FloatArray,
    ) -> None:
        self._pinned = pinned
        self._reference = reference
        self._parameters = parameters
        self._times = times
        self._remaining = MOST_STEPS + len(times)
        self._name = pinned.system.name
        self._time = times[0]
        goal, when = self._goal(self._time), f"t = {self._time:.6g} s"
        try:
            start = pinned.state(goal, guess, parameters(self._time))
        except InconsistentStateError as error:
            ending = MotionEnd(EndCause.NO_START, self._time, f"{error} ({when})")
            raise _MotionEnded(ending) from error
        self._last = pinned.point(start, goal, parameters(self._time))
        if pinned.regularity(self._last) is not Regularity.REGULAR:
            text = (
                f"{self._name}: at the start, {when}, x = {show(start)}, A(x) or B(x) is singular, "
                "or the domain of the system ends"
            )
            raise _MotionEnded(MotionEnd(EndCause.SINGULAR_START, self._time, text, start))
        self._largest = self._last.margins

    def points(self) -> Iterator[PinnedPoint]:
        """The points of the motion, one for each time."""
        yield self._last
        has_dynamics = self._pinned.structure.zero_dynamics_dimension > 0
        yield from self._integrate() if has_dynamics else self._continue()

    def _continue(self) -> Iterator[PinnedPoint]:
        """Continues without zero dynamics, by a predictor and Newton's method."""
        step, change = np.inf, np.zeros(self._last.state.size)
        for end in self._times[1:]:
            interval = end - self._time
            while self._time < end:
                step = min(step, end - self._time)
                time = end if step == end - self._time else self._time + step
                before = self._last
                # Adams-Bashforth: x' and its change since the previous step.
                predicted = before.state + step * (before.rate + 0.5 * step * change)
                if self._reach(time, predicted):
                    change = (self._last.rate - before.rate) / step
                    step *= 2.0
                else:
                    step *= 0.5
                    self._check_step(step, interval)
            yield self._last

    def _integrate(self) -> Iterator[PinnedPoint]:
        """Continues with zero dynamics, by an implicit integrator, since they may be stiff."""
        scale = self._pinned.system.scale
        bound = GROWN * max(1.0, float(np.max(np.abs(self._last.state) / scale)))
        integrator = None
        for end in self._times[1:]:
            interval = end - self._time
            integrator = integrator or self._integrator(end)
            integrator.t_bound, integrator.status = end, "running"
            while self._time < end:
                integrator.step()
                if integrator.status == "failed":
                    raise self._end(0.1 * interval)
                worst = int(np.argmax(np.abs(integrator.y) / scale))
                if abs(integrator.y[worst]) > bound * scale[worst]:
                    raise self._stop(
                        EndCause.UNBOUNDED,
                        f"{self._name}: {EndCause.UNBOUNDED.value}: "
                        f"{self._pinned.system.state_signals[worst].name} = "
                        f"{integrator.y[worst]:.3g} at t = {integrator.t:.6g} s",
                    )
                if self._reach(integrator.t, integrator.y):
                    integrator.y, integrator.f = self._last.state.copy(), self._last.rate.copy()
                else:
                    step = 0.5 * (integrator.t - self._time)
                    self._check_step(step, interval)
                    integrator = self._integrator(end, step)
            yield self._last

    def _integrator(self, end: float, step: float | None = None) -> "scipy.integrate.Radau":
        """An integrator of x' = f* + h* u from the last point."""

        def rate(time: float, state: FloatArray) -> FloatArray:
            return self._pinned.rate(state, self._goal(time), self._parameters(time))

        def slopes(time: float, state: FloatArray) -> FloatArray:
            goal, parameters = self._goal(time), self._parameters(time)
            matrix = self._pinned.slopes(state, goal, parameters)[0]
            if not np.all(np.isfinite(matrix)):
                raise self._end(time - self._time)
            return matrix

        return scipy.integrate.Radau(
            rate,
            self._time,
            self._last.state,
            end,
            rtol=TOLERANCE,
            atol=0.01 * TOLERANCE * self._pinned.system.scale,
            jac=slopes,
            first_step=step,
        )

    def _goal(self, time: float) -> FloatArray:
        """Returns R at a time, shape (sum (mu_i + 1),); the motion ends where it is not finite."""
        layout = self._pinned.layout
        try:
            value = result_of("reference", self._reference, time)
            goal = numbers(f"reference({time:g})", value).reshape(-1)
        except NonFiniteError as error:
            ending = MotionEnd(EndCause.REFERENCE_NOT_FINITE, time, str(error))
            raise _MotionEnded(ending) from error
        if goal.size != layout.reference_size:
            raise ModelError(
                f"{self._name}: the reference must have size {layout.reference_size} (each output "
                f"and its derivatives up to its degree {layout.degrees}), got {goal.size}"
            )
        if not np.all(np.isfinite(goal)):
            text = f"{self._name}: the reference is not finite at t = {time:.6g} s"
            raise _MotionEnded(MotionEnd(EndCause.REFERENCE_NOT_FINITE, time, text))
        return goal

    def _reach(self, time: float, state: FloatArray) -> bool:
        """Moves to the projected state, unless it is on another branch; returns whether it did."""
        last = self._last
        self._remaining -= 1
        if self._remaining < 0:
            raise self._stop(
                EndCause.TOO_FAST,
                f"{self._name}: after {MOST_STEPS} steps the motion is at t = {self._time:.6g} s: "
                "it is too fast to be followed",
            )
        goal, parameters = self._goal(time), self._parameters(time)
        projected, converged = self._pinned.project(state, goal, parameters)
        near = JUMP * np.maximum(self._pinned.system.scale, np.abs(last.state)) + np.abs(
            state - last.state
        )
        if not converged or np.any(np.abs(projected - state) > near):
            return False
        point = self._pinned.point(projected, goal, parameters)
        regular = self._pinned.regularity(point) is Regularity.REGULAR
        if not regular or point.signs != last.signs:
            return False
        (a, b), (c, d) = self._largest, point.margins
        self._time, self._last, self._largest = time, point, (max(a, c), max(b, d))
        return True

    def _check_step(self, step: float, interval: float) -> None:
        if step < SHORTEST * interval:
            raise self._end(0.1 * interval)

    def _end(self, ahead: float) -> _MotionEnded:
        """Returns why the motion ends at the last point, also by the reference after it."""
        last, when = self._last, f"t = {self._time:.6g} s"
        shares = [
            now / largest if largest < np.inf else 1.0
            for now, largest in zip(last.margins, self._largest, strict=True)
        ]
        which = int(np.argmin(shares))
        if shares[which] > LOST:
            escape = self._escape()
            if escape:
                return escape
            return self._stop(
                EndCause.NO_WAY_ON,
                f"{self._name}: no state that continues the motion is found beyond {when}, x = "
                f"{show(last.state)}: the reference jumps, or the domain of the system ends",
            )
        ahead = min(ahead, self._times[-1] - self._time)
        goal, parameters = self._goal(self._time + ahead), self._parameters(self._time + ahead)
        beyond = any(
            self._pinned.project(guess, goal, parameters)[1]
            for guess in (last.state, last.state + ahead * last.rate)
        )
        matrix, smallest = "AB"[which], f"smallest singular value {last.margins[which]:.2g}"
        singular = f"{matrix}(x) becomes singular, {smallest}"
        if beyond:
            text = f"{self._name}: at {when} {singular}: {EndCause.SINGULAR.value}"
            return self._stop(EndCause.SINGULAR, text, matrix)
        text = f"{self._name}: {EndCause.OUT_OF_REACH.value} at {when}: {singular}"
        return self._stop(EndCause.OUT_OF_REACH, text, matrix)

    def _escape(self) -> _MotionEnded | None:
        """Returns the end if a state grows without bound within a finite time, else None.

        At such an end a rate is so large that the state would have grown by `GROWN` in the elapsed
        time. The state itself may still be small, as for x' = exp(x).
        """
        system, last = self._pinned.system, self._last
        elapsed = max(self._time - self._times[0], SHORTEST * (self._times[-1] - self._times[0]))
        size = np.maximum(1.0, np.abs(last.state) / system.scale)
        rates = np.abs(last.rate) / system.scale * elapsed / size
        worst = int(np.argmax(rates))
        if not rates[worst] > GROWN:
            return None
        return self._stop(
            EndCause.UNBOUNDED,
            f"{self._name}: {EndCause.UNBOUNDED.value}, within a finite time: "
            f"{system.state_signals[worst].name}' = {last.rate[worst]:.3g} at t = "
            f"{self._time:.6g} s",
        )

    def _stop(self, cause: EndCause, text: str, matrix: str = "") -> _MotionEnded:
        """Returns the end of the motion at the last point."""
        return _MotionEnded(MotionEnd(cause, self._time, text, self._last.state, matrix))
