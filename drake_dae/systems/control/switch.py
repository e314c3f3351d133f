"""The switch between the controls of several laws."""

from collections.abc import Sequence

import casadi as ca

from drake_dae.blocks.block import Block
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.blocks.traced_system import TracedSystem


class LawSwitch(TracedSystem):
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
        chosen = ca.SX.sym("law")
        controls = {name: ca.SX.sym(name, size) for name in names}
        first, *others = controls.values()
        for i, other in enumerate(others, 1):
            first = ca.if_else(chosen > i - 0.5, other, first)
        super().__init__(Block("law_switch", {"law": chosen, **controls}, {"control": first}))
