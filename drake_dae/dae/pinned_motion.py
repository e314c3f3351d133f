"""States whose outputs are on a reference, their motion, and why it ends.      (28), (35)-(36)

Pinned outputs leave the states

    Z(R) = {x in N*: L_f*^j l*_i(x) = r_i^(j), j = 0, ..., mu_i - 1},

and the control u = B^-1 (-a + r^(mu)), which is (28) without an error; with more controls than
outputs, the system's metric chooses u. On Z(R) the state moves by x' = f* + h* u.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy  # SciPy loads its large parts when they are used.

from drake_dae.arrays import FloatArray, numbers, show
from drake_dae.dae.manifold import CONSISTENT
from drake_dae.dae.samples import as_matrix
from drake_dae.dae.structure import Structure
from drake_dae.errors import InconsistentStateError, ModelError, NonFiniteError
from drake_dae.trace.expressions import result_of
from drake_dae.trace.functions import SINGULAR_PIVOT, TracedFunction
from drake_dae.trace.numerics import (
    NewtonModel,
    newton,
    positive,
    shortest_steps,
    smallest_singular_value,
)

# A or B counts as singular below this fraction of its usual margin, also if it is a single number.
VANISHED = 1e-9
# The tolerance of an integration step; the method overestimates its error by two orders.
TOLERANCE = 1e-6
SHORTEST = 1e-6  # The smallest step, as a fraction of a time step, at which the motion ends.
JUMP = 0.1  # A correction above this, relative to the state, may lead to another solution.
MOST_STEPS = 20_000  # The largest number of steps of one motion, besides its given times.
GROWN = 1e8  # A state that has grown by this factor grows without bound.
# A margin below this fraction of its largest value along the motion counts as tending to zero.
LOST = 1e-2
# t -> R(t) = (r_1, r_1', ..., r_1^(mu_1), r_2, ...), or t -> values of all parameters.
TimeFunction = Callable[[float], FloatArray]


class PinnedPoint(NamedTuple):
    """A state on Z(R) and what is known there."""

    state: FloatArray
    rate: FloatArray  # x', u and v, which may be infinite.
    control: FloatArray
    constraint_input: FloatArray
    unrest: FloatArray  # |E x'| relative to its terms.
    margins: tuple[float, float]  # The smallest singular values of A and B; inf if A is empty.
    signs: tuple[float, ...]  # Of their determinants, if they are square.
    flaw: str  # Why the motion is not determined; empty if it is.


class PinnedOutputs:
    """Z(R) and the motion on it, for all R; `at` is that for one."""

    def __init__(self, structure: Structure) -> None:
        self.structure = structure
        self.system = system = structure.system
        self.layout = layout = structure.layout
        self._R = goal = ca.SX.sym("R", layout.reference_size)
        self.residual_signals = (
            *structure.manifold.residual_signals,
            *layout.chain_signals(system.output_signals),
        )
        errors = structure.chain - goal[layout.chained.tolist(), :]
        residual = ca.vertcat(structure.manifold.residual_expression, errors)  # (36)
        derivatives, highest = structure.derivatives, goal[layout.highest.tolist(), :]
        control, pivot = structure.control_by_matrix(highest)
        self._rate, constraint_input = (  # (35)
            ca.substitute(derivatives.expand(unknown), derivatives.control, control)
            for unknown in (derivatives.rate, derivatives.constraint_input)
        )
        inputs = {"reference": goal}
        self.residual = system.trace("pinned outputs", {"residual": residual}, inputs)
        # Common subexpressions are removed already.
        gradient = {"gradient": ca.jacobian(ca.cse(residual), system.state)}
        self.gradient = system.trace("gradient of the pinned outputs", gradient, often=False)
        # E x' = f + g v + h u, and the sizes of its terms, which cancel at rest.
        mass, g, h = (ca.fabs(e) for e in (system.mass_matrix, system.g, system.h))
        states = ca.fmax(ca.DM(system.scale), ca.fabs(system.state))
        sizes = ca.mtimes(mass, states) + ca.fabs(system.f)
        sizes += ca.mtimes(g, ca.fabs(constraint_input)) + ca.mtimes(h, ca.fabs(control))
        motion = {
            "rate": self._rate,
            "control": control,
            "constraint_input": constraint_input,
            "unrest": ca.fabs(ca.mtimes(system.mass_matrix, self._rate)) / sizes,
            "A": structure.elimination.constraint_matrix,
            "B": structure.control_matrix,
            "pivot": ca.fmin(pivot, structure.elimination.pivot),
        }
        self.motion = system.trace("pinned motion", motion, inputs)
        #: Whose exogenous signals, with their derivatives, decide the motion.
        self.expressions = residual, *motion.values()

    def at_time(
        self, reference: TimeFunction, parameters: TimeFunction, time: float
    ) -> "PinnedSet":
        """Returns Z(R(t))."""
        value = result_of("reference", reference, time)
        goal = numbers(f"reference({time:g})", value).reshape(-1)
        if goal.size != self.layout.reference_size:
            raise ModelError(
                f"{self.system.name}: the reference must have size {self.layout.reference_size} "
                f"(each output and its derivatives up to its degree {self.layout.degrees}), got "
                f"{goal.size}"
            )
        if not np.all(np.isfinite(goal)):
            text = f"{self.system.name}: the reference is not finite at t = {time:.6g} s"
            raise NonFiniteError(text, time, goal)
        return PinnedSet(self, goal, parameters(time))

    @cached_property
    def slope(self) -> TracedFunction:
        """The derivative of x' along a direction of state and reference."""
        system, dr = self.system, ca.SX.sym("dR", self.layout.reference_size)
        dx = ca.SX.sym("dx", system.num_states)
        at, along = ca.vertcat(system.state, self._R), ca.vertcat(dx, dr)
        slopes = {"rate": ca.jtimes(ca.cse(self._rate), at, along)}
        inputs = {"reference": self._R, "dx": dx, "dR": dr}
        return system.trace("slope of the pinned motion", slopes, inputs, often=False)

    @cached_property
    def least_margins(self) -> FloatArray:
        """The margins below which A and B are singular, by their largest at sampled states."""
        still, p = np.zeros(self.layout.reference_size), self.system.parameter_values
        margins = [
            [smallest_singular_value(as_matrix(M)) for M in self.motion.evaluate(x, still, p)[4:6]]
            for x in self.structure.states
        ]
        return VANISHED * np.max(margins, axis=0)


@dataclass(frozen=True, eq=False)
class PinnedSet:
    """Z(R) for one R and values of all parameters."""

    outputs: PinnedOutputs
    reference: FloatArray
    parameters: FloatArray

    def state(self, guess: FloatArray) -> FloatArray:
        """Returns a state near a guess, to round-off, or raises InconsistentStateError."""
        state, converged = self.project(guess)
        if converged:
            return state
        system, residual = self.outputs.system, self.residual(state)
        length = np.linalg.norm(self.gradients(state) * system.scale, axis=1)
        missed = np.abs(residual) / positive(length)
        worst = int(np.argmax(missed))  # One that is not finite, if there is one.
        why = (
            f"are not reached near the given state: {self.outputs.residual_signals[worst].name}"
            f" stays off by {residual[worst]:.3g}. Request outputs within reach, or start "
            "closer to a state with these outputs"
        )
        if missed[worst] <= CONSISTENT:
            why = f"lead to x = {show(state)}, where A(x) or B(x) is singular"
        raise InconsistentStateError(f"{system.name}: {self.describe()} {why}", residual)

    def project(self, start: FloatArray) -> tuple[FloatArray, bool]:
        """Returns the closest state to a start, and whether Newton's method converged."""
        scale, trace = self.outputs.system.scale, self.outputs.residual

        def residual(z: FloatArray) -> FloatArray:
            return trace.evaluate(scale * z, self.reference, self.parameters)[0]

        def linearize(z: FloatArray) -> NewtonModel | None:
            return shortest_steps(self.gradients(scale * z) * scale, residual)

        z, converged = newton(start / scale, linearize)
        return scale * z, converged

    def describe(self) -> str:
        """Returns the outputs as text."""
        values = self.outputs.layout.values(self.reference)
        pairs = zip(self.outputs.system.output_signals, values, strict=True)
        return "the outputs " + ", ".join(f"{signal.name} = {v:.6g}" for signal, v in pairs)

    def residual(self, state: FloatArray) -> FloatArray:
        """Returns the residual, named by `residual_signals`, shape (k,)."""
        return self.outputs.residual.evaluate(state, self.reference, self.parameters)[0].copy()

    def gradients(self, state: FloatArray) -> FloatArray:
        """Returns the gradients C of the residual, shape (k, n)."""
        return self.outputs.gradient.evaluate(state, self.parameters)[0].reshape(-1, state.size)

    def point(self, state: FloatArray) -> PinnedPoint:
        """Evaluates rate, inputs and matrices at a state."""
        values = self.outputs.motion.evaluate(state, self.reference, self.parameters)
        rate, u, v, unrest = (value.copy() for value in values[:4])
        *matrices, pivot = (as_matrix(value) for value in values[4:])
        margins = smallest_singular_value(matrices[0]), smallest_singular_value(matrices[1])
        signs = [np.linalg.slogdet(each)[0] for each in matrices if len(each) == each.shape[1]]
        flaw = ""
        if np.isnan(margins).any():
            flaw = "A(x) or B(x) is not finite"
        elif np.any(margins < self.outputs.least_margins) or not pivot.item() > SINGULAR_PIVOT:
            flaw = "A(x) or B(x) is singular"
        elif not np.isfinite(np.concatenate([rate, u, v])).all():
            flaw = "x' is not finite"
        return PinnedPoint(state, rate, u, v, unrest, margins, tuple(map(float, signs)), flaw)

    def rate(self, state: FloatArray) -> FloatArray:
        """Returns x' = f* + h* u, shape (n,)."""
        return self.outputs.motion.evaluate(state, self.reference, self.parameters)[0].copy()

    def slopes(
        self, state: FloatArray, directions: FloatArray | None = None, by: FloatArray | None = None
    ) -> FloatArray:
        """Returns the derivatives of x' along columns of dx, all if None, and of dR if given."""
        columns = np.eye(state.size) if directions is None else directions
        moved = np.zeros((self.reference.size, columns.shape[1])) if by is None else by
        slope = self.outputs.slope
        slopes = [
            slope.evaluate(state, self.reference, dx, dr, self.parameters)[0].copy()
            for dx, dr in zip(columns.T, moved.T, strict=True)
        ]
        return np.array(slopes).reshape(len(slopes), -1).T


class EndCause(Enum):
    """The causes for the end of a motion with pinned outputs; the enum value is a description."""

    NO_START = "no state has the outputs that the reference begins with"
    SINGULAR_START = "A(x) or B(x) is singular, or the domain of the system ends, at the start,"
    REFERENCE_NOT_FINITE = "the reference is not finite"
    UNBOUNDED = "the internal states grow without bound while the outputs follow,"
    NO_WAY_ON = (
        "the reference jumps, the domain of the system ends, or the motion is too fast: no state "
        "continues the motion"
    )
    OUT_OF_REACH = "the reference leaves what the system can reach"
    SINGULAR = "the control would be unbounded; lead the reference around its course"


@dataclass(eq=False)
class MotionEnd(Exception):
    """The end of a motion with pinned outputs, raised where it is and kept by the motion."""

    cause: EndCause
    time: float
    text: str
    state: FloatArray | None = None  # The last one.
    matrix: str = ""  # The matrix that loses its rank, "A" or "B"; empty if none does.

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, eq=False)
class PinnedMotion:
    """The motion with the outputs on a reference, until the last time or until it ends."""

    times: FloatArray  # In s, shape (k,).
    states: FloatArray  # x, shape (k, n),
    controls: FloatArray  # u,
    constraint_inputs: FloatArray  # v,
    parameters: FloatArray  # and values of all parameters.
    constraint_margins: FloatArray  # The smallest singular values of A(x), shape (k,),
    control_margins: FloatArray  # and of B(x).
    ending: MotionEnd | None  # Why it ends before the last time; None if it does not.


def follow(
    pinned: PinnedOutputs,
    reference: TimeFunction,
    times: FloatArray,
    guess: FloatArray,
    parameters: TimeFunction,
) -> PinnedMotion:
    """Computes the motion on Z(R(t)); see `ZeroDynamics.motion`."""
    system, points, ending = pinned.system, list[PinnedPoint](), None
    try:
        with np.errstate(all="ignore"):  # States outside the domain are tried and rejected.
            follower = _Follower(pinned, reference, parameters, times.tolist())
            points.extend(follower.points(guess))
    except MotionEnd as end:
        ending = end.with_traceback(None)
    moments, count = times[: len(points)], len(points)
    margins = np.array([point.margins for point in points]).reshape(count, 2)
    return PinnedMotion(
        moments,
        np.array([point.state for point in points]).reshape(count, system.num_states),
        np.array([point.control for point in points]).reshape(count, system.num_controls),
        np.array([p.constraint_input for p in points]).reshape(count, system.num_constraints),
        np.array([parameters(t) for t in moments]).reshape(count, system.parameter_symbol.numel()),
        margins[:, 0],
        margins[:, 1],
        ending,
    )


class _Follower:
    """Follows a reference from point to point; raises MotionEnd where the motion ends."""

    def __init__(
        self,
        pinned: PinnedOutputs,
        reference: TimeFunction,
        parameters: TimeFunction,
        times: list[float],
    ) -> None:
        self._pinned, self._reference, self._parameters = pinned, reference, parameters
        self._system, self._times, self._time = pinned.system, times, times[0]
        self._remaining = MOST_STEPS + len(times)
        self._last: PinnedPoint
        self._largest: FloatArray  # The largest margins so far.
        self._step, self._change = np.inf, np.zeros(self._system.num_states)
        self._integrator: scipy.integrate.Radau | None = None

    def points(self, guess: FloatArray) -> Iterator[PinnedPoint]:
        """Yields the points of the motion, one for each time."""
        first = self._at(self._time)
        try:
            self._last = first.point(first.state(guess))
        except InconsistentStateError as error:
            text = f"{error} (t = {self._time:.6g} s)"
            raise MotionEnd(EndCause.NO_START, self._time, text) from error
        if self._last.flaw:
            raise self._stop(EndCause.SINGULAR_START, f"x = {show(self._last.state)}")
        self._largest = np.array(self._last.margins)
        yield self._last
        largest = GROWN * max(1.0, float(np.max(np.abs(self._last.state) / self._system.scale)))
        has_dynamics = self._pinned.structure.zero_dynamics_dimension > 0
        for begin, end in pairwise(self._times):
            while self._time < end:
                if not (self._integrate(end, largest) if has_dynamics else self._continue(end)):
                    self._step *= 0.5
                    if self._step < SHORTEST * (end - begin):
                        raise self._end(0.1 * (end - begin))
            yield self._last

    def _continue(self, end: float) -> bool:
        """A step without zero dynamics, by a predictor and Newton's method."""
        step, before = min(self._step, end - self._time), self._last
        time = end if step == end - self._time else self._time + step
        # Adams-Bashforth: x' and its change since the previous step.
        guess = before.state + step * (before.rate + 0.5 * step * self._change)
        self._step = step
        if not self._reach(time, guess):
            return False
        self._step, self._change = 2.0 * step, (self._last.rate - before.rate) / step
        return True

    def _integrate(self, end: float, largest: float) -> bool:
        """A step with zero dynamics, by an implicit integrator, since they may be stiff."""
        integrator, scale = self._integrator or self._radau(end), self._system.scale
        self._integrator = integrator
        integrator.t_bound, integrator.status = end, "running"
        integrator.step()
        self._step = integrator.t - self._time
        if integrator.status == "failed":
            self._step = 0.0
            return False
        worst = int(np.argmax(np.abs(integrator.y) / scale))
        if abs(integrator.y[worst]) > largest * scale[worst]:
            name = self._system.state_signals[worst].name
            raise self._stop(EndCause.UNBOUNDED, f"{name} = {integrator.y[worst]:.3g}")
        if self._reach(integrator.t, integrator.y):
            integrator.y, integrator.f = self._last.state.copy(), self._last.rate.copy()
            return True
        self._integrator = self._radau(end, 0.5 * self._step)
        return False

    def _radau(self, end: float, step: float | None = None) -> "scipy.integrate.Radau":
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
        try:
            return self._pinned.at_time(self._reference, self._parameters, time)
        except NonFiniteError as error:
            raise MotionEnd(EndCause.REFERENCE_NOT_FINITE, time, str(error)) from error

    def _reach(self, time: float, state: FloatArray) -> bool:
        """Moves to the projected state, unless it is on another branch; returns whether it did."""
        last, pinned = self._last, self._at(time)
        self._remaining -= 1
        if self._remaining < 0:
            raise self._stop(EndCause.NO_WAY_ON, f"x = {show(last.state)}")
        projected, converged = pinned.project(state)
        near = JUMP * np.maximum(self._system.scale, np.abs(last.state))
        near += np.abs(state - last.state)
        if not converged or np.any(np.abs(projected - state) > near):
            return False
        point = pinned.point(projected)
        if point.flaw or point.signs != last.signs:
            return False
        self._time, self._last = time, point
        self._largest = np.maximum(self._largest, point.margins)
        return True

    def _end(self, ahead: float) -> MotionEnd:
        """Why the motion ends at the last point, also by the reference `ahead` seconds."""
        last, system = self._last, self._system
        shares = np.where(self._largest < np.inf, last.margins / self._largest, 1.0)
        which = int(np.argmin(shares))
        if shares[which] > LOST:
            # At an infinite state within a finite time a rate is so large that the state would have
            # grown by `GROWN` in the elapsed time; it may still be small, as for x' = exp(x).
            whole = self._times[-1] - self._times[0]
            elapsed = max(self._time - self._times[0], SHORTEST * whole)
            rates = np.abs(last.rate) * elapsed / np.maximum(system.scale, np.abs(last.state))
            worst = int(np.argmax(rates))
            if not rates[worst] > GROWN:
                return self._stop(EndCause.NO_WAY_ON, f"x = {show(last.state)}")
            rate = f"{system.state_signals[worst].name}' = {last.rate[worst]:.3g}"
            return self._stop(EndCause.UNBOUNDED, rate)
        ahead = min(ahead, self._times[-1] - self._time)
        pinned = self._at(self._time + ahead)
        guesses = last.state, last.state + ahead * last.rate
        near = any(pinned.project(guess)[1] for guess in guesses)
        matrix, margin = "AB"[which], f"{last.margins[which]:.2g}"
        detail = f"{matrix}(x) becomes singular, smallest singular value {margin}"
        return self._stop(EndCause.SINGULAR if near else EndCause.OUT_OF_REACH, detail, matrix)

    def _stop(self, cause: EndCause, detail: str, matrix: str = "") -> MotionEnd:
        """The end of the motion at the last point."""
        text = f"{self._system.name}: {cause.value} at t = {self._time:.6g} s: {detail}"
        return MotionEnd(cause, self._time, text, self._last.state, matrix)
