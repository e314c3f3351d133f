"""References that a person changes while they run, as a LeafSystem."""

from collections.abc import Sequence

import casadi as ca
from pydrake.systems.framework import BasicVector, Context, ContinuousState, DependencyTicket

from drake_dae.arguments import checked
from drake_dae.dae.references import Reference
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ReferenceSignalError
from drake_dae.systems.blocks.traced import DERIVATIVE, PARAMETERS, STATE, TIME, Block, Computation
from drake_dae.systems.control.command_filter import CommandFilter, CommandLimits
from drake_dae.systems.control.references import ReferenceGenerator, traced_references


@checked(ReferenceSignalError)
class CommandedReferences(ReferenceGenerator):
    """References with changes that are commanded while they run; see `CommandFilter`.

    Numeric parameter 0 has the commands, named by `commands`: the speed along the path, 1 by
    default, and a change of each reference in its unit, 0 by default. It may jump at any time; the
    reference is smooth and within `limits`. The state is the time s along the path and the stages
    of the filter.

    Output port:
        reference: R of (28) for r(s(t)) + changes, shape (sum (mu_i + 1),).

    The block does not convert to AutoDiffXd, since the filter has kinks.

    Args:
        references: The references, in the order of the outputs.
        degrees: The degrees mu_1, ..., mu_p.
        signals: Names and units of the outputs.
        limits: How fast the reference follows.
        start_time: s at the start, in s.
        has_speed, depth: As of `CommandFilter`.

    Raises:
        ReferenceSignalError: As of `ReferenceGenerator`; or a reference has parameters.
    """

    no_gradient = "commands pass a filter with kinks"

    def __init__(
        self,
        references: Sequence[Reference],
        degrees: Sequence[int],
        signals: Sequence[Signal],
        limits: CommandLimits,
        start_time: float = 0.0,
        *,
        has_speed: bool = True,
        depth: int = 0,
    ) -> None:
        super().__init__(references, degrees)
        if self.reference_parameters:
            raise ReferenceSignalError(
                "references with parameters cannot be commanded: write the numbers of "
                f"{', '.join(self.reference_parameters)} into the expressions"
            )
        self.filter = CommandFilter(signals, degrees, limits, has_speed=has_speed, depth=depth)
        self.DeclareNumericParameter(BasicVector(self.filter.defaults))
        self.DeclareContinuousState(BasicVector(self.filter.start(start_time)))

    @property
    def commands(self) -> tuple[Signal, ...]:
        """Names and units of the commands, the entries of numeric parameter 0."""
        return self.filter.commands

    def _declare_reference(self, sources: set[DependencyTicket]) -> None:
        super()._declare_reference({self.all_sources_ticket()})

    def _calc_reference(self, context: Context, output: BasicVector) -> None:
        state, time = context.get_continuous_state_vector().CopyToVector(), context.get_time()
        base = self.function(state[0] if self.filter.has_speed else time)
        commands = context.get_numeric_parameter(0).value()
        output.SetFromVector(self.filter.stacked(time, state, commands, base)[0])

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        state = context.get_continuous_state_vector().CopyToVector()
        rate = self.filter.rate(state, context.get_numeric_parameter(0).value())[0]
        derivatives.get_mutable_vector().SetFromVector(rate)

    def traced(self) -> Block:
        time, state = ca.SX.sym("t"), ca.SX.sym("state", self.filter.num_states)
        s = state[0] if self.filter.has_speed else time
        at = ca.SX.sym("s")
        base = ca.Function("base", [at], [traced_references(self.references, self.degrees, at)])
        at_time = ca.Function("base", [time, state], [base(s)])
        computations = (
            Computation(at_time, (TIME, STATE), ("base",)),
            Computation.of(self.filter.stacked, (TIME, STATE, PARAMETERS, "base"), ("reference",)),
            Computation.of(self.filter.rate, (STATE, PARAMETERS), (DERIVATIVE,)),
        )
        return Block(self, computations, signals={"commands": self.commands})
