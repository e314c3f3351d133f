"""A diagram as functions of CasADi's interpreter: its derivative, its steps, its record."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

import casadi as ca
import numpy as np
from scipy.integrate import DOP853

from drake_dae.arrays import FloatArray
from drake_dae.compiler.compiled import ARGUMENTS
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.run import Tableau
from drake_dae.running.rollout.stepping.called import BufferedFunction
from drake_dae.running.rollout.stepping.many import VectorizedFunction
from drake_dae.systems.blocks.dips import TOUCHING, lowest

CHUNK = 64
"""So many fixed steps are one call of CasADi."""


@dataclass(frozen=True, eq=False)
class GuardInputs:
    """What the guards of a diagram see at a moment, see `Guard`.

    Attributes:
        time: In s.
        margins, gaps, rates: What they compute.
    """

    time: float
    margins: FloatArray
    gaps: FloatArray
    rates: FloatArray

    @property
    def is_due(self) -> bool:
        """Whether a block has to react."""
        return bool((self.margins <= 0.0).any())

    def follows_change(self, before: "GuardInputs") -> bool:
        """Whether something happened since another moment, at which it had not."""
        if ((self.margins <= 0.0) & (before.margins > 0.0)).any():
            return True
        given = before.gaps, before.rates, self.gaps, self.rates
        return bool((lowest(self.time - before.time, *given) < -TOUCHING).any())


class DiagramFunctions:
    """The functions of a diagram, and steps of its state as functions.

    All functions take the time, the state, what is held, and the parameters.

    Attributes:
        program: The diagram.
        controlled: A step of DOP853, as `controlled_step` has it.
        watched_rates: As of the compiled diagram.
        rates: The derivative of the state at many moments, and what is finite where it is of use.
    """

    def __init__(self, program: RolloutProgram) -> None:
        self.program, compiled = program, program.compiled
        self._sizes = [compiled.sizes[name] for name in ARGUMENTS]
        self._rate, self._projection = compiled.rate, compiled.newton(2)
        self._rows, self._projections = (
            VectorizedFunction(compiled.row),
            VectorizedFunction(self._projection),
        )
        self._updates = [
            (rate.is_unrestricted, list(rate.places), BufferedFunction(rate.function))
            for rate in compiled.rates
            if rate.stepped is None
        ]
        self._steps: dict[bytes, tuple[BufferedFunction, BufferedFunction]] = {}
        self._called = BufferedFunction(self._rate)
        self.controlled = BufferedFunction(self._controlled_step())
        self.rates = VectorizedFunction(self._rate)
        self._guard = BufferedFunction(compiled.guard) if compiled.guards else None
        self._watch = BufferedFunction(compiled.watch) if compiled.watched else None
        self.watched_rates = compiled.watched_rates

    def rate(self, *arguments: FloatArray | float) -> FloatArray:
        """The derivative of the state, a fresh array; nan where it has no value."""
        rate, valid = self._called(*arguments)
        values = rate.copy()
        if not isfinite(valid[0]):
            values[:] = np.nan
        return values

    def seen(
        self, time: float, state: FloatArray, held: FloatArray, parameters: FloatArray
    ) -> GuardInputs:
        """What the guards see; a diagram without any has none to call."""
        assert self._guard is not None
        margins, gaps, rates, valid = self._guard(time, state, held, parameters)
        # What has no value is no change: the step tells why.
        found = margins.copy() if isfinite(valid[0]) else np.full_like(margins, np.inf)
        return GuardInputs(time, found, gaps.copy(), rates.copy())

    def watched(
        self, time: float, state: FloatArray, held: FloatArray, parameters: FloatArray
    ) -> GuardInputs:
        """What the guards see that are looked at in samples; as `seen`."""
        assert self._watch is not None
        margins, *_, valid = self._watch(time, state, held, parameters)
        found = margins.copy() if isfinite(valid[0]) else np.full_like(margins, np.inf)
        return GuardInputs(time, found, np.zeros(0), np.zeros(0))

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
        """What is held after updates of one kind that are due; not finite where one has no value.

        Args:
            time, state, held, parameters: As for all functions.
            noise: The random numbers of this moment.
            due: Which rates are due, as bits.
            is_unrestricted: The kind.
        """
        found = held.copy()
        for number, (kind, places, function) in enumerate(self._updates):
            if due >> number & 1 and kind == is_unrestricted:
                values, valid = function(time, state, held, parameters, noise)
                found[places] = values + 0.0 * valid
        return found

    def rows(
        self, times: FloatArray, states: FloatArray, held: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Rows of the record, and which of them have values.

        Args:
            times: Their times, shape (k,).
            states: The states, shape (k, n).
            held: What is held, shape (k, m).
            parameters: The parameters.
        """
        rows, valid = self._rows(times[:, None], states, held, parameters)
        return rows, np.isfinite(valid[:, 0])

    def projections(
        self, times: FloatArray, states: FloatArray, held: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """States after two Newton steps to N*, shape (k, n), and the lengths of the last ones.

        The arguments are those of `rows`.
        """
        found, left = self._projections(times[:, None], states, held, parameters)
        return found, left[:, 0]

    def steps(self, tableau: Tableau) -> tuple[BufferedFunction, BufferedFunction]:
        """A fixed step, as `_step` has it, and many of them as one function.

        Args:
            tableau: The method.
        """
        key = tableau.a.tobytes() + tableau.b.tobytes()
        if key not in self._steps:
            one = self._step(tableau)
            self._steps[key] = (
                BufferedFunction(one),
                BufferedFunction(one.mapaccum("steps", CHUNK, 1)),
            )
        return self._steps[key]

    def _symbols(self) -> list[ca.MX]:
        return [ca.MX.sym("x", size) for size in self._sizes]

    def _step(self, tableau: Tableau) -> ca.Function:
        """A fixed step: the projection by two Newton steps, then a Runge-Kutta step.

        A function of state, time, step, what is held, and parameters; it returns the state, and
        below each other what is finite if all has values, and the length of the last Newton step.
        """
        time, state, held, parameters = self._symbols()
        step = ca.MX.sym("step")
        symbols = [state, time, step, held, parameters]
        state, left = self._projection(time, state, held, parameters)
        rates: list[ca.MX] = []
        finite = ca.MX(0.0)
        for row, part in zip(tableau.a, tableau.c, strict=True):
            stage = state + step * _weighted(row, rates)
            rate, valid = self._rate(time + part * step, stage, held, parameters)
            rates.append(rate)
            finite += valid
        reached = state + step * _weighted(tableau.b, rates)
        checks = ca.vertcat(finite + ca.sum1(reached), left)
        return ca.Function("step", symbols, [reached, checks])

    def _controlled_step(self) -> ca.Function:
        """A step of DOP853 from a state on N* to the next one.

        A function of what all functions take, of the rate there, the step, and the absolute and the
        relative error that it may make. It returns the state that is reached, on N*; the rate
        there; below each other the squares of both error estimates over what they may be, what is
        finite if all stages have values, the length of the last Newton step, and what is finite if
        the rate has a value; and the rates of all stages side by side.
        """
        symbols = time, state, held, parameters = self._symbols()
        first, step = ca.MX.sym("first", self._sizes[1]), ca.MX.sym("step")
        absolute, relative = ca.MX.sym("absolute", self._sizes[1]), ca.MX.sym("relative")
        rates, finite = [first], ca.MX(0.0)
        for row, part in zip(DOP853.A[1:], DOP853.C[1:], strict=True):
            stage = state + step * _weighted(row, rates)
            rate, valid = self._rate(time + part * step, stage, held, parameters)
            rates.append(rate)
            finite += valid
        reached = state + step * _weighted(DOP853.B, rates)
        unit = absolute + ca.fmax(ca.fabs(state), ca.fabs(reached)) * relative
        errors = [ca.sumsqr(_weighted(e, rates) / unit) for e in (DOP853.E5, DOP853.E3)]
        found, left = self._projection(time + step, reached, held, parameters)
        last, valid = self._rate(time + step, found, held, parameters)
        checks = ca.vertcat(*errors, finite, left, valid)
        symbols = [*symbols, first, step, absolute, relative]
        return ca.Function("controlled", symbols, [found, last, checks, ca.horzcat(*rates)])


def _weighted(weights: FloatArray, rates: Sequence[ca.MX]) -> ca.MX:
    """The weighted sum of rates; weights that are zero, or too many, count for nothing."""
    pairs = zip(weights.tolist(), rates, strict=False)
    return sum((weight * rate for weight, rate in pairs if weight), ca.MX(0.0))
