"""Motions with the outputs on a reference.                                          (35)-(36)"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy.integrate

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.zero_dynamics.pinned_outputs import PinnedOutputs, Point
from drake_dae.errors import InconsistentStateError, ModelError, NonFiniteError

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


LOST = 1e-2
"""A margin below this part of its largest value on the way tends to zero."""


Reference = Callable[[float], FloatArray]
"""t -> R(t) = (r_1, r_1', ..., r_1^(mu_1), r_2, ...), shape (sum (mu_i + 1),)."""


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


def follow(
    pinned: PinnedOutputs,
    reference: Reference,
    times: FloatArray,
    guess: FloatArray,
    parameters: FloatArray,
) -> PinnedMotion:
    """The motion on Z(R(t)) from a state next to a guess; see `ZeroDynamics.motion`."""
    points: list[Point] = []
    failure, failure_time = "", None
    try:
        with np.errstate(all="ignore"):  # States out of the domain are tried, and refused.
            pursuit = _Pursuit(pinned, reference, parameters, times.tolist(), guess)
            for point in pursuit.points():
                points.append(point)
    except _MotionEnd as end:
        failure, failure_time = str(end), end.time
    system, count = pinned.system, len(points)

    def column(values: list[FloatArray], width: int) -> FloatArray:
        return np.array(values).reshape(count, width)

    margins = column([np.array(point.margins) for point in points], 2)
    return PinnedMotion(
        times=times[:count],
        states=column([point.state for point in points], system.num_states),
        controls=column([point.control for point in points], system.num_controls),
        constraint_inputs=column(
            [point.constraint_input for point in points], system.num_constraints
        ),
        constraint_margins=margins[:, 0],
        control_margins=margins[:, 1],
        failure=failure,
        failure_time=failure_time,
    )


class _MotionEnd(Exception):
    """A motion does not go on."""

    def __init__(self, message: str, time: float) -> None:
        super().__init__(message)
        self.time = time


class _Pursuit:
    """Follows a reference from point to point; raises _MotionEnd where that ends."""

    def __init__(
        self,
        pinned: PinnedOutputs,
        reference: Reference,
        parameters: FloatArray,
        times: list[float],
        guess: FloatArray,
    ) -> None:
        self._pinned = pinned
        self._reference = reference
        self._parameters = parameters
        self._times = times
        self._remaining = STEPS + len(times)
        self._name = pinned.system.name
        self._time = times[0]
        goal, when = self._goal(self._time), f"t = {self._time:.6g} s"
        try:
            start = pinned.state(goal, guess, parameters)
        except InconsistentStateError as error:
            raise _MotionEnd(f"{error} ({when})", self._time) from error
        self._last = pinned.point(start, goal, parameters)
        if pinned.flaw(self._last):
            raise _MotionEnd(
                f"{self._name}: at the start, {when}, x = {show(start)}, A(x) or B(x) is singular, "
                "or the domain of the system ends",
                self._time,
            )
        self._largest = self._last.margins

    def points(self) -> Iterator[Point]:
        """One for each time."""
        yield self._last
        has_dynamics = self._pinned.structure.zero_dynamics_dimension > 0
        yield from self._integrate() if has_dynamics else self._continue()

    def _continue(self) -> Iterator[Point]:
        """Without zero dynamics: predictor and Newton's method."""
        step, change = np.inf, np.zeros(self._last.state.size)
        for end in self._times[1:]:
            interval = end - self._time
            while self._time < end:
                step = min(step, end - self._time)
                time = end if step == end - self._time else self._time + step
                before = self._last
                # Adams and Bashforth: x' and its change since the step before.
                predicted = before.state + step * (before.rate + 0.5 * step * change)
                if self._reach(time, predicted):
                    change = (self._last.rate - before.rate) / step
                    step *= 2.0
                else:
                    step *= 0.5
                    self._check_step(step, interval)
            yield self._last

    def _integrate(self) -> Iterator[Point]:
        """With zero dynamics: an implicit integrator, since they may be stiff."""
        bound = GROWN * max(1.0, float(np.max(np.abs(self._last.state))))
        integrator = None
        for end in self._times[1:]:
            interval = end - self._time
            integrator = integrator or self._integrator(end)
            integrator.t_bound, integrator.status = end, "running"
            while self._time < end:
                integrator.step()
                if integrator.status == "failed":
                    raise self._end(0.1 * interval)
                worst = int(np.argmax(np.abs(integrator.y)))
                if abs(integrator.y[worst]) > bound:
                    raise _MotionEnd(
                        f"{self._name}: the internal states grow without bound while the outputs "
                        f"follow: {self._pinned.system.state_signals[worst].name} = "
                        f"{integrator.y[worst]:.3g} at t = {integrator.t:.6g} s",
                        self._time,
                    )
                if self._reach(integrator.t, integrator.y):
                    integrator.y, integrator.f = self._last.state.copy(), self._last.rate.copy()
                else:
                    step = 0.5 * (integrator.t - self._time)
                    self._check_step(step, interval)
                    integrator = self._integrator(end, step)
            yield self._last

    def _integrator(self, end: float, step: float | None = None) -> scipy.integrate.Radau:
        """Of x' = f* + h* u from the last point."""

        def rate(time: float, state: FloatArray) -> FloatArray:
            return self._pinned.rate(state, self._goal(time), self._parameters)

        def slopes(time: float, state: FloatArray) -> FloatArray:
            matrix = self._pinned.slopes(state, self._goal(time), self._parameters)[0]
            if not np.all(np.isfinite(matrix)):
                raise self._end(time - self._time)
            return matrix

        return scipy.integrate.Radau(
            rate,
            self._time,
            self._last.state,
            end,
            rtol=TOLERANCE,
            atol=0.01 * TOLERANCE,
            jac=slopes,
            first_step=step,
        )

    def _goal(self, time: float) -> FloatArray:
        """R(t)."""
        size, degrees = self._pinned.size, self._pinned.structure.output_degrees
        try:
            goal = np.asarray(self._reference(time), dtype=float).reshape(-1)
        except NonFiniteError as error:
            raise _MotionEnd(str(error), time) from error
        if goal.size != size:
            raise ModelError(
                f"{self._name}: the reference must have size {size} (each output and its "
                f"derivatives up to its degree {degrees}), got {goal.size}"
            )
        if not np.all(np.isfinite(goal)):
            raise _MotionEnd(f"{self._name}: the reference is not finite at t = {time:.6g} s", time)
        return goal

    def _reach(self, time: float, state: FloatArray) -> bool:
        """Goes on to the point next to a state, unless it is on another branch than the last."""
        last = self._last
        self._remaining -= 1
        if self._remaining < 0:
            raise _MotionEnd(
                f"{self._name}: after {STEPS} steps the motion is at t = {self._time:.6g} s; it is "
                "too fast to be followed so far",
                self._time,
            )
        goal = self._goal(time)
        found, converged = self._pinned.project(state, goal, self._parameters)
        near = JUMP * np.maximum(1.0, np.abs(last.state)) + np.abs(state - last.state)
        if not converged or np.any(np.abs(found - state) > near):
            return False
        point = self._pinned.point(found, goal, self._parameters)
        if self._pinned.flaw(point) or point.signs != last.signs:
            return False
        (a, b), (c, d) = self._largest, point.margins
        self._time, self._last, self._largest = time, point, (max(a, c), max(b, d))
        return True

    def _check_step(self, step: float, interval: float) -> None:
        if step < SHORTEST * interval:
            raise self._end(0.1 * interval)

    def _end(self, ahead: float) -> _MotionEnd:
        """Why there is no way on from the last point, with a look at the goal ahead of it."""
        last, when = self._last, f"t = {self._time:.6g} s"
        shares = [
            now / largest if largest < np.inf else 1.0
            for now, largest in zip(last.margins, self._largest, strict=True)
        ]
        which = int(np.argmin(shares))
        if shares[which] > LOST:
            why = (
                f"no state that continues the motion is found beyond {when}, x = "
                f"{show(last.state)}: the reference jumps, or the domain of the system ends"
            )
            return _MotionEnd(f"{self._name}: {why}", self._time)
        ahead = min(ahead, self._times[-1] - self._time)
        goal = self._goal(self._time + ahead)
        beyond = any(
            self._pinned.project(guess, goal, self._parameters)[1]
            for guess in (last.state, last.state + ahead * last.rate)
        )
        smallest = f"smallest singular value {last.margins[which]:.2g}"
        singular = f"{'AB'[which]}(x) becomes singular, {smallest}"
        if beyond:
            why = f"at {when} {singular}: the control would be unbounded. Lead the reference around"
        else:
            why = f"the reference leaves what the system can reach at {when}: {singular}"
        return _MotionEnd(f"{self._name}: {why}", self._time)
