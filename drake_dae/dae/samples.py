"""Consistent states in a box, numbers of expressions at them, and members of a family."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy  # SciPy loads its large parts when they are used.
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, brief, numbers, show
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.signals import Indices
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.numerics import NewtonModel, are_dependent, newton, positive

# The allowed distance of a state from the box after Newton's method, relative to the box.
SLACK = 1e-6
# A gradient that changes a function by less than this fraction across the box counts as zero.
FLAT = 1e-3
# The number of random members. Functions are analytic almost everywhere: one that is zero at a few
# random members is zero at all.
MEMBERS = 4
# If there is no consistent state for drawn numbers, they are moved towards the defaults by this
# factor, so often.
NEARER, TRIES = 0.25, 6
# How a box of bounds is searched: random corners, random places, minima from the best of them.
CORNERS, STARTS = 16, 3
UNKNOWN = 10.0  # A margin where there is no consistent state; others are at most about 1.
# Parameters that differ less from their defaults, relative to the others, do not decide.
SAME = 1e-3
# A function of a consistent state and the values of all parameters.
OfMember = Callable[[FloatArray, FloatArray], float]


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
                raise outside(self.system, f"{', '.join(bad)} of (1)-(3)", state)
        if failure and not states:
            raise failure
        self.states = np.array(states)
        largest = np.abs(np.vstack([guesses, self.states])).max(axis=0)
        self.scale = np.where(largest > 0.0, largest, self.system.scale)

    def values(self, **expressions: ca.SX) -> list[tuple[FloatArray, ...]]:
        """Evaluates expressions of the state, as matrices, at each state."""
        function = self.system.trace("sample", expressions, often=False)
        result = []
        for state in self.states:
            values = function(state, self.system.parameter_values)
            if not function.is_finite:
                raise outside(self.system, ", ".join(expressions), state)
            result.append(tuple(as_matrix(value) for value in values))
        return result

    def dependent(self, functions: ca.SX) -> bool:
        """Returns whether the differentials of functions are linearly dependent at every state."""
        gradients = self.values(gradient=ca.jacobian(functions, self.system.state))
        return all(are_dependent(gradient * self.scale) for (gradient,) in gradients)

    def descend(
        self, function: Callable[[FloatArray], tuple[float, FloatArray]], start: FloatArray
    ) -> FloatArray:
        """Minimizes a nonnegative function along N* in the box that the states span.

        Steps lead to the zero of the linearized function; a positive minimum is only approached.
        """
        low, high = self._box
        width, manifold = high - low, self.manifold
        state, (value, gradient) = start, function(start)
        for _ in range(40):
            direction = self._downhill(manifold.gradients(state) * width, state, gradient)
            slope = float(direction @ direction)
            # In units of the box: the state moves by the width times this.
            if not value > 0.0 or not np.sqrt(slope) > FLAT * value:
                break
            step = width * direction
            edge, moving = np.where(step < 0.0, low, high), step != 0.0
            with np.errstate(over="ignore"):
                room = np.min((edge - state)[moving] / step[moving], initial=np.inf)
            length = min(value / slope, float(room))
            for _ in range(6):
                try:
                    trial = self._project(state + length * step)
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

    @property
    def _box(self) -> tuple[FloatArray, FloatArray]:
        return self.states.min(axis=0), self.states.max(axis=0)

    def _downhill(self, rows: FloatArray, state: FloatArray, gradient: FloatArray) -> FloatArray:
        """The descent direction along N* that stays in the box, in units of the box."""
        low, high = self._box
        width, fixed = high - low, np.zeros(state.size, dtype=bool)
        slope = gradient * width
        while True:
            normal = np.vstack([rows, np.eye(state.size)[fixed]])
            length = np.linalg.norm(normal, axis=1)
            normal = normal[length > 0.0] / length[length > 0.0, None]
            direction = normal.T @ np.linalg.lstsq(normal.T, slope)[0] - slope
            blocked = (direction < 0.0) & (state <= low + SLACK * width)
            blocked |= (direction > 0.0) & (state >= high - SLACK * width)
            if not np.any(blocked & ~fixed):
                return np.where(fixed, 0.0, direction)
            fixed |= blocked

    def _project(self, guess: FloatArray) -> FloatArray:
        """A consistent state in the box near a guess; by Newton steps inside it if need be."""
        (low, high), manifold, scale = self._box, self.manifold, self.system.scale
        slack = SLACK * np.maximum(np.maximum(np.abs(low), np.abs(high)), high - low)

        def holds(state: FloatArray) -> bool:
            return bool(np.all((state >= low - slack) & (state <= high + slack)))

        def linearize(z: FloatArray) -> NewtonModel | None:
            gradient = manifold.gradients(scale * z) * scale
            if not np.all(np.isfinite(gradient)):
                return None

            def step(z: FloatArray) -> FloatArray:
                residual = manifold.residual(scale * z)
                return _bounded_step(gradient, residual, low / scale - z, high / scale - z)

            return NewtonModel(step, True)

        with suppress(InconsistentStateError):
            state = manifold.project(guess)
            if holds(state):
                return state
        start = np.clip(guess / scale, low / scale, high / scale)
        state = manifold.project(scale * newton(start, linearize)[0])
        if not holds(state):
            text = f"{self.system.name}: no consistent state found between the samples"
            raise InconsistentStateError(text, manifold.residual(np.clip(state, low, high)))
        return state


def _bounded_step(
    gradient: FloatArray, residual: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """A short dx with C dx + r = 0; components are limited by the bounds."""
    step, free = np.zeros(low.size), low < high
    while free.any():
        remaining = residual + gradient[:, ~free] @ step[~free]
        step[free] = -np.linalg.lstsq(gradient[:, free], remaining)[0]
        past = free & ((step < low) | (step > high))
        step[past] = np.clip(step[past], low[past], high[past])
        free &= ~past
        if not past.any():
            break
    return step


def outside(system: DaeSystem, what: str, state: FloatArray) -> ModelError:
    """The exception for a function that is not finite at a consistent state."""
    return ModelError(
        f"{system.name}: {what} is not finite at the consistent state x = {show(state)}; give a "
        "nominal_state inside the domain of the functions and of their derivatives"
    )


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
    deviations, n = numbers(f"{system.name}: spread", spread), system.num_states
    if deviations.shape not in ((), (n,)) or not np.all(deviations >= 0.0):
        raise ModelError(
            f"{system.name}: spread must be nonnegative, a number or of shape ({n},), got "
            f"{brief(spread)}"
        )
    return np.full(n, deviations)


def as_matrix(value: FloatArray) -> FloatArray:
    """Converts a result of a TracedFunction to a matrix; columns are returned as vectors there."""
    return value[:, None].copy() if value.ndim == 1 else value


@dataclass(frozen=True, eq=False)
class Deciding:
    """Parameters that decide a degree or a rank: name, value and default of each."""

    pairs: tuple[tuple[str, float, float], ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for name, _, _ in self.pairs)

    def __str__(self) -> str:
        there = " and ".join(f"'{name}' = {value:.3g}" for name, value, _ in self.pairs)
        here = " and ".join(f"'{name}' = {default:.3g}" for name, _, default in self.pairs)
        return f"at {there}, and not at the default {here}"


class Family:
    """Members of a system: parameters in `parameter_box`, each with a consistent state."""

    def __init__(self, manifold: Manifold, states: FloatArray) -> None:
        self._manifold, self._states = manifold, states
        self._system = manifold.system
        self._names = [signal.name for signal in self._system.parameter_signals]

    def deciding(self, acts: OfMember) -> Deciding | None:
        """Returns the parameters for which an input acts that does not act at the defaults."""
        low, high = self._system.parameter_box
        random, defaults = np.random.default_rng(0), self._system.parameter_values
        members, free = [], np.flatnonzero(low < high).tolist()
        for number in range(MEMBERS if free else 0):
            away = random.uniform(low, high) - defaults
            for part in NEARER ** np.arange(TRIES):
                state = self._consistent(
                    self._states[number % len(self._states)], defaults + part * away
                )
                if state is not None:
                    members.append((state, defaults + part * away))
                    break
        hits = [member for member in members if acts(*member)]
        # One of many may be round-off of a nearly singular matrix.
        if 2 * len(hits) <= len(members):
            return None
        near, values = hits[0]

        def acts_with(place: int, others: FloatArray, those: FloatArray) -> bool:
            mixed = others.copy()
            mixed[place] = those[place]
            state = self._consistent(near, mixed)
            return state is not None and bool(acts(state, mixed))

        chosen = [i for i in free if acts_with(i, others=defaults, those=values)]
        # No parameter alone decides: those without which it does not act.
        chosen = chosen or [i for i in free if not acts_with(i, others=values, those=defaults)]
        return self._deciding(chosen or free, values)

    def lost(self, margin: OfMember, least: float) -> Deciding | None:
        """Returns parameters within their bounds where a margin is not above the least, or None."""
        system, defaults = self._system, self._system.parameter_values
        bounded = [system.parameter_slice(p.name) for p in system.parameters if p.bounds]
        places = np.concatenate([np.r_[each] for each in bounded])
        low, high = (bound[places] for bound in system.parameter_box)
        width, random = high - low, np.random.default_rng(0)
        default = (defaults[places] - low) / positive(width)

        def at(box: FloatArray) -> FloatArray:
            values = defaults.copy()
            values[places] = low + width * box
            return values

        def least_at(box: FloatArray) -> float:
            state = self._consistent(self._states[0], at(box))
            return UNKNOWN if state is None else min(margin(state, at(box)), UNKNOWN)

        alone = [np.where(row > 0, end, default) for row in np.eye(places.size) for end in (0, 1)]
        corners = random.integers(0, 2, (CORNERS, places.size))
        inside = random.uniform(size=(CORNERS, places.size))
        tried = np.array([*alone, *np.unique(corners, axis=0), *inside], dtype=float)
        values = np.array([least_at(box) for box in tried])
        for k in np.argsort(values, kind="stable")[:STARTS]:
            box, value = tried[k], float(values[k])
            if value > least:
                found = scipy.optimize.minimize(
                    least_at, box, method="L-BFGS-B", bounds=[(0.0, 1.0)] * box.size
                )
                box, value = found.x, float(found.fun)
            if value <= least:
                moved = np.abs(box - default)
                return self._deciding(places[moved > SAME * np.max(moved)], at(box))
        return None

    def _deciding(self, places: Sequence[int] | Indices, values: FloatArray) -> Deciding:
        defaults = self._system.parameter_values
        return Deciding(
            tuple((self._names[i], float(values[i]), float(defaults[i])) for i in places)
        )

    def _consistent(self, state: FloatArray, parameters: FloatArray) -> FloatArray | None:
        """A consistent state near a state for other parameters; None if there is none."""
        try:
            consistent = self._manifold.project(state, parameters)
        except InconsistentStateError:
            return None
        fields = fields_at(self._system, consistent, parameters).values()
        return consistent if all(np.all(np.isfinite(field)) for field in fields) else None
