"""Axes with a fixed direction relative to a surface."""

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.dae import Parameter, Signal, signals
from drake_dae.errors import ModelError
from drake_dae.robots.constraints.constraint import Application, Constraint
from drake_dae.robots.links.kinematics import Frames, Kinematics
from drake_dae.robots.surfaces.surface import (
    Surface,
    Vector,
    axes_along,
    unit_vector,
    with_parameters,
)
from drake_dae.trace.expressions import length_of


@checked(ModelError)
@dataclass(frozen=True)
class AxisNormalToSurface(Constraint):
    """An axis of a frame points along the normal of a surface at a point of the frame:

        phi(q) = 2 / (1 + a . n) (c . n, -b . n),

    with the axis a, the two axes b, c across it so that b x c = a, and the unit normal n(p) toward
    the free side. Both rows are zero only for a = n; for a = -n they are infinite. The constraint
    forces are the moments in N m, about b and c, that the surface exerts on the frame; where a = n,
    phi' = (b . w, c . w) with the angular velocity w relative to the normal. On a curved surface
    the normal turns as the point moves, so the surface also exerts a force at the point, which
    follows from the moments. The environment gets the opposite.

    It restricts the direction only: the point may leave the surface, and the frame may turn about
    the axis. With a `PointOnSurface` at the same point a disk lies flush. For a tool whose axis
    points towards the surface, give the negative axis. The parameter "<name>.position" is the
    position of the surface; move it together with that of the `PointOnSurface`.

    Attributes:
        frame: Name of the frame.
        surface: A surface fixed in the world.
        axis: The axis in the frame, of any length, shape (3,).
        point: The point in the frame, m, shape (3,).
        name: The name of the constraint, the prefix of its forces and its parameter.
    """

    frame: str
    surface: Surface
    axis: Vector = (0.0, 0.0, 1.0)
    point: Vector = (0.0, 0.0, 0.0)
    name: str = "normal"
    parameters: tuple[Parameter, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "axis", unit_vector("axis", self.axis))
        position = Parameter(f"{self.name}.position", np.array(self.surface.position), "m")
        surface, shape = with_parameters(self.name, self.surface)
        object.__setattr__(self, "surface", surface)
        object.__setattr__(self, "parameters", (position, *shape))

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        return signals([f"{self.name}.moment_b", f"{self.name}.moment_c"], "N m")

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        return signals([f"{self.name}.tilt_b", f"{self.name}.tilt_c"], "rad")

    def residual(self, frames: Frames) -> ca.SX:
        a, b, c = self._axes(frames)
        n, _ = self._normal(frames)
        return 2 / (1 + ca.dot(a, n)) * ca.vertcat(ca.dot(c, n), -ca.dot(b, n))

    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        _, b, c = self._axes(kinematics)
        _, slope = self._normal(kinematics)
        point = kinematics.position(self.frame, self.point)
        # (c . n)' = b . w + c . dn/dp p', and likewise for -b . n.
        force = ca.mtimes(slope.T, ca.horzcat(c, -b))
        return (Application(point, force, ca.horzcat(b, c), self.frame),)

    def _axes(self, frames: Frames) -> tuple[ca.SX, ca.SX, ca.SX]:
        """a, b and c in the world."""
        across = axes_along(self.axis)
        rotation = frames.rotation(self.frame)
        b, c, a = (ca.mtimes(rotation, ca.SX(across[:, i])) for i in range(3))
        return a, b, c

    def _normal(self, frames: Frames) -> tuple[ca.SX, ca.SX]:
        """n, shape (3, 1), and its derivative by the point, dn/dp in 1/m, shape (3, 3)."""
        p = ca.SX.sym("p", 3)
        gradient = self.surface.unit_normal(p)
        normal = gradient / length_of(gradient)
        offset = frames.position(self.frame, self.point) - self.parameters[0].symbol
        both = ca.substitute(ca.horzcat(normal, ca.jacobian(normal, p)), p, offset)
        return both[:, 0], ca.sparsify(both[:, 1:])
