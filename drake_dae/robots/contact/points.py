"""Points that stay on a surface, or on each other."""

from dataclasses import dataclass, field
from typing import ClassVar

import casadi as ca
import numpy as np

from drake_dae.arrays import check_axes
from drake_dae.dae.signals import Parameter, Signal, signals
from drake_dae.robots.contact.surfaces import Surface, Vector
from drake_dae.robots.links.links import Links


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
