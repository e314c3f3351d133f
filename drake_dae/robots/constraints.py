"""Holonomic constraints phi(q) = 0.                                             (38)"""

from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform

from drake_dae.dae.signals import Parameter, Signal, signals
from drake_dae.errors import ModelError
from drake_dae.robots.joints import constant_pose
from drake_dae.robots.links import Links
from drake_dae.robots.surfaces import Surface, Vector


class Constraint(Protocol):
    """phi(q) = 0 with its multiplier lambda: J^T lambda acts on the robot (37).

    Attributes:
        parameters: What of it can be changed without tracing again.
        force_signals: Name and unit of each multiplier.
        residual_signals: Name and unit of each component of phi.
    """

    @property
    def parameters(self) -> tuple[Parameter, ...]: ...

    @property
    def force_signals(self) -> tuple[Signal, ...]: ...

    @property
    def residual_signals(self) -> tuple[Signal, ...]: ...

    def residual(self, links: Links) -> ca.SX:
        """phi(q), shape (m, 1)."""


@dataclass(frozen=True)
class PointOnSurface:
    """A point of a frame stays on a surface: phi(q) = signed distance of p_W(q).

    The multiplier is the normal force of the surface on the robot in N; positive pushes the robot
    to the free side, and a unilateral contact can only push. The parameter "<name>.position" is
    where the surface stands.

    Attributes:
        frame: Name of the frame.
        surface: A surface that stands in the world.
        point: The point in the frame, m, shape (3,).
        name: Of the constraint, its multiplier and its parameter.
    """

    frame: str
    surface: Surface
    point: Vector = (0.0, 0.0, 0.0)
    name: str = "surface"
    parameters: tuple[Parameter, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        position = Parameter(f"{self.name}.position", np.array(self.surface.position), "m")
        object.__setattr__(self, "parameters", (position,))

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        return (Signal(f"{self.name}.force", "N"),)

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        return (Signal(f"{self.name}.distance", "m"),)

    def offset(self, links: Links) -> ca.SX:
        """The point relative to where the surface stands, m, shape (3, 1)."""
        return links.position(self.frame, self.point) - self.parameters[0].symbol

    def residual(self, links: Links) -> ca.SX:
        return self.surface.distance(self.offset(links))

    def normal(self, links: Links) -> ca.SX:
        """Unit normal at the point, toward the free side, shape (3, 1)."""
        p = ca.SX.sym("p", 3)
        gradient = ca.gradient(self.surface.distance(p), p)
        return ca.substitute(gradient, p, self.offset(links))


@dataclass(frozen=True, eq=False)
class WeldedFrames:
    """Frame B keeps a pose (R, p) in frame A, as with Drake's WeldFrames and AddWeldConstraint:

        phi(q) = (p_AB(q) - p, 2 tan(theta / 2) n),    R_AB(q) R^T = turn by theta about n,

    all in the axes of A. The multiplier is what A exerts on B, a force in N at B's origin and a
    moment in N m, in the axes of A; B exerts the opposite on A at the same point. For at phi = 0
    phi' = (v, w), the velocity and angular velocity of B in A, so that lambda^T phi' is the power
    of such a force and moment: p_AB' = v, and with E = R_AB R^T, E' = w x E, the orientation error

        r = 2 tan(theta / 2) n = 2 vee(E - E^T) / (1 + tr E)

    has r' = w + w x r / 2 + (w . r) r / 4, which is w at r = 0. It is smooth up to half a turn,
    where it is infinite: unlike the sine of theta it has no other zero than the pose itself. The
    parameter "<name>.position" is p.

    Attributes:
        frame_a: Name of frame A; "world" holds B in place.
        frame_b: Name of frame B, on another body.
        pose: X_AB, the pose of B in A; by default the frames coincide.
        name: Of the constraint, its multipliers and its parameter.
    """

    frame_a: str
    frame_b: str
    pose: RigidTransform = field(default_factory=RigidTransform)
    name: str = "weld"
    parameters: tuple[Parameter, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", RigidTransform(self.pose))
        position = Parameter(f"{self.name}.position", self.pose.translation(), "m")
        object.__setattr__(self, "parameters", (position,))

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        forces, moments = ([f"{self.name}.{kind}{axis}" for axis in "xyz"] for kind in "fm")
        return (*signals(forces, "N"), *signals(moments, "N m"))

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        shifts, turns = ([f"{self.name}.{kind}{axis}" for axis in "xyz"] for kind in ("", "r"))
        return (*signals(shifts, "m"), *signals(turns, "rad"))

    def residual(self, links: Links) -> ca.SX:
        R_AW = links.rotation(self.frame_a).T
        offset = links.position(self.frame_b) - links.position(self.frame_a)
        wanted = ca.SX(ca.sparsify(ca.DM(constant_pose(self.pose)[0])))
        E = ca.mtimes(R_AW, ca.mtimes(links.rotation(self.frame_b), wanted.T))
        skew = ca.vertcat(E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1])
        shift = ca.mtimes(R_AW, offset) - self.parameters[0].symbol
        return ca.vertcat(shift, 2 * skew / (1 + ca.trace(E)))


@dataclass(frozen=True)
class CoincidentPoints:
    """A point of frame B stays on a point of frame A: phi(q) = p_WB(q) - p_WA(q).

    A ball joint that closes a loop; a pin, in a mechanism that moves in a plane and so needs the
    axes of that plane alone. The multiplier is the force in N, in world axes, that A exerts on B at
    the point; B exerts the opposite on A.

    Attributes:
        frame_a: Name of frame A, for example "world".
        point_a: The point in frame A, m, shape (3,).
        frame_b: Name of frame B, on another body.
        point_b: The point in frame B, m, shape (3,).
        axes: In which of the world's axes "xyz" they coincide, for example "xz".
        name: Of the constraint and its multipliers.
    """

    frame_a: str
    point_a: Vector
    frame_b: str
    point_b: Vector
    axes: str = "xyz"
    name: str = "pin"
    parameters: ClassVar[tuple[Parameter, ...]] = ()

    def __post_init__(self) -> None:
        check_axes("axes", self.axes)

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        return signals([f"{self.name}.f{axis}" for axis in self.axes], "N")

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        return signals([f"{self.name}.{axis}" for axis in self.axes], "m")

    def residual(self, links: Links) -> ca.SX:
        point_b = links.position(self.frame_b, self.point_b)
        apart = point_b - links.position(self.frame_a, self.point_a)
        return apart[["xyz".index(axis) for axis in self.axes]]


def check_axes(name: str, axes: str) -> None:
    """Refuses what is not distinct letters of "xyz".

    Raises:
        ModelError: So.
    """
    if not axes or any(a not in "xyz" for a in axes) or len(set(axes)) != len(axes):
        raise ModelError(f"{name} must be distinct letters of x, y, z, got '{axes}'")
