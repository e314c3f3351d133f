"""How forces are shared among redundant constraints."""

from dataclasses import dataclass

import casadi as ca

from drake_dae.dae.system.signals import Signal


@dataclass(frozen=True, eq=False)
class ForceSharing:
    """The distribution of forces among redundant constraints, some of which are removed.

    The motion determines the sum v = G(x) v_all alone. Among all v_all with that sum the one with
    the least sum of c_i v_i^2 is shown, v_all = T(x) v: G T = 1. See `share_forces`.
    """

    split: ca.SX
    gather: ca.SX
    signals: tuple[Signal, ...]
    undetermined: tuple[str, ...]
    left_out: ca.SX
    left_out_signals: tuple[Signal, ...]
