"""Holonomic constraints phi(q) = 0.                                             (38)"""

from typing import Protocol

import casadi as ca

from drake_dae.dae.signals import Parameter, Signal
from drake_dae.robots.links.links import Links


class Constraint(Protocol):
    """phi(q) = 0 with its multiplier lambda: J^T lambda acts on the robot (37).

    Attributes:
        name: Of the constraint.
        parameters: What of it can be changed without tracing again.
        force_signals: Name and unit of each multiplier.
        residual_signals: Name and unit of each component of phi.
    """

    @property
    def name(self) -> str: ...

    @property
    def parameters(self) -> tuple[Parameter, ...]: ...

    @property
    def force_signals(self) -> tuple[Signal, ...]: ...

    @property
    def residual_signals(self) -> tuple[Signal, ...]: ...

    def residual(self, links: Links) -> ca.SX:
        """phi(q), shape (m, 1)."""
