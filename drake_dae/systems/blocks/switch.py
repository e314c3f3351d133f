"""The switch between the controls of two laws."""

import casadi as ca
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly
from drake_dae.systems.blocks.traced import Block, Computation


class LawSwitch(LeafSystem):
    """Passes the control of one of two laws; the other one is not evaluated.

    Input ports:
        in_contact: 1 while the law in contact is active, otherwise 0, shape (1,).
        free, contact: The controls of both laws, shape (p,).

    Output port:
        control: The control of the active law, shape (p,).

    Args:
        size: p.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, size: int) -> None:
        super().__init__()
        self.set_name("law_switch")
        self._size = size
        self._chosen = self.DeclareVectorInputPort("in_contact", 1)
        self._ports = [self.DeclareVectorInputPort(name, size) for name in ("free", "contact")]
        self.DeclareVectorOutputPort("control", size, weakly(self._calc))

    def _calc(self, context: Context, output: BasicVector) -> None:
        which = int(self._chosen.Eval(context)[0] > 0.5)
        output.SetFromVector(self._ports[which].Eval(context))

    def traced(self) -> Block:
        chosen = ca.SX.sym("in_contact")
        free, contact = (ca.SX.sym(name, self._size) for name in ("free", "contact"))
        inputs = [chosen, free, contact]
        function = ca.Function("switch", inputs, [ca.if_else(chosen > 0.5, contact, free)])
        sources = ("in_contact", "free", "contact")
        choice = ("in_contact", "contact", "free")
        return Block(self, (Computation(function, sources, ("control",), choice=choice),))
