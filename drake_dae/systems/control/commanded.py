"""References that a person changes while they run, as a LeafSystem.                   (28)"""

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.blocks.block import stacked
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.dae import Signal
from drake_dae.errors import ReferenceSignalError
from drake_dae.references import Reference
from drake_dae.systems.control.references import (
    ReferenceGenerator,
    common_parameters,
    reference_block,
)

RATES, RATE = {"N": 40.0, "N m": 40.0}, 12.0
"""Unit -> the rate w of the lags, in 1/s; that of others."""

SPEEDS, SPEED = {"m": 0.4, "N": 400.0, "N m": 40.0}, 1.0
"""Unit -> the largest speed V of a change, in this unit per second; that of others."""


@checked(ReferenceSignalError)
class CommandedReferences(ReferenceGenerator):
    """References with changes that are commanded while they run.

    Numeric parameter 0 has the commands, named by `commands`: a change of each reference in its
    unit, 0 by default, which may jump at any time. A law needs a reference with mu derivatives, so
    that a command c passes through mu + 1 lags of rate w, the first of limited speed:

        y_0' = sat(w (c - y_0), V),    y_j' = w (y_(j-1) - y_j),    j = 1, ..., mu,

    and y_mu is added to the reference. Its derivatives up to mu are sums of y_0, ..., y_mu. A lag
    is a mean with positive weights, so that y_mu does not overshoot, |y_mu'| <= V, and
    |y_mu^(k)| <= (2 w)^(k-1) V. The state are the lags. `depth` is their least number, for another
    block with the same commands and more derivatives; `signals` are names and units of the outputs,
    and so of the commands.
    """

    __slots__ = TracedSystem.__slots__

    def __init__(
        self,
        references: Sequence[Reference],
        degrees: Sequence[int],
        signals: Sequence[Signal],
        *,
        depth: int = 0,
    ) -> None:
        self.references, self.degrees = tuple(references), tuple(degrees)
        self.reference_parameters = common_parameters(self.references)
        if self.reference_parameters:
            raise ReferenceSignalError(
                "references with parameters cannot be commanded: write the numbers of "
                f"{', '.join(self.reference_parameters)} into the expressions"
            )
        self._base = base = reference_block(self.references, self.degrees, {})
        self.commands = tuple(signals)
        if len(self.commands) != len(self.degrees):
            raise ReferenceSignalError(
                f"{len(self.degrees)} degrees have {len(self.commands)} signals"
            )
        command = ca.SX.sym("c", len(self.commands))
        states, rates, rows = list[ca.SX](), list[ca.SX](), list[ca.SX]()
        for i, (degree, signal) in enumerate(zip(degrees, self.commands, strict=True)):
            w, most = RATES.get(signal.unit, RATE), SPEEDS.get(signal.unit, SPEED)
            y = ca.SX.sym("y", max(degree + 1, depth))
            first = ca.fmin(ca.fmax(w * (command[i] - y[0]), -most), most)
            rate = ca.vertcat(first, w * (y[:-1, :] - y[1:, :]))
            states.append(y)
            rates.append(rate)
            rows.append(y[-1])
            for _ in range(degree):
                rows.append(ca.jtimes(rows[-1], y, rate))
        block = replace(
            base,
            outputs={"reference": base.outputs["reference"] + stacked(rows)},
            state=stacked(states),
            derivative=stacked(rates),
            parameters=command,
            start={},
            signals={"parameters": self.commands},
        )
        TracedSystem.__init__(self, block, sees_steps=False)
