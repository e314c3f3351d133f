"""The switch between the controls of several laws."""

from collections.abc import Sequence

import casadi as ca
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_dae.blocks.computations import Block, Computation
from drake_dae.blocks.lifetime import SHARED_DICTIONARY, weakly


class LawSwitch(LeafSystem):
    """Passes the control of one of several laws; the others are not evaluated.

    Input ports:
        law: The number of the active law, from 0, shape (1,).
        <name>: The control of each law, shape (p,).

    Output port:
        control: The control of the active law, shape (p,).

    Args:
        size: p.
        names: The names of the laws.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, size: int, names: Sequence[str]) -> None:
        super().__init__()
        self.set_name("law_switch")
        self._size, self._names = size, tuple(names)
        self._chosen = self.DeclareVectorInputPort("law", 1)
        self._ports = [self.DeclareVectorInputPort(name, size) for name in names]
        self.DeclareVectorOutputPort("control", size, weakly(self._calc))

    def _calc(self, context: Context, output: BasicVector) -> None:
        which = round(self._chosen.Eval(context)[0])
        output.SetFromVector(self._ports[which].Eval(context))

    def traced(self) -> Block:
        chosen = ca.SX.sym("law")
        controls = [ca.SX.sym(name, self._size) for name in self._names]
        control = controls[0]
        for i, other in enumerate(controls[1:], 1):
            control = ca.if_else(chosen > i - 0.5, other, control)
        function = ca.Function("switch", [chosen, *controls], [control])
        sources = ("law", *self._names)
        return Block(self, (Computation(function, sources, ("control",), choice=sources),))
