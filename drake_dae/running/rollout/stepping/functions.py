"""The functions of a diagram for CasADi's interpreter: its derivative, its updates, its record."""

from functools import cached_property
from math import isfinite

import casadi as ca
import numpy as np

from drake_dae.arrays import Booleans, FloatArray
from drake_dae.compiler.called import BufferedFunction
from drake_dae.compiler.compiled import ARGUMENTS
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.run import Tableau
from drake_dae.running.rollout.stepping.many import VectorizedFunction

REACHED = 1e-11
"""N* is reached if the second of two Newton steps is not longer than this."""


class DiagramFunctions:
    """The functions of a diagram.

    All of them take the time, the state, the held values and the parameters.

    Attributes:
        program: The diagram.
    """

    def __init__(self, program: RolloutProgram) -> None:
        self.program, compiled = program, program.compiled
        newton = compiled.newton(2)
        self._rate, self._newton = BufferedFunction(compiled.rate), BufferedFunction(newton)
        self._rows, self._projections = (
            VectorizedFunction(compiled.row),
            VectorizedFunction(newton),
        )
        self._updates = [
            (rate.is_unrestricted, list(rate.places), BufferedFunction(rate.function))
            for rate in compiled.rates
            if rate.stepped is None
        ]
        self._stages: dict[bytes, BufferedFunction] = {}

    @cached_property
    def moving(self) -> np.ndarray:
        """The held values on which the derivative of the state, or its manifold, depends."""
        compiled = self.program.compiled
        place = ARGUMENTS.index("held")
        of_each = (each.jac_sparsity(0, place) for each in (compiled.rate, compiled.newton(1)))
        return np.unique(np.concatenate([each.get_triplet()[1] for each in of_each])).astype(int)

    def rate(
        self, time: float, state: FloatArray, held: FloatArray, parameters: FloatArray
    ) -> FloatArray:
        """Returns the derivative of the state, as a new array; nan where it has no value."""
        rate, valid = self._rate(time, state, held, parameters)
        return rate.copy() if isfinite(valid[0]) else np.full_like(rate, np.nan)

    def stages(self, tableau: Tableau) -> BufferedFunction:
        """Returns the derivatives at the stages of a Runge-Kutta step as one function.

        It takes the arguments of all functions, the derivative at the first stage, and the step in
        s. It returns the derivatives, shape (s, n), and a number that is finite if all have values.
        """
        key = tableau.a.tobytes()
        if key not in self._stages:
            compiled = self.program.compiled
            inputs = [ca.MX.sym(name, compiled.sizes[name]) for name in ARGUMENTS]
            time, state, held, parameters = inputs
            first, step, finite = ca.MX.sym("first", state.numel()), ca.MX.sym("step"), ca.MX(0.0)
            rates = [first]
            for row, part in zip(tableau.a[1:].tolist(), tableau.c[1:].tolist(), strict=True):
                pairs = zip(row, rates, strict=False)
                change = sum((weight * rate for weight, rate in pairs if weight), ca.MX(0.0))
                stage = compiled.rate(time + part * step, state + step * change, held, parameters)
                rates.append(stage[0])
                finite += stage[1]
            outputs = [ca.densify(ca.horzcat(*rates)), ca.densify(finite)]
            function = ca.Function("stages", [*inputs, first, step], outputs)
            self._stages[key] = BufferedFunction(function)
        return self._stages[key]

    def projected(
        self, time: float, state: FloatArray, held: FloatArray, parameters: FloatArray
    ) -> FloatArray | None:
        """Returns the state on N* after two Newton steps; None if these do not reach it."""
        projected, left = self._newton(time, state, held, parameters)
        return projected.copy() if left[0] <= REACHED else None

    def update(
        self,
        time: float,
        state: FloatArray,
        held: FloatArray,
        parameters: FloatArray,
        noise: FloatArray,
        due: int,
        is_unrestricted: bool,
    ) -> FloatArray:
        """Returns the held values after all updates of one kind that are due.

        They are not finite where an update has no value.

        Args:
            time, state, held, parameters: As of all functions.
            noise: The random numbers of this moment.
            due: Which rates are due, as bits.
            is_unrestricted: The kind of updates.
        """
        updated = held.copy()
        for number, (kind, places, function) in enumerate(self._updates):
            if due >> number & 1 and kind == is_unrestricted:
                values, valid = function(time, state, held, parameters, noise)
                updated[places] = values + 0.0 * valid
        return updated

    def rows(
        self, times: FloatArray, states: FloatArray, held: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, Booleans]:
        """Returns rows of the record, and which of them have values.

        Args:
            times: The times, shape (k,).
            states: The states, shape (k, n).
            held: The held values, shape (k, m).
            parameters: The parameters.
        """
        rows, valid = self._rows(times[:, None], states, held, parameters)
        return rows, np.isfinite(valid[:, 0])

    def projections(
        self, times: FloatArray, states: FloatArray, held: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, Booleans]:
        """Returns states after two Newton steps, and which are on N*; arguments as of `rows`."""
        states, left = self._projections(times[:, None], states, held, parameters)
        return states, left[:, 0] <= REACHED


def functions_of(program: RolloutProgram) -> DiagramFunctions:
    """Returns the functions of a diagram, which are made once."""
    return program.kept("functions", lambda: DiagramFunctions(program))
