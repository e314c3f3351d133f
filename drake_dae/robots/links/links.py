"""What the links of a robot provide: M(q), H(q, v) and where their frames are."""

from collections.abc import Callable
from typing import Any, Protocol

import casadi as ca
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import Parameter, Signal


class Links(Protocol):
    """Rigid links without constraint: M(q) v' + H(q, v) = B u, q' = N(q) v.

    `MultibodyExpressions` takes them from a MultibodyPlant, `LinkExpressions` from equations.
    Expressions depend on `q`, `v` and the symbols of `parameters`.
    """

    @property
    def q(self) -> ca.SX: ...
    @property
    def v(self) -> ca.SX: ...
    @property
    def velocity_map(self) -> ca.SX: ...
    @property
    def mass_matrix(self) -> ca.SX: ...
    @property
    def bias(self) -> ca.SX: ...
    @property
    def actuation_matrix(self) -> FloatArray: ...
    @property
    def parameters(self) -> tuple[Parameter, ...]: ...
    @property
    def position_signals(self) -> tuple[Signal, ...]: ...
    @property
    def velocity_signals(self) -> tuple[Signal, ...]: ...
    @property
    def actuator_signals(self) -> tuple[Signal, ...]: ...
    @property
    def effort_limits(self) -> FloatArray: ...
    @property
    def reflected_inertia(self) -> FloatArray: ...
    @property
    def gear_ratios(self) -> FloatArray: ...
    @property
    def default_positions(self) -> FloatArray: ...
    @property
    def position_limits(self) -> tuple[FloatArray, FloatArray]: ...
    @property
    def velocity_limits(self) -> tuple[FloatArray, FloatArray]: ...

    def rotation(self, frame: Any) -> ca.SX:
        """R_WF(q), shape (3, 3)."""

    def position(self, frame: Any, point: ArrayLike = (0.0, 0.0, 0.0)) -> ca.SX:
        """Position in the world of a point that is fixed in a frame, m, shape (3, 1)."""

    def jacobian(self, phi: "Residual") -> ca.SX:
        """J = (dphi/dq) N of constraints phi(q), shape (m, nv)."""

    def motion(
        self, acceleration: ca.SX, phi: "Residual", multiplier: ca.SX
    ) -> tuple[ca.SX, ca.SX]:
        """M(q) v' + H(q, v) - J(q)^T lambda of (37), shape (nv, 1), and phi'', shape (m, 1).

        Args:
            acceleration: v', shape (nv, 1).
            phi: The constraints.
            multiplier: lambda, shape (m, 1).
        """


Residual = Callable[[Links], ca.SX]
"""phi(q) of links, or of stand-ins for them with the same frames, shape (m, 1)."""
