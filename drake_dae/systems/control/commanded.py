"""References that a person changes while they run, as a LeafSystem.                   (28)"""

from collections.abc import Sequence

import casadi as ca
import numpy as np
from pydrake.systems.framework import BasicVector, Context, ContinuousState, DependencyTicket

from drake_dae.arguments import checked
from drake_dae.blocks.computations import DERIVATIVE, PARAMETERS, STATE, TIME, Block, Computation
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ReferenceSignalError
from drake_dae.references import Reference
from drake_dae.systems.control.references import ReferenceGenerator, traced_references
from drake_dae.trace.functions import TracedFunction

RATES = {"N": 40.0, "N m": 40.0}
"""Unit -> the rate w of the lags, in 1/s; `RATE` for others."""

SPEEDS = {"m": 0.4, "N": 400.0, "N m": 40.0}
"""Unit -> the largest speed V of a change, in this unit per second; `SPEED` for others."""

RATE, SPEED = 12.0, 1.0


@checked(ReferenceSignalError)
class CommandedReferences(ReferenceGenerator):
    """References with changes that are commanded while they run.

    Numeric parameter 0 has the commands, named by `commands`: a change of each reference in its
    unit, 0 by default, which may jump at any time. A law needs a reference with mu derivatives, so
    that a command c passes through mu + 1 lags of rate w, the first of limited speed:

        y_0' = sat(w (c - y_0), V),    y_j' = w (y_(j-1) - y_j),    j = 1, ..., mu,

    and y_mu is added to the reference. Its derivatives up to mu are sums of y_0, ..., y_mu. A lag
    is a mean with positive weights, so that y_mu does not overshoot, |y_mu'| <= V, and
    |y_mu^(k)| <= (2 w)^(k-1) V. The state are the lags.

    Output port:
        reference: R of (28) for references + changes, shape (sum (mu_i + 1),).

    The block does not convert to AutoDiffXd, since the lags have kinks.

    Args:
        references: The references, in the order of the outputs.
        degrees: The degrees mu_1, ..., mu_p.
        signals: Names and units of the outputs.
        depth: The least number of lags, for another block with the same commands and more
            derivatives.

    Attributes:
        commands: Names and units of the commands.

    Raises:
        ReferenceSignalError: As of `ReferenceGenerator`; or a reference has parameters.
    """

    no_gradient = "commands pass lags with kinks"

    def __init__(
        self,
        references: Sequence[Reference],
        degrees: Sequence[int],
        signals: Sequence[Signal],
        *,
        depth: int = 0,
    ) -> None:
        super().__init__(references, degrees)
        if self.reference_parameters:
            raise ReferenceSignalError(
                "references with parameters cannot be commanded: write the numbers of "
                f"{', '.join(self.reference_parameters)} into the expressions"
            )
        self.commands = tuple(signals)
        command = ca.SX.sym("c", len(self.commands))
        states, rates, rows = list[ca.SX](), list[ca.SX](), list[ca.SX]()
        for i, (degree, signal) in enumerate(zip(degrees, self.commands, strict=True)):
            w, most = RATES.get(signal.unit, RATE), SPEEDS.get(signal.unit, SPEED)
            y = ca.SX.sym("y", max(degree + 1, depth))
            first = ca.fmin(ca.fmax(w * (command[i] - y[0]), -most), most)
            rate = ca.vertcat(first, w * (y[:-1, :] - y[1:, :]))
            states.append(y)
            rates.append(rate)
            change = y[-1]
            for order in range(degree + 1):
                rows.append(change)
                if order < degree:
                    change = ca.jtimes(change, y, rate)
        state = ca.vertcat(ca.SX(0, 1), *states)
        inputs = {"state": state, "commands": command}
        self._rate = TracedFunction(
            "command rate", inputs, {"rate": ca.vertcat(ca.SX(0, 1), *rates)}
        )
        base = ca.SX.sym("base", len(rows))
        self._sum = TracedFunction(
            "commanded references",
            {**inputs, "base": base},
            {"R": base + ca.vertcat(ca.SX(0, 1), *rows)},
        )
        self.DeclareNumericParameter(BasicVector(np.zeros(len(self.commands))))
        self.DeclareContinuousState(BasicVector(np.zeros(state.numel())))

    def _declare_reference(self, sources: set[DependencyTicket]) -> None:
        super()._declare_reference({self.all_sources_ticket()})

    def _calc_reference(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(
            self._sum(*self._values(context), self.function(context.get_time()))[0]
        )

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        derivatives.get_mutable_vector().SetFromVector(self._rate(*self._values(context))[0])

    def _values(self, context: Context) -> tuple[np.ndarray, np.ndarray]:
        state = context.get_continuous_state_vector().CopyToVector()
        return state, context.get_numeric_parameter(0).value()

    def traced(self) -> Block:
        time = ca.SX.sym("t")
        base = ca.Function("base", [time], [traced_references(self.references, self.degrees, time)])
        computations = (
            Computation(base, (TIME,), ("base",)),
            Computation.of(self._sum, (STATE, PARAMETERS, "base"), ("reference",)),
            Computation.of(self._rate, (STATE, PARAMETERS), (DERIVATIVE,)),
        )
        return Block(self, computations, signals={"commands": self.commands})
