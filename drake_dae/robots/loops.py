"""What closes a loop: rods, pins, welds, and joints at which it is cut."""

from abc import abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from math import inf, pi
from typing import ClassVar, Literal

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from drake_dae.arguments import checked
from drake_dae.arrays import brief, check_axes
from drake_dae.dae import Parameter, Signal, signals
from drake_dae.errors import ModelError
from drake_dae.robots.constraint import Constraint, Joint
from drake_dae.robots.links import Application, Frames, Kinematics
from drake_dae.robots.plant_frames import constant_pose, without_round_off
from drake_dae.robots.surface import Vector
from drake_dae.trace.expressions import length_of


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
    force_units: ClassVar = {"thrust": "N"}
    residual_units: ClassVar = {"stretch": "m"}

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter(f"{self.name}.length", np.array([self.length]), "m", positive=True),)

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


@checked(ModelError)
@dataclass(frozen=True)
class CoincidentPoints(Constraint):
    """A point of frame B coincides with a point of frame A: phi(q) = p_WB(q) - p_WA(q).

    A ball joint that closes a loop; in a planar mechanism, with the axes of the plane, a pin. The
    constraint force is the force in N, in world axes, that A exerts on B at the point; B exerts the
    opposite on A.

    Attributes:
        frame_a: Name of frame A, for example "world".
        point_a: The point in frame A, m, shape (3,).
        frame_b: Name of frame B, on another body.
        point_b: The point in frame B, m, shape (3,).
        axes: The axes of the world along which they coincide, for example "xz".
        name: The name of the constraint, the prefix of its forces.
    """

    frame_a: str
    point_a: Vector
    frame_b: str
    point_b: Vector
    axes: str = "xyz"
    name: str = "pin"

    def __post_init__(self) -> None:
        check_axes("axes", self.axes)

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        return signals([f"{self.name}.f{axis}" for axis in self.axes], "N")

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        return signals([f"{self.name}.{axis}" for axis in self.axes], "m")

    def residual(self, frames: Frames) -> ca.SX:
        point_b = frames.position(self.frame_b, self.point_b)
        apart = point_b - frames.position(self.frame_a, self.point_a)
        return apart[self._rows]

    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        point = kinematics.position(self.frame_b, self.point_b)
        axes = ca.SX.eye(3)[:, self._rows], ca.SX(3, len(self.axes))
        return (Application(point, *axes, self.frame_b, self.frame_a),)

    @property
    def _rows(self) -> list[int]:
        return ["xyz".index(axis) for axis in self.axes]


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class WeldedFrames(Constraint):
    """Frame B has a fixed pose (R, p) in frame A, as with Drake's AddWeldConstraint:

        phi(q) = (p_AB(q) - p, 2 tan(theta / 2) n),    R_AB(q) R^T = turn by theta about n,

    all in the axes of A. The constraint force is what A exerts on B, a force in N at B's origin and
    a moment in N m, in the axes of A; B exerts the opposite on A at the same point. For at phi = 0
    phi' = (v, w), the velocity and angular velocity of B in A, so that lambda^T phi' is the power
    of such a force and moment: p_AB' = v, and with E = R_AB R^T, E' = w x E, the orientation error

        r = 2 tan(theta / 2) n = 2 vee(E - E^T) / (1 + tr E)

    has r' = w + w x r / 2 + (w . r) r / 4, which is w at r = 0. It is smooth up to half a turn,
    where it is infinite. Unlike the sine of theta its only zero is the pose itself. The parameter
    "<name>.position" is p.

    Attributes:
        frame_a: Name of frame A; it may be "world".
        frame_b: Name of frame B, on another body.
        pose: X_AB, the pose of B in A; by default the frames coincide.
        name: The name of the constraint, before those of its forces and its parameter.
    """

    frame_a: str
    frame_b: str
    pose: RigidTransform = field(default_factory=RigidTransform)
    name: str = "weld"
    force_units: ClassVar = dict(fx="N", fy="N", fz="N", mx="N m", my="N m", mz="N m")
    residual_units: ClassVar = dict(x="m", y="m", z="m", rx="rad", ry="rad", rz="rad")

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", RigidTransform(self.pose))
        super().__post_init__()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter(f"{self.name}.position", self.pose.translation(), "m"),)

    def residual(self, frames: Frames) -> ca.SX:
        R_AW = frames.rotation(self.frame_a).T
        offset = frames.position(self.frame_b) - frames.position(self.frame_a)
        rotation = ca.SX(ca.sparsify(ca.DM(constant_pose(self.pose)[0])))
        E = ca.mtimes(R_AW, ca.mtimes(frames.rotation(self.frame_b), rotation.T))
        shift = ca.mtimes(R_AW, offset) - self.parameters[0].symbol
        return ca.vertcat(shift, rotation_error(E))

    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        R_WA, none = kinematics.rotation(self.frame_a), ca.SX(3, 3)
        point = kinematics.position(self.frame_b)
        axes = ca.horzcat(R_WA, none), ca.horzcat(none, R_WA)
        return (Application(point, *axes, self.frame_b, self.frame_a),)


def rotation_error(E: ca.SX) -> ca.SX:
    """2 tan(theta / 2) n of the rotation by theta about n, shape (3, 1)."""
    skew = ca.vertcat(E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1])
    return 2 * skew / (1 + ca.trace(E))


Letter = Literal["x", "y", "z"]
LETTERS = "xyz"


@dataclass(frozen=True)
class LoopJoint(Constraint):
    """A joint between frames A and B at which a loop is cut, with damping, limits and motor.

    It connects a frame F, fixed in A, with a frame M, fixed in B. They coincide at the coordinate c
    = 0, as in a joint of the tree from the parent A to the child B. Besides the constraint forces,
    which do no work, A exerts along the coordinate on B

        -damping c' - stiffness (c - rest) + u,

    and B the opposite on A, where u is the motor's force, if it has a motor: a control of the
    robot, after those of its other actuators. These forces are not on the port
    `constraint_wrenches`. c and c' are on the port `loop_state` of `RobotPlant`, and c can be an
    output, by `SurfaceCoordinates`. Limits are not enforced: reports and summaries say where c
    exceeds them. Its motor is rigid, without rotor inertia; else cut the loop at another joint.

    Attributes:
        frame_a: Name of frame A, of the parent; it may be "world".
        frame_b: Name of frame B, of the child, on another body.
        axis: The joint's axis, an axis of F and M.
        point_a: The origin of F in A, m, shape (3,).
        rpy_a: Roll, pitch and yaw of F in A, rad, shape (3,).
        point_b: The origin of M in B, m, shape (3,).
        rpy_b: Roll, pitch and yaw of M in B, rad, shape (3,).
        damping: The damping of the joint in N m s/rad (N s/m), not negative; the parameter
            "<name>.damping" if not zero.
        stiffness: The stiffness of its spring in N m/rad (N/m), not negative; the parameter
            "<name>.stiffness".
        rest: The rest position of the spring, rad (m).
        lower, upper: The limits of c, rad (m); none if None.
        velocity_limit: The largest |c'|, rad/s (m/s); none if None.
        motor: Whether it has a motor, the control "<name>.motor".
        effort_limit: The largest |u|, N m (N); none if None.
        name: The name of the constraint, the prefix of its forces and parameters.
    """

    frame_a: str
    frame_b: str
    axis: Letter = "z"
    point_a: Vector = (0.0, 0.0, 0.0)
    rpy_a: Vector = (0.0, 0.0, 0.0)
    point_b: Vector = (0.0, 0.0, 0.0)
    rpy_b: Vector = (0.0, 0.0, 0.0)
    damping: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    lower: float | None = None
    upper: float | None = None
    velocity_limit: float | None = None
    motor: bool = False
    effort_limit: float | None = None
    name: str = "loop"
    units: ClassVar[tuple[str, str]]  # Of c and of its force.
    coordinate: ClassVar[str]  # The name of c.

    def __post_init__(self) -> None:
        for key in ("damping", "stiffness"):
            if getattr(self, key) < 0.0:
                raise ModelError(f"{key} must not be negative, got {getattr(self, key):g}")
        for key in ("velocity_limit", "effort_limit"):
            value = getattr(self, key)
            if value is not None and not value > 0.0:
                raise ModelError(f"{key} must be positive, got {value:g}; leave it out if unknown")
        if self.effort_limit is not None and not self.motor:
            raise ModelError("effort_limit is that of a motor; say motor=True")
        low, high = self._limits
        if not low < high:
            raise ModelError(f"lower must be below upper, got {low:g} and {high:g}")
        super().__post_init__()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        unit, force = self.units
        made = {"damping": f"{force} s/{unit}", "stiffness": f"{force}/{unit}"}
        return tuple(
            Parameter(f"{self.name}.{key}", np.array([getattr(self, key)]), per)
            for key, per in made.items()
            if getattr(self, key)
        )

    @property
    @abstractmethod
    def held_axes(self) -> tuple[str, str]:
        """The axes of F along which M cannot move, and about which it cannot turn, as letters."""

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        held, turned = self.held_axes
        forces = signals([f"{self.name}.f{axis}" for axis in held], "N")
        return (*forces, *signals([f"{self.name}.m{axis}" for axis in turned], "N m"))

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        held, turned = self.held_axes
        shifts = signals([f"{self.name}.{axis}" for axis in held], "m")
        return (*shifts, *signals([f"{self.name}.r{axis}" for axis in turned], "rad"))

    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        R_WF, _ = self._base(kinematics)
        held, turned = self._held
        pushing = ca.horzcat(R_WF[:, held], ca.SX(3, len(turned)))
        turning = ca.horzcat(ca.SX(3, len(held)), R_WF[:, turned])
        point = kinematics.position(self.frame_b, self.point_b)
        return (Application(point, pushing, turning, self.frame_b, self.frame_a),)

    @property
    def coordinate_signals(self) -> tuple[Signal, ...]:
        return (Signal(f"{self.name}.{self.coordinate}", self.units[0]),)

    @property
    def joint(self) -> Joint:
        damping, stiffness = self.symbol("damping"), self.symbol("stiffness")
        return Joint(
            lambda c, rate: -damping * rate - stiffness * (c - self.rest),
            *self._limits,
            inf if self.velocity_limit is None else self.velocity_limit,
            Signal(f"{self.name}.motor", self.units[1]) if self.motor else None,
            inf if self.effort_limit is None else self.effort_limit,
        )

    @property
    def _limits(self) -> tuple[float, float]:
        low, high = self.lower, self.upper
        return -inf if low is None else low, inf if high is None else high

    @property
    def _held(self) -> tuple[list[int], list[int]]:
        """The numbers of `held_axes`."""
        held, turned = ([LETTERS.index(axis) for axis in axes] for axes in self.held_axes)
        return held, turned

    @property
    def _own(self) -> int:
        """The number of the joint's axis."""
        return LETTERS.index(self.axis)

    def _base(self, frames: Frames) -> tuple[ca.SX, ca.SX]:
        """R_WF and p_WF."""
        rotation = ca.mtimes(frames.rotation(self.frame_a), _rotation(self.rpy_a))
        return rotation, frames.position(self.frame_a, self.point_a)

    def _relative(self, frames: Frames) -> tuple[ca.SX, ca.SX]:
        """R_FM and p_FM, in F."""
        R_WF, origin = self._base(frames)
        R_WM = ca.mtimes(frames.rotation(self.frame_b), _rotation(self.rpy_b))
        apart = frames.position(self.frame_b, self.point_b) - origin
        return ca.mtimes(R_WF.T, R_WM), ca.mtimes(R_WF.T, apart)


@checked(ModelError)
@dataclass(frozen=True)
class RevoluteLoopJoint(LoopJoint):
    """A revolute joint that closes a loop.

    See `LoopJoint` for its frames and its properties along the angle. The origins of F and M
    coincide, and so do their axes a:

        phi(q) = (p_FM, 2 / (1 + a . a_M) (b . (a x a_M), c . (a x a_M))),

    in F, with its axes b and c across a; where a_M = -a it is infinite. The constraint forces are
    what A exerts on B: a force in N at M, in the axes of F, and the moments in N m about b and c;
    where phi = 0, phi' is the velocity and the angular velocity of M in F.

    In a planar mechanism the three rows out of the plane are redundant: `planar` keeps only the two
    in the plane.

    The angle is measured within half a turn from the middle of the limits (from zero without both
    limits), and jumps beyond. A joint with full turns may have a damper and a motor, but no limits
    and no spring.

    Attributes:
        planar: Whether only the two positions normal to the axis are constrained.
    """

    planar: bool = False
    units = "rad", "N m"
    coordinate = "angle"

    def __post_init__(self) -> None:
        super().__post_init__()
        ends = [end for end in (*self._limits, self.rest) if np.isfinite(end)]
        if any(abs(end - self._middle) >= pi for end in ends):
            raise ModelError(
                f"lower, upper and rest must be within half a turn of {self._middle:g} rad, got "
                f"{brief(ends)}. Leave out both limits for a continuous joint"
            )

    @property
    def _middle(self) -> float:
        """The middle of the range of the angle."""
        low, high = self._limits
        return (low + high) / 2 if np.isfinite(low) and np.isfinite(high) else 0.0

    @property
    def held_axes(self) -> tuple[str, str]:
        across = LETTERS.replace(self.axis, "")
        return (across, "") if self.planar else (LETTERS, across)

    def residual(self, frames: Frames) -> ca.SX:
        R_FM, p_FM = self._relative(frames)
        held, turned = self._held
        axis = R_FM[:, self._own]
        tilt = 2 / (1 + axis[self._own]) * ca.cross(ca.SX(np.eye(3)[self._own]), axis)
        return ca.vertcat(p_FM[held], tilt[turned])

    def coordinates(self, frames: Frames) -> ca.SX:
        R_FM, _ = self._relative(frames)
        b, c = (self._own + 1) % 3, (self._own + 2) % 3  # b x c = a.
        sine, cosine = R_FM[c, b] - R_FM[b, c], R_FM[b, b] + R_FM[c, c]
        s, k = np.sin(self._middle), np.cos(self._middle)
        return self._middle + ca.atan2(sine * k - cosine * s, cosine * k + sine * s)


@checked(ModelError)
@dataclass(frozen=True)
class PrismaticLoopJoint(LoopJoint):
    """A prismatic joint that closes a loop.

    See `LoopJoint` for its frames and its properties along the travel. M does not turn in F, and
    its origin stays on the axis a of F:

        phi(q) = (b . p_FM, c . p_FM, 2 tan(theta / 2) n),    R_FM = turn by theta about n,

    in F, with its axes b and c across a. The constraint forces are what A exerts on B: a force in
    N at M along b and c, and a moment in N m, in the axes of F; where phi = 0, phi' is the velocity
    of M across the axis and its angular velocity in F. The travel is a . p_FM.

    In a planar mechanism only two rows are independent: with the `normal` of the plane, the
    position normal to axis and normal, and the rotation about the normal.

    Attributes:
        normal: The axis of F that is the normal of the plane; None in space.
    """

    normal: Letter | None = None
    units = "m", "N"
    coordinate = "travel"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.normal == self.axis:
            raise ModelError(f"normal must be another axis than '{self.axis}', the joint's own")

    @property
    def held_axes(self) -> tuple[str, str]:
        across = LETTERS.replace(self.axis, "")
        if self.normal is None:
            return across, LETTERS
        return across.replace(self.normal, ""), self.normal

    def residual(self, frames: Frames) -> ca.SX:
        R_FM, p_FM = self._relative(frames)
        held, turned = self._held
        return ca.vertcat(p_FM[held], rotation_error(R_FM)[turned])

    def coordinates(self, frames: Frames) -> ca.SX:
        return self._relative(frames)[1][self._own]


def _rotation(rpy: Vector) -> ca.SX:
    """The rotation by roll, pitch and yaw; entries that are only round-off are structural zeros."""
    rotation = RollPitchYaw(rpy).ToRotationMatrix().matrix()
    return ca.SX(ca.sparsify(ca.DM(without_round_off(rotation))))
