"""Wheels: nonholonomic constraints."""

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.dae import Parameter, Signal, signals
from drake_dae.errors import ModelError
from drake_dae.robots.constraint import Constraint
from drake_dae.robots.links import Application, Kinematics
from drake_dae.robots.surface import Vector, unit_vector
from drake_dae.trace.expressions import length_of


@checked(ModelError)
@dataclass(frozen=True)
class RollingWheel(Constraint):
    """A wheel rolls on level ground: its contact point has no velocity along the ground:

        0 = f . v_c,  0 = s . v_c,    v_c = p_W' - radius (w x u),

    with the center p_W, the wheel's angular velocity w, the unit vector u from the contact point to
    the center, in the wheel's plane, the heading f = axle x n / |axle x n|, and s = n x f, which is
    the axle of an upright wheel (r = 1, nonholonomic). The constraint forces are the traction and
    the side force in N that the ground exerts on the wheel at the contact point, positive along f
    and s; the ground gets the opposite. Positive rotation about the axle moves the wheel forward.
    The parameter "<name>.radius" is the radius.

    It does not restrict the height: for a floating base, keep the center of each wheel there by a
    `PointOnSurface`. For a second wheel on the same axle set holds_side = False.

    Attributes:
        frame: Name of a frame on the wheel.
        radius: Its radius, m, positive.
        axle: The axle in the frame, of any length, toward the left of the forward direction, shape
            (3,).
        center: Its center in the frame, m, shape (3,).
        normal: The normal n of the ground, in the world, up, of any length, shape (3,).
        holds_side: Whether sideways motion of the wheel is constrained.
        name: The name of the constraint, the prefix of its forces and its parameter.
    """

    frame: str
    radius: float
    axle: Vector = (0.0, 1.0, 0.0)
    center: Vector = (0.0, 0.0, 0.0)
    normal: Vector = (0.0, 0.0, 1.0)
    holds_side: bool = True
    name: str = "wheel"

    def __post_init__(self) -> None:
        for name in ("axle", "normal"):
            object.__setattr__(self, name, unit_vector(name, getattr(self, name)))
        super().__post_init__()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter(f"{self.name}.radius", np.array([self.radius]), "m", positive=True),)

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        kinds = ("traction", "side_force") if self.holds_side else ("traction",)
        return signals([f"{self.name}.{kind}" for kind in kinds], "N")

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        kinds = ("slip", "side_speed") if self.holds_side else ("slip",)
        return signals([f"{self.name}.{kind}" for kind in kinds], "m/s")

    def rate(self, kinematics: Kinematics) -> ca.SX:
        lever, directions = self._contact(kinematics)
        spin = kinematics.angular_velocity(self.frame)
        velocity = kinematics.velocity(self.frame, self.center) - ca.cross(spin, lever)
        return ca.mtimes(directions.T, velocity)

    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        lever, directions = self._contact(kinematics)
        point = kinematics.position(self.frame, self.center) - lever
        return (Application(point, directions, ca.SX(3, directions.shape[1]), self.frame),)

    def _contact(self, kinematics: Kinematics) -> tuple[ca.SX, ca.SX]:
        """radius u, shape (3, 1), and the directions f and s, shape (3, m)."""
        n = ca.SX(self.normal)
        axle = ca.mtimes(kinematics.rotation(self.frame), ca.SX(self.axle))
        along = ca.cross(axle, n)
        f = along / length_of(along)
        lever = self.parameters[0].symbol * ca.cross(f, axle)
        return lever, ca.horzcat(f, ca.cross(n, f)) if self.holds_side else f
