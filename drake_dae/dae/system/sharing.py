"""How forces are shared among redundant constraints."""

from dataclasses import dataclass

import casadi as ca

from drake_dae.dae.system.signals import Signal


@dataclass(frozen=True, eq=False)
class ForceSharing:
    """The distribution of forces among redundant constraints, some of which are removed.

    The motion determines the sum v = G(x) v_all alone. Among all v_all with that sum the one with
    the least sum of c_i v_i^2 is shown, v_all = T(x) v: G T = 1. See `share_forces`.

    Attributes:
        split: T(x), shape (M, m).
        gather: G(x), shape (m, M): the identity at the constraints that stay.
        signals: Names and units of v_all.
        undetermined: The names of those that (1)-(3) do not determine: another split moves the
            system in the same way.
        left_out: The constraint outputs that follow from k on N*, shape (M - m, 1).
        left_out_signals: Their names and units.
    """

    split: ca.SX
    gather: ca.SX
    signals: tuple[Signal, ...]
    undetermined: tuple[str, ...]
    left_out: ca.SX
    left_out_signals: tuple[Signal, ...]
