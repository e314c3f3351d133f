"""Blocks that a user wrote: traced ones, and one that Drake converts to expressions."""

import casadi as ca
from pydrake.systems.framework import BasicVector_, LeafSystem, LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem

from drake_dae.blocks.computations import HELD, Computation, Computations, Update
from drake_dae.trace.functions import TracedFunction


class Guarded(LeafSystem):
    """y = 2 u, a value that is of use only where u > 0, though it is finite everywhere."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("u", 1)
        self.DeclareVectorOutputPort("y", 1, self._calc)
        u = ca.SX.sym("u")
        self._function = TracedFunction("guarded", {"u": u}, {"y": 2.0 * u}, pivot=u)

    def _calc(self, context, output):
        output.SetFromVector(2.0 * self.GetInputPort("u").Eval(context))

    def traced(self):
        return Computations(self, (Computation.of(self._function, ("u",), ("y",)),))


class Latch(LeafSystem):
    """Holds its input "u" from sample to sample, and at the start its input "first"."""

    def __init__(self, period):
        super().__init__()
        self.period = period
        self.DeclareVectorInputPort("u", 1)
        self.DeclareVectorInputPort("first", 1)
        self._state = self.DeclareDiscreteState([float("nan")])
        self.DeclareStateOutputPort("y", self._state)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._read)

    def _read(self, context, state):
        state.set_value(self._state, self.GetInputPort("u").Eval(context))

    def traced(self):
        value = ca.SX.sym("value")
        same = ca.Function("same", [value], [value])
        return Computations(
            self,
            (Computation(same, (HELD,), ("y",)),),
            (Update(Computation(same, ("u",), (HELD,)), self.period),),
            initial=Computation(same, ("first",), (HELD,)),
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
