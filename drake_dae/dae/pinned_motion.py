"""The motion with the outputs on a reference, and why it ends, as values.          (35)-(36)"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum

import numpy as np
import scipy  # SciPy loads its large parts when they are used.

from drake_dae.arrays import FloatArray, numbers, show
from drake_dae.dae.pinned_outputs import PinnedOutputs, PinnedPoint, PinnedSet
from drake_dae.errors import InconsistentStateError, ModelError, NonFiniteError
from drake_dae.trace.expressions import result_of

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

TimeFunction = Callable[[float], FloatArray]
"""t -> R(t) = (r_1, r_1', ..., r_1^(mu_1), r_2, ...), or t -> values of all parameters."""


class EndCause(Enum):
    """The causes for the end of a motion with pinned outputs; the enum value is a description."""

    NO_START = "no state has the outputs that the reference begins with"
    SINGULAR_START = "A(x) or B(x) is singular at the start, or the domain of the system ends"
    REFERENCE_NOT_FINITE = "the reference is not finite"
    UNBOUNDED = "the internal states grow without bound while the outputs follow"
    TOO_FAST = "the motion is too fast to be followed so far"
    NO_WAY_ON = (
        "no state that continues the motion is found: the reference jumps, or the domain of the "
        "system ends"
    )
    OUT_OF_REACH = "the reference leaves what the system can reach"
    SINGULAR = "the control would be unbounded. Lead the reference around"


@dataclass(frozen=True, eq=False)
class MotionEnd:
    """The end of a motion with pinned outputs: its cause, time in s, text and last state."""

    cause: EndCause
    time: float
    text: str
    state: FloatArray | None = None
    matrix: str = ""

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, eq=False)
class PinnedMotion:
    """The motion with the outputs on a reference, until the last time or until it ends."""

    times: FloatArray
    states: FloatArray
    controls: FloatArray
    constraint_inputs: FloatArray
    parameters: FloatArray
    constraint_margins: FloatArray
    control_margins: FloatArray
    ending: MotionEnd | None


class _Ended(Exception):
    """Raised where a motion ends."""

    def __init__(self, *values: object) -> None:
        self.ending = MotionEnd(*values)  # type: ignore[arg-type]
        super().__init__(self.ending.text)


def follow(
    pinned: PinnedOutputs,
    reference: TimeFunction,
    times: FloatArray,
    guess: FloatArray,
    parameters: TimeFunction,
) -> PinnedMotion:
    """Computes the motion on Z(R(t)) from a state close to a guess; see `ZeroDynamics.motion`."""
    points: list[PinnedPoint] = []
    ending = None
    try:
        with np.errstate(all="ignore"):  # States outside the domain are tried and rejected.
            follower = _Follower(pinned, reference, parameters, times.tolist(), guess)
            for point in follower.points():
                points.append(point)
    except _Ended as end:
        ending = end.ending
    system, count = pinned.system, len(points)
    margins = np.array([point.margins for point in points]).reshape(count, 2)

    def rows(values: list[FloatArray], width: int) -> FloatArray:
        return np.array(values).reshape(count, width)

    return PinnedMotion(
        times[:count],
        rows([point.state for point in points], system.num_states),
        rows([point.control for point in points], system.num_controls),
        rows([point.constraint_input for point in points], system.num_constraints),
        rows([parameters(time) for time in times[:count]], system.parameter_symbol.numel()),
        margins[:, 0],
        margins[:, 1],
        ending,
    )


class _Follower:
    """Follows a reference from point to point; raises _Ended where the motion ends."""

    def __init__(
        self,
        pinned: PinnedOutputs,
        reference: TimeFunction,
        parameters: TimeFunction,
        times: list[float],
        guess: FloatArray,
    ) -> None:
        self._pinned, self._reference, self._parameters = pinned, reference, parameters
        self._system, self._times, self._time = pinned.system, times, times[0]
        self._remaining = MOST_STEPS + len(times)
        first, when = self._at(self._time), f"t = {self._time:.6g} s"
        try:
            start = first.state(guess)
        except InconsistentStateError as error:
            raise _Ended(EndCause.NO_START, self._time, f"{error} ({when})") from error
        self._last = first.point(start)
        if first.flaw(self._last):
            text = f"at the start, {when}, x = {show(start)}: {EndCause.SINGULAR_START.value}"
            raise self._stop(EndCause.SINGULAR_START, text)
        self._largest = self._last.margins

    def points(self) -> Iterator[PinnedPoint]:
        """Yields the points of the motion, one for each time."""
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
        scale = self._system.scale
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
                    name = self._system.state_signals[worst].name
                    value = f"{name} = {integrator.y[worst]:.3g} at t = {integrator.t:.6g} s"
                    raise self._stop(EndCause.UNBOUNDED, f"{EndCause.UNBOUNDED.value}: {value}")
                if self._reach(integrator.t, integrator.y):
                    integrator.y, integrator.f = self._last.state.copy(), self._last.rate.copy()
                else:
                    step = 0.5 * (integrator.t - self._time)
                    self._check_step(step, interval)
                    integrator = self._integrator(end, step)
            yield self._last

    def _integrator(self, end: float, step: float | None = None) -> "scipy.integrate.Radau":
        """An integrator of x' = f* + h* u from the last point."""

        def slopes(time: float, state: FloatArray) -> FloatArray:
            matrix = self._at(time).slopes(state)
            if not np.all(np.isfinite(matrix)):
                raise self._end(time - self._time)
            return matrix

        return scipy.integrate.Radau(
            lambda time, state: self._at(time).rate(state),
            self._time,
            self._last.state,
            end,
            rtol=TOLERANCE,
            atol=0.01 * TOLERANCE * self._system.scale,
            jac=slopes,
            first_step=step,
        )

    def _at(self, time: float) -> PinnedSet:
        """Z(R) at a time; the motion ends where R is not finite."""
        layout, cause = self._pinned.layout, EndCause.REFERENCE_NOT_FINITE
        try:
            value = result_of("reference", self._reference, time)
            goal = numbers(f"reference({time:g})", value).reshape(-1)
        except NonFiniteError as error:
            raise _Ended(cause, time, str(error)) from error
        if goal.size != layout.reference_size:
            raise ModelError(
                f"{self._system.name}: the reference must have size {layout.reference_size} (each "
                f"output and its derivatives up to its degree {layout.degrees}), got {goal.size}"
            )
        if not np.all(np.isfinite(goal)):
            raise _Ended(cause, time, f"{self._system.name}: {cause.value} at t = {time:.6g} s")
        return self._pinned.at(goal, self._parameters(time))

    def _reach(self, time: float, state: FloatArray) -> bool:
        """Moves to the projected state, unless it is on another branch; returns whether it did."""
        last = self._last
        self._remaining -= 1
        if self._remaining < 0:
            text = f"after {MOST_STEPS} steps, at t = {self._time:.6g} s: {EndCause.TOO_FAST.value}"
            raise self._stop(EndCause.TOO_FAST, text)
        pinned = self._at(time)
        projected, converged = pinned.project(state)
        near = JUMP * np.maximum(self._system.scale, np.abs(last.state)) + np.abs(
            state - last.state
        )
        if not converged or np.any(np.abs(projected - state) > near):
            return False
        point = pinned.point(projected)
        if pinned.flaw(point) or point.signs != last.signs:
            return False
        (a, b), (c, d) = self._largest, point.margins
        self._time, self._last, self._largest = time, point, (max(a, c), max(b, d))
        return True

    def _check_step(self, step: float, interval: float) -> None:
        if step < SHORTEST * interval:
            raise self._end(0.1 * interval)

    def _end(self, ahead: float) -> _Ended:
        """Why the motion ends at the last point, also by the reference `ahead` seconds."""
        last, system, when = self._last, self._system, f"at t = {self._time:.6g} s"
        shares = [
            now / largest if largest < np.inf else 1.0
            for now, largest in zip(last.margins, self._largest, strict=True)
        ]
        which = int(np.argmin(shares))
        if shares[which] > LOST:
            # At an infinite state within a finite time a rate is so large that the state would have
            # grown by `GROWN` in the elapsed time; it may still be small, as for x' = exp(x).
            whole = self._times[-1] - self._times[0]
            elapsed = max(self._time - self._times[0], SHORTEST * whole)
            size = np.maximum(1.0, np.abs(last.state) / system.scale)
            rates = np.abs(last.rate) / system.scale * elapsed / size
            worst = int(np.argmax(rates))
            cause, where = EndCause.NO_WAY_ON, f"{when}, x = {show(last.state)}"
            if rates[worst] > GROWN:
                cause = EndCause.UNBOUNDED
                where = f"{system.state_signals[worst].name}' = {last.rate[worst]:.3g} {when}"
            return self._stop(cause, f"{cause.value}: {where}")
        ahead = min(ahead, self._times[-1] - self._time)
        pinned = self._at(self._time + ahead)
        guesses = last.state, last.state + ahead * last.rate
        beyond = any(pinned.project(guess)[1] for guess in guesses)
        matrix, margin = "AB"[which], f"{last.margins[which]:.2g}"
        singular = f"{matrix}(x) becomes singular, smallest singular value {margin}"
        if beyond:
            text = f"{when} {singular}: {EndCause.SINGULAR.value}"
            return self._stop(EndCause.SINGULAR, text, matrix)
        text = f"{EndCause.OUT_OF_REACH.value} {when}: {singular}"
        return self._stop(EndCause.OUT_OF_REACH, text, matrix)

    def _stop(self, cause: EndCause, text: str, matrix: str = "") -> _Ended:
        """The end of the motion at the last point."""
        return _Ended(cause, self._time, f"{self._system.name}: {text}", self._last.state, matrix)
