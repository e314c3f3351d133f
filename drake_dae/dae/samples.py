"""Consistent states in a box of the state space, and the numbers of expressions at them."""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, brief, numbers, show
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.newton import NewtonModel, newton
from drake_dae.trace.round_off import are_dependent

# The allowed distance of a state from the box after Newton's method, relative to the box.
SLACK = 1e-6
# A gradient that changes a function by less than this fraction across the box counts as zero.
FLAT = 1e-3


@dataclass(frozen=True, eq=False)
class Region:
    """The states x with low <= x <= high; those on N* are found for the default parameters."""

    low: FloatArray
    high: FloatArray

    def holds(self, state: FloatArray) -> bool:
        """Returns whether a state is in the region."""
        largest = np.maximum(np.abs(self.low), np.abs(self.high))
        slack = SLACK * np.maximum(largest, self.high - self.low)
        return bool(np.all((state >= self.low - slack) & (state <= self.high + slack)))

    def project(self, manifold: Manifold, guess: FloatArray) -> FloatArray:
        """Returns a consistent state in the region, near a guess."""
        try:
            state = manifold.project(guess)
            if self.holds(state):
                return state
        except InconsistentStateError:
            pass
        state = manifold.project(self._newton(manifold, guess))
        if not self.holds(state):
            raise InconsistentStateError(
                f"{manifold.system.name}: no consistent state found in the region",
                manifold.residual(np.clip(state, self.low, self.high)),
            )
        return state

    def descend(
        self,
        manifold: Manifold,
        function: Callable[[FloatArray], tuple[float, FloatArray]],
        start: FloatArray,
    ) -> FloatArray:
        """Minimizes a nonnegative function along N*, by steps to the zero of the linearized one.

        Zeros are found in a few steps. A positive minimum is only approached.
        """
        width = self.high - self.low
        state, (value, gradient) = start, function(start)
        for _ in range(40):
            direction = self._downhill(manifold.gradients(state) * width, state, gradient, width)
            slope = float(direction @ direction)
            # In units of the box: the state moves by the width times this.
            if not value > 0.0 or not np.sqrt(slope) > FLAT * value:
                break
            step = width * direction
            edge, moving = np.where(step < 0.0, self.low, self.high), step != 0.0
            with np.errstate(over="ignore"):
                room = np.min((edge - state)[moving] / step[moving], initial=np.inf)
            length = min(value / slope, float(room))
            for _ in range(6):
                try:
                    trial = self.project(manifold, state + length * step)
                    trial_value, trial_gradient = function(trial)
                    if trial_value < value:
                        break
                except InconsistentStateError:
                    pass
                length /= 4.0
            else:
                break
            state, value, gradient = trial, trial_value, trial_gradient
        return state

    def _downhill(
        self, rows: FloatArray, state: FloatArray, gradient: FloatArray, width: FloatArray
    ) -> FloatArray:
        """The descent direction along N* that stays in the box, in units of the box."""
        slope, fixed = gradient * width, np.zeros(state.size, dtype=bool)
        while True:
            normal = np.vstack([rows, np.eye(state.size)[fixed]])
            length = np.linalg.norm(normal, axis=1)
            normal = normal[length > 0.0] / length[length > 0.0, None]
            direction = normal.T @ np.linalg.lstsq(normal.T, slope)[0] - slope
            blocked = (direction < 0.0) & (state <= self.low + SLACK * width)
            blocked |= (direction > 0.0) & (state >= self.high - SLACK * width)
            if not np.any(blocked & ~fixed):
                return np.where(fixed, 0.0, direction)
            fixed |= blocked

    def _newton(self, manifold: Manifold, guess: FloatArray) -> FloatArray:
        """The result of Newton's method for the constraints, with steps inside the box."""
        scale = manifold.scale
        low, high = self.low / scale, self.high / scale

        def linearize(z: FloatArray) -> NewtonModel | None:
            gradient = manifold.gradients(scale * z) * scale
            if not np.all(np.isfinite(gradient)):
                return None

            def step(z: FloatArray) -> FloatArray:
                residual = manifold.residual(scale * z)
                return _bounded_step(gradient, residual, low - z, high - z)

            return NewtonModel(step, True)

        return scale * newton(np.clip(guess / scale, low, high), linearize)[0]


def _bounded_step(
    gradient: FloatArray, residual: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """A short dx with C dx + r = 0; components are limited by the bounds."""
    step, free = np.zeros(low.size), low < high
    while free.any():
        remaining = residual + gradient[:, ~free] @ step[~free]
        step[free] = -np.linalg.lstsq(gradient[:, free], remaining)[0]
        past = free & ((step < low) | (step > high))
        if not past.any():
            break
        step[past] = np.clip(step[past], low[past], high[past])
        free &= ~past
    return step


class Samples:
    """Consistent states near guesses, with the default parameters."""

    def __init__(self, manifold: Manifold, guesses: FloatArray) -> None:
        self.manifold, self.system = manifold, manifold.system
        self.fields: list[dict[str, FloatArray]] = []
        states: list[FloatArray] = []
        failure = None
        for number, guess in enumerate(guesses):
            try:
                state = manifold.project(guess)
            except InconsistentStateError as error:
                failure = failure or error
                continue
            values = fields_at(self.system, state)
            bad = [key for key, value in values.items() if not np.all(np.isfinite(value))]
            if not bad:
                states.append(state)
                self.fields.append(values)
            elif number == 0:
                raise ModelError(
                    f"{self.system.name}: {', '.join(bad)} of (1)-(3) is not finite at the "
                    f"consistent state x = {show(state)}; give a nominal_state inside the domain"
                )
        if failure and not states:
            raise failure
        self.states = np.array(states)
        largest = np.abs(np.vstack([guesses, self.states])).max(axis=0)
        self.scale = np.where(largest > 0.0, largest, manifold.system.scale)

    def values(self, **expressions: ca.SX) -> list[tuple[FloatArray, ...]]:
        """Evaluates expressions of the state, as matrices, at each state."""
        function = self.system.trace("sample", expressions, often=False)
        result = []
        for state in self.states:
            values = function(state, self.system.parameter_values)
            if not function.is_finite:
                raise ModelError(
                    f"{self.system.name}: {', '.join(expressions)} is not finite at the consistent "
                    f"state x = {show(state)}; give a nominal_state inside the domain of the "
                    "functions and of their derivatives"
                )
            result.append(tuple(as_matrix(value) for value in values))
        return result

    def dependent(self, functions: ca.SX) -> bool:
        """Returns whether the differentials of functions are linearly dependent at every state."""
        gradients = self.values(gradient=ca.jacobian(functions, self.system.state))
        return all(are_dependent(gradient * self.scale) for (gradient,) in gradients)

    def surroundings(self) -> Region:
        """The box that the states span."""
        return Region(self.states.min(axis=0), self.states.max(axis=0))


def fields_at(
    system: DaeSystem, state: FloatArray, parameters: FloatArray | None = None
) -> dict[str, FloatArray]:
    """Returns f, g, h, l and m of (1)-(3), with E = 1, as matrices."""
    function = system.fields
    values = function(state, system.parameter_vector(parameters))
    return dict(zip(function.output_names, map(as_matrix, values), strict=True))


def draw(system: DaeSystem, spread: ArrayLike | None, count: int, seed: int) -> FloatArray:
    """Draws states around the nominal state, which comes first; they are not yet consistent."""
    normal = np.random.default_rng(seed).standard_normal((count, system.num_states))
    away = spread_of(system, spread) * np.vstack([np.zeros(system.num_states), normal])
    return system.nominal_state + away


def spread_of(system: DaeSystem, spread: ArrayLike | None) -> FloatArray:
    """Converts a spread to shape (n,); the default of the system if None."""
    if spread is None:
        return system.spread_around(system.nominal_state)
    deviations = numbers(f"{system.name}: spread", spread)
    if deviations.shape not in ((), (system.num_states,)) or not np.all(deviations >= 0.0):
        raise ModelError(
            f"{system.name}: spread must be a nonnegative number or have shape "
            f"({system.num_states},), got {brief(spread)}"
        )
    return np.full(system.num_states, deviations)


def as_matrix(value: FloatArray) -> FloatArray:
    """Converts a result of a TracedFunction to a matrix; columns are returned as vectors there."""
    return value[:, None].copy() if value.ndim == 1 else value
