"""Consistent states, and the numbers of expressions at them."""

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, brief, numbers, show
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import InconsistentStateError, ModelError
from drake_dae.trace.round_off import are_dependent


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
