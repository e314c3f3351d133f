"""Contacts with a surface: a point that stays on it, with friction; an axis along its normal."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive
from drake_dae.dae import Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.constraint import Constraint, Touch
from drake_dae.robots.links import Application, Frames, Kinematics, Reaction
from drake_dae.robots.surface import (
    Surface,
    Vector,
    axes_along,
    rotation_of,
    unit_vector,
    with_parameters,
)
from drake_dae.trace.expressions import length_of


@checked(ModelError)
@dataclass(frozen=True)
class PointOnSurface(Constraint):
    """A point of a frame stays on a surface: phi(q) = signed distance of p_W(q).

    The constraint force is the normal force of the surface on the robot in N, positive towards the
    free side; the contact is unilateral. The parameters "<name>.position" and "<name>.rpy" are the
    position and orientation of the surface; if they are exogenous (see `RobotModel`), the surface
    moves. Numbers of the surface's `shape` are parameters "<name>.<number>".

    With friction the surface also exerts a tangential force, with the sliding velocity v_t in m/s
    relative to the surface:

        F_t = -(mu lambda s + d v_t),    s = v_t / sqrt(|v_t|^2 + v_s^2),

    regularized Coulomb friction with the speed v_s, and viscous friction. It does not stick: below
    v_s the point creeps. The parameters "<name>.friction", "<name>.stiction_tolerance" and
    "<name>.viscous_friction" are mu, v_s and d. If friction reverses the effect of lambda on phi'',
    the Painleve paradox occurs: see `dae.contacts`. Behind flexible joints, motors or hydraulics
    the law differentiates s: v_s = 0.01 m/s (0.03 m/s with hydraulics) avoids peaks at reversals.

    Attributes:
        frame: Name of the frame.
        surface: A surface in the world.
        point: The point in the frame, m, shape (3,).
        name: The name of the constraint, the prefix of its force and its parameters.
        rpy: Roll, pitch and yaw of the surface, rad, shape (3,); None for no such parameter.
        friction: mu, not negative; None for no friction and no such parameters.
        stiction_tolerance: v_s in m/s, Drake's stiction tolerance; only with friction.
        viscous_friction: d in N s/m, not negative; None for none, without a parameter.

    Raises:
        ModelError: A coefficient is negative, or the speed not positive.
    """

    frame: str
    surface: Surface
    point: Vector = (0.0, 0.0, 0.0)
    name: str = "surface"
    rpy: Vector | None = None
    friction: float | None = None
    stiction_tolerance: float = 1e-3
    viscous_friction: float | None = None
    is_unilateral: ClassVar[tuple[bool, ...]] = (True,)
    force_units: ClassVar = {"force": "N"}
    residual_units: ClassVar = {"distance": "m"}

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        name = self.name
        made = [Parameter(f"{name}.position", np.array(self.surface.position), "m")]
        if self.rpy is not None:
            made.append(Parameter(f"{name}.rpy", np.array(self.rpy), "rad"))
        if (mu := self.friction) is not None:
            slow = np.array([self.stiction_tolerance])
            made.append(Parameter(f"{name}.friction", np.array([mu]), nonnegative=True))
            made.append(Parameter(f"{name}.stiction_tolerance", slow, "m/s", positive=True))
        if (d := self.viscous_friction) is not None:
            drag = Parameter(f"{name}.viscous_friction", np.array([d]), "N s/m", nonnegative=True)
            made.append(drag)
        return (*made, *self._form[1])

    @cached_property
    def _form(self) -> tuple[Surface, tuple[Parameter, ...]]:
        """The surface with symbols for the numbers of its shape, and these parameters."""
        return with_parameters(self.name, self.surface)

    @property
    def coordinate_signals(self) -> tuple[Signal, ...]:
        coordinates = self.surface.coordinate_signals
        return tuple(Signal(f"{self.name}.{signal.name}", signal.unit) for signal in coordinates)

    @property
    def is_ideal(self) -> bool:
        return self.friction is None and self.viscous_friction is None

    @property
    def friction_parameter(self) -> str | None:
        return None if self.friction is None else f"{self.name}.friction"

    @property
    def rotation(self) -> ca.SX:
        """The orientation of the surface in the world, shape (3, 3)."""
        return ca.SX.eye(3) if self.rpy is None else rotation_of(self.parameters[1].symbol)

    def offset(self, frames: Frames) -> ca.SX:
        return self.offset_of(frames.position(self.frame, self.point))

    def offset_of(self, point: ca.SX) -> ca.SX:
        """A point in the world relative to the surface, in its axes, m, shape (3, 1)."""
        offset = point - self.parameters[0].symbol
        return offset if self.rpy is None else ca.mtimes(self.rotation.T, offset)

    def residual(self, frames: Frames) -> ca.SX:
        return self._form[0].distance(self.offset(frames))

    def coordinates(self, frames: Frames) -> ca.SX:
        return self._form[0].coordinates(self.offset(frames))

    def normal(self, frames: Frames) -> ca.SX:
        """The gradient of phi in the world, shape (3, 1)."""
        normal = self._form[0].unit_normal(self.offset(frames))
        return normal if self.rpy is None else ca.mtimes(self.rotation, normal)

    def surface_velocity(self, point: ca.SX) -> ca.SX:
        """The velocity of the surface at a point in the world, m/s, shape (3, 1)."""
        moved = self.parameters[0].rate
        if self.rpy is None:
            return moved
        turn, offset = self.parameters[1], ca.SX.sym("offset", 3)
        turning = ca.jtimes(ca.mtimes(self.rotation, offset), turn.symbol, turn.rate)
        return moved + ca.substitute(turning, offset, self.offset_of(point))

    def sliding(self, kinematics: Kinematics) -> ca.SX | None:
        if self.is_ideal:
            return None
        moved = self.surface_velocity(kinematics.position(self.frame, self.point))
        velocity = kinematics.velocity(self.frame, self.point) - moved
        normal = self.normal(kinematics)
        return velocity - normal * ca.dot(normal, velocity)

    def _rubbing(self, kinematics: Kinematics) -> tuple[ca.SX, ca.SX]:
        """-mu s, for a unit of the normal force, and -d v_t in N, shapes (3, 1)."""
        if (sliding := self.sliding(kinematics)) is None:
            return ca.SX(3, 1), ca.SX(3, 1)
        speed = ca.sqrt(ca.sumsqr(sliding) + self.symbol("stiction_tolerance") ** 2)
        pull = -self.symbol("friction") * (sliding / speed)
        return pull, -self.symbol("viscous_friction") * sliding

    def reaction(self, kinematics: Kinematics, constraint_force: ca.SX) -> Reaction:
        pushed = super().reaction(kinematics, constraint_force)
        if self.friction is None:
            return pushed
        pull = self._rubbing(kinematics)[0] * constraint_force
        return pushed + kinematics.push(self.frame, pull, self.point)

    def drag(self, kinematics: Kinematics) -> Reaction:
        if self.viscous_friction is None:
            return super().drag(kinematics)
        return kinematics.push(self.frame, self._rubbing(kinematics)[1], self.point)

    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        pull, drag = self._rubbing(kinematics)
        push, point = self.normal(kinematics) + pull, kinematics.position(self.frame, self.point)
        return (Application(point, push, ca.SX(3, 1), self.frame, drag=drag),)

    def touch(self, frames: Frames) -> Touch:
        return Touch(
            self.frame,
            self.point,
            self.normal(frames),
            lambda point: self._form[0].distance(self.offset_of(point)),
            self.surface_velocity,
            self.surface.has_exact_distance,
        )

    def surface_at(self, values: FloatArray) -> Surface:
        return self.surface.shaped(ca.SX(values[len(values) - len(self.surface.shape) :]))

    def placement(self, values: FloatArray) -> RigidTransform:
        turn = np.zeros(3) if self.rpy is None else values[3:6]
        return RigidTransform(RollPitchYaw(turn), values[:3])


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

    It restricts the direction only; with a `PointOnSurface` at the same point a disk lies flush.
    For a tool whose axis points towards the surface, give the negative axis. The parameter
    "<name>.position" is the position of the surface; move it with that of the `PointOnSurface`.

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
    force_units: ClassVar = {"moment_b": "N m", "moment_c": "N m"}
    residual_units: ClassVar = {"tilt_b": "rad", "tilt_c": "rad"}

    def __post_init__(self) -> None:
        object.__setattr__(self, "axis", unit_vector("axis", self.axis))
        super().__post_init__()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        position = Parameter(f"{self.name}.position", np.array(self.surface.position), "m")
        return (position, *self._form[1])

    @cached_property
    def _form(self) -> tuple[Surface, tuple[Parameter, ...]]:
        return with_parameters(self.name, self.surface)

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
        gradient = self._form[0].unit_normal(p)
        normal = gradient / length_of(gradient)
        offset = frames.position(self.frame, self.point) - self.parameters[0].symbol
        both = ca.substitute(ca.horzcat(normal, ca.jacobian(normal, p)), p, offset)
        return both[:, 0], ca.sparsify(both[:, 1:])


@dataclass(frozen=True)
class FrictionCone:
    """The bound |tangential force| <= limit * normal force of a contact that must not slide.

    Attributes:
        normal: The name of the normal force, a constraint force that is positive in contact.
        tangents: The names of one or two tangential forces.
        limit: The largest ratio of the forces, positive: the coefficient of static friction.
    """

    normal: str
    tangents: Sequence[str]
    limit: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "tangents", tuple(self.tangents))
        positive("limit", self.limit)
        if not 1 <= len(self.tangents) <= 2:
            raise ModelError(
                f"a friction cone has one or two tangential forces, got {len(self.tangents)}"
            )
