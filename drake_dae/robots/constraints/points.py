"""Points on a surface, and points at a fixed distance."""

from dataclasses import dataclass, field
from typing import ClassVar

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae import Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.constraints.constraint import Application, Constraint, Touch
from drake_dae.robots.constraints.friction import Friction, friction_parameters
from drake_dae.robots.links.kinematics import Frames, Kinematics, Reaction
from drake_dae.robots.surfaces.picture import PosedShape
from drake_dae.robots.surfaces.surface import Surface, Vector, rotation_of, with_parameters
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
    "<name>.viscous_friction" are mu, v_s and d; plant and law may have different values if both
    have these parameters; use 0 for a surface that has them but no friction. If friction reverses
    the effect of lambda on phi'', the Painleve paradox occurs: see `dae.system.contacts`.

    With flexible joints, motors or hydraulics the law differentiates s, whose slopes are 1 / v_s.
    With error control the prediction holds for all of them down to v_s = 0.001 m/s. At reversals of
    the sliding direction the control then rises by a factor of 3 to 18 with flexible joints and
    hydraulics; v_s = 0.01 m/s avoids this (0.03 m/s with hydraulics). With flexible joints and
    fixed steps of 5 ms use 0.03 m/s: errors are 0.01 to 0.4 N at 0.01 m/s, and at 0.003 m/s the
    steps fail. With rigid joints v_s does not affect the law.

    Attributes:
        frame: Name of the frame.
        surface: A surface in the world.
        point: The point in the frame, m, shape (3,).
        name: The name of the constraint, the prefix of its force and its parameters.
        rpy: Roll, pitch and yaw of the surface, rad, shape (3,): about the fixed axes x, y, z in
            this order, as in Drake. None for no rotation and no such parameter.
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
    parameters: tuple[Parameter, ...] = field(init=False, repr=False, compare=False)
    is_unilateral: ClassVar[tuple[bool, ...]] = (True,)

    def __post_init__(self) -> None:
        position = Parameter(f"{self.name}.position", np.array(self.surface.position), "m")
        turns = []
        if self.rpy is not None:
            turns.append(Parameter(f"{self.name}.rpy", np.array(self.rpy), "rad"))
        frictional = friction_parameters(
            self.name,
            self.friction,
            self.stiction_tolerance,
            self.viscous_friction,
        )
        surface, shape = with_parameters(self.name, self.surface)
        object.__setattr__(self, "surface", surface)
        object.__setattr__(self, "parameters", (position, *turns, *frictional, *shape))

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        return (Signal(f"{self.name}.force", "N"),)

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        return (Signal(f"{self.name}.distance", "m"),)

    @property
    def coordinate_signals(self) -> tuple[Signal, ...]:
        coordinates = self.surface.coordinate_signals
        return tuple(Signal(f"{self.name}.{signal.name}", signal.unit) for signal in coordinates)

    def offset(self, frames: Frames) -> ca.SX:
        """The point relative to the surface, in its axes, m, shape (3, 1)."""
        return self.offset_of(frames.position(self.frame, self.point))

    def offset_of(self, point: ca.SX) -> ca.SX:
        """The same of any point in the world, shape (3, 1)."""
        offset = point - self.parameters[0].symbol
        return offset if self.rpy is None else ca.mtimes(self.rotation.T, offset)

    @property
    def rotation(self) -> ca.SX:
        """The orientation of the surface in the world, shape (3, 3)."""
        return ca.SX.eye(3) if self.rpy is None else rotation_of(self.parameters[1].symbol)

    def _normal(self, frames: Frames) -> ca.SX:
        """The gradient of phi in the world, shape (3, 1)."""
        normal = self.surface.unit_normal(self.offset(frames))
        return normal if self.rpy is None else ca.mtimes(self.rotation, normal)

    def _friction(self, kinematics: Kinematics) -> Friction | None:
        """The friction on the point; None without friction."""
        if (sliding := self.sliding(kinematics)) is None:
            return None
        return Friction.of(self.name, self.parameters, sliding)

    def sliding(self, kinematics: Kinematics) -> ca.SX | None:
        if self.is_ideal:
            return None
        moved = self.surface_velocity(kinematics.position(self.frame, self.point))
        velocity = kinematics.velocity(self.frame, self.point) - moved
        normal = self._normal(kinematics)
        return velocity - normal * ca.dot(normal, velocity)

    def surface_velocity(self, point: ca.SX) -> ca.SX:
        """The velocity of the surface at a point in the world, m/s, shape (3, 1)."""
        moved = self.parameters[0].rate
        if self.rpy is None:
            return moved
        turn, offset = self.parameters[1], ca.SX.sym("offset", 3)
        turning = ca.jtimes(ca.mtimes(self.rotation, offset), turn.symbol, turn.rate)
        return moved + ca.substitute(turning, offset, self.offset_of(point))

    @property
    def is_ideal(self) -> bool:
        return self.friction is None and self.viscous_friction is None

    @property
    def friction_parameter(self) -> str | None:
        return None if self.friction is None else f"{self.name}.friction"

    def residual(self, frames: Frames) -> ca.SX:
        return self.surface.distance(self.offset(frames))

    def reaction(self, kinematics: Kinematics, constraint_force: ca.SX) -> Reaction:
        pushed = super().reaction(kinematics, constraint_force)
        frictional = self._friction(kinematics)
        if frictional is None or self.friction is None:
            return pushed
        return pushed + kinematics.push(self.frame, frictional.pull * constraint_force, self.point)

    def drag(self, kinematics: Kinematics) -> Reaction | None:
        frictional = self._friction(kinematics)
        if frictional is None or frictional.drag is None:
            return None
        return kinematics.push(self.frame, frictional.drag, self.point)

    def coordinates(self, frames: Frames) -> ca.SX:
        return self.surface.coordinates(self.offset(frames))

    def touch(self, frames: Frames) -> Touch:
        return Touch(
            self.frame,
            self.point,
            self._normal(frames),
            lambda point: self.surface.distance(self.offset_of(point)),
            self.surface_velocity,
            self.surface.has_exact_distance,
        )

    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        push, drag, frictional = self._normal(kinematics), None, self._friction(kinematics)
        if frictional is not None:
            push, drag = push + frictional.pull, frictional.drag
        point = kinematics.position(self.frame, self.point)
        return (Application(point, push, ca.SX(3, 1), self.frame, drag=drag),)

    @property
    def remark(self) -> str:
        return f"{self.name}: {self.surface.remark}" if self.surface.remark else ""

    @property
    def extent(self) -> FloatArray | None:
        return self.surface.extent

    def placement(self, values: FloatArray) -> RigidTransform:
        turn = np.zeros(3) if self.rpy is None else values[3:6]
        return RigidTransform(RollPitchYaw(turn), values[:3])

    def picture(self, values: FloatArray, point: FloatArray, size: float) -> PosedShape | None:
        stands = self.placement(values)
        picture = self._shaped(values).picture(stands.inverse() @ point, size)
        return None if picture is None else picture.moved(stands)

    def _shaped(self, values: FloatArray) -> Surface:
        """The surface with the values of its shape numbers."""
        return self.surface.shaped(ca.SX(values[len(values) - len(self.surface.shape) :]))

    def solids(self, values: FloatArray) -> tuple[PosedShape, ...]:
        pose = self.placement(values)
        return tuple(solid.moved(pose) for solid in self.surface.solids())

    def layer(self, values: FloatArray, point: FloatArray, size: float, depth: float) -> PosedShape:
        pose = self.placement(values)
        return self._shaped(values).layer(pose.inverse() @ point, size, depth).moved(pose)


@checked(ModelError)
@dataclass(frozen=True)
class FixedDistance(Constraint):
    """A rod without mass, with a ball joint at each end, between points of frames A and B:

        phi(q) = |p_WB(q) - p_WA(q)| - length.

    The constraint force is the force in the rod in N: positive pushes the points apart, so that A
    exerts it on B away from A, and B the opposite on A; negative is tension. The parameter
    "<name>.length" is its length.

    The length must not be zero, since phi then has no gradient: use `CoincidentPoints`. For a point
    on a sphere in the world use `PointOnSurface`. A rope, which can only pull, is not covered.

    Attributes:
        frame_a: Name of frame A, for example "world".
        point_a: The point in frame A, m, shape (3,).
        frame_b: Name of frame B, on another body.
        point_b: The point in frame B, m, shape (3,).
        length: The distance of the points, m, positive.
        name: The name of the constraint, the prefix of its force and its parameter.
    """

    frame_a: str
    point_a: Vector
    frame_b: str
    point_b: Vector
    length: float
    name: str = "rod"
    parameters: tuple[Parameter, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        length = Parameter(f"{self.name}.length", np.array([self.length]), "m", positive=True)
        object.__setattr__(self, "parameters", (length,))

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        return (Signal(f"{self.name}.thrust", "N"),)

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        return (Signal(f"{self.name}.stretch", "m"),)

    def residual(self, frames: Frames) -> ca.SX:
        return length_of(self._apart(frames)) - self.parameters[0].symbol

    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        apart = self._apart(kinematics)
        point = kinematics.position(self.frame_b, self.point_b)
        away = apart / length_of(apart)
        return (Application(point, away, ca.SX(3, 1), self.frame_b, self.frame_a),)

    def _apart(self, frames: Frames) -> ca.SX:
        start = frames.position(self.frame_a, self.point_a)
        return frames.position(self.frame_b, self.point_b) - start
