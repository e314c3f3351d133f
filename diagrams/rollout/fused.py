"""A closed loop as functions of CasADi's interpreter: its derivative, its steps, its record."""

from collections.abc import Sequence
from math import isfinite

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.rollout.functions import LoopFunctions
from drake_dae.diagrams.rollout.run import Tableau

CHUNK = 64
"""So many evaluations are one call of CasADi."""


class Fused:
    """Plant, law, references and sensor as one function.

    All functions take the time, the state with that of the sensor, what the sensor holds (or its
    noise), and the parameters of plant and law.

    Attributes:
        functions: The closed loop.
    """

    def __init__(self, functions: LoopFunctions) -> None:
        self.functions = functions
        loop, dae = functions.loop, functions.loop.plant.dae
        size = dae.num_states + functions.num_lags
        sizes = (1, size, dae.num_constraints, functions.plant.sizes[-1], functions.law.sizes[-1])
        names = ("time", "state", "hold", "plant", "law")
        inputs = [ca.SX.sym(name, count) for name, count in zip(names, sizes, strict=True)]
        time, state, hold, plant, law = inputs
        reference, moving, of_law, *checks = functions.signals.function(time)
        if loop.exogenous is not None:
            plant, law = ca.SX(plant), ca.SX(law)
            plant[loop.plant.exogenous_places] = moving
            law[loop.controller.exogenous_places] = of_law
        options = {"cse": False}
        rate, force, valid, *_ = functions.rate(state, reference, hold, plant, law)
        self._rate = ca.Function("rate", inputs, [rate, force, valid + checks[-1]], options)
        _, force, valid, control, measured = functions.motion(state, reference, hold, plant, law)
        rest, *of_rest = functions.rest.function(state[: dae.num_states], force, plant)
        valid += checks[-1]
        row = ca.vertcat(state[: dae.num_states], rest, control, reference, moving, measured)
        rows = ca.Function("rows", inputs, [row, valid + of_rest[-1]], options)
        self._rows = rows.map(CHUNK)
        self._projection = self._project_function()
        self._projections = self._projection.map(CHUNK)
        self._steps: dict[bytes, tuple[ca.Function, ca.Function]] = {}
        self._arrays = [np.zeros(count) for count in sizes]
        self._results = [np.zeros(size), np.zeros(dae.num_constraints), np.zeros(1)]
        self._buffer, self._evaluate = self._rate.buffer()
        for index, array in enumerate(self._arrays):
            self._buffer.set_arg(index, array.data)
        for index, array in enumerate(self._results):
            self._buffer.set_res(index, array.data)

    def rate(self, *arguments: FloatArray | float) -> FloatArray:
        """The derivative of the state, a fresh array; nan where it has no value."""
        for array, given in zip(self._arrays, arguments, strict=True):
            array[...] = given
        self._evaluate()
        values = self._results[0].copy()
        if not isfinite(self._results[2][0]):
            values[:] = np.nan
        return values

    def sample(
        self,
        time: float,
        state: FloatArray,
        hold: FloatArray,
        noise: FloatArray,
        plant: FloatArray,
        law: FloatArray,
    ) -> FloatArray:
        """What the sensor holds from now on; not finite where the force has no value."""
        sensor = self.functions.loop.sensor
        if sensor is None or not sensor.sample_period:
            return noise
        if self.functions.num_lags:
            force = state[-self.functions.num_lags :]
        else:
            force = self._results[1] + self.rate(time, state, hold, plant, law)[0] * 0.0
        return force + sensor.bias + sensor.noise_deviation * noise

    def rows(
        self,
        moments: Sequence[tuple[float, FloatArray, FloatArray]],
        plant: FloatArray,
        law: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Rows of the record, and which of them have values.

        Args:
            moments: Times, states, and what the sensor holds.
            plant, law: The parameters.
        """
        columns = [
            np.array(values).reshape(len(moments), -1).T for values in zip(*moments, strict=True)
        ]
        rows, valid = _mapped(self._rows, columns, [plant, law])
        return rows.T, np.isfinite(valid[0])

    def projections(
        self, times: FloatArray, states: FloatArray, plant: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """States after two Newton steps to N*, shape (k, n), and the lengths of the last ones.

        Args:
            times: Their times, shape (k,).
            states: The states, shape (k, n).
            plant: The plant's parameters.
        """
        if len(times) == 1:
            one, length = self._projection(times, states[0], plant)
            return np.array(one).T, np.array(length)[0]
        found, left = _mapped(self._projections, [times[None], states.T], [plant])
        return found.T, left[0]

    def steps(self, tableau: Tableau) -> tuple[ca.Function, ca.Function]:
        """A fixed step, and many of them as one function.

        Args:
            tableau: The method.
        """
        key = tableau.a.tobytes() + tableau.b.tobytes()
        if key not in self._steps:
            one = self._step(tableau)
            self._steps[key] = one, one.mapaccum("steps", CHUNK, 1)
        return self._steps[key]

    def _step(self, tableau: Tableau) -> ca.Function:
        """A fixed step: the projection by two Newton steps, then a Runge-Kutta step.

        A function of state, time, step, what is held, and parameters; it returns the state, and
        below each other what is finite if all has values, and the length of the last Newton step.
        """
        time, state, hold, plant, law = (ca.MX.sym("x", each.size) for each in self._arrays)
        step = ca.MX.sym("step")
        symbols = [state, time, step, hold, plant, law]
        state, left = self._projection(time, state, plant)
        rates: list[ca.MX] = []
        finite = ca.MX(0.0)
        for row, part in zip(tableau.a, tableau.c, strict=True):
            change = sum((w * rate for w, rate in zip(row, rates, strict=False) if w), ca.MX(0.0))
            stage = state + step * change
            rate, _, valid = self._rate(time + part * step, stage, hold, plant, law)
            rates.append(rate)
            finite += valid
        reached = state + step * sum(w * rate for w, rate in zip(tableau.b, rates, strict=True))
        checks = ca.vertcat(finite + ca.sum1(reached), left)
        return ca.Function("step", symbols, [reached, checks])

    def _project_function(self) -> ca.Function:
        """(t, state, the plant's parameters) -> the state after two Newton steps, and the last."""
        functions, loop = self.functions, self.functions.loop
        dae = loop.plant.dae
        sizes = [1, dae.num_states + functions.num_lags, functions.plant.sizes[-1]]
        symbols = [ca.MX.sym("x", size) for size in sizes]
        time, state, plant = symbols
        x, left = state[: dae.num_states], ca.MX(0.0)
        if loop.plant.projects:
            moving, own = functions.signals.function(time)[1], plant
            if loop.exogenous is not None:
                own = ca.MX(plant)
                own[loop.plant.exogenous_places] = moving
            at = x
            for _ in range(2):
                change = functions.newton.function(x, at, own)[0]
                x, left = x + ca.DM(dae.scale) * change, ca.norm_2(change)
        state = ca.vertcat(x, state[dae.num_states :])
        return ca.Function("projection", symbols, [state, left])


def _mapped(
    function: ca.Function, columns: Sequence[FloatArray], shared: Sequence[FloatArray]
) -> list[FloatArray]:
    """A mapped function at any number of columns: the last one fills what is left."""
    count = columns[0].shape[1]
    parts = []
    for first in range(0, count, CHUNK):
        chosen = np.minimum(np.arange(first, first + CHUNK), count - 1)
        values = function(*(values[:, chosen] for values in columns), *shared)
        parts.append([np.array(value)[:, : count - first] for value in values])
    return [np.hstack(values) for values in zip(*parts, strict=True)]
