"""Blocks that a user wrote: traced ones, and one that Drake converts to expressions."""

import casadi as ca
from pydrake.systems.framework import BasicVector_, LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem

from drake_dae import Block, TracedSystem
from drake_dae.blocks.block import Requirement


def Guarded():
    """y = 2 u, a value that is of use only where u > 0, though it is finite everywhere."""
    u = ca.SX.sym("u")
    positive = Requirement.regular(u, "u")
    return TracedSystem(
        Block("guarded", {"u": u}, {"y": positive.of(2.0 * u)}, requirements=(positive,))
    )


@TemplateSystem.define("Counter_")
def Counter_(T):
    """Adds its input to what it has at t_k = offset + k period."""

    class Impl(LeafSystem_[T]):
        def _construct(self, period=0.1, offset=0.03, converter=None):
            super().__init__(converter)
            self.period, self.offset = period, offset
            self.DeclareVectorInputPort("step", BasicVector_[T](1))
            self.DeclareDiscreteState(1)
            self.DeclarePeriodicDiscreteUpdateEvent(period, offset, self._add)
            self.DeclareVectorOutputPort("sum", 1, self._calc, {self.xd_ticket()})

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, other.period, other.offset, converter=converter)

        def _add(self, context, state):
            before = context.get_discrete_state(0)[0]
            state.set_value(0, [before + self.GetInputPort("step").Eval(context)[0]])

        def _calc(self, context, output):
            output[0] = context.get_discrete_state(0)[0]

    return Impl
