"""Joints at which a loop is cut, as constraints."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf, pi
from typing import ClassVar

import casadi as ca
import numpy as np
from pydrake.math import RollPitchYaw

from drake_dae.arguments import checked
from drake_dae.arrays import brief, positive
from drake_dae.dae import Parameter, Signal, signals
from drake_dae.errors import ModelError
from drake_dae.robots.constraint import Constraint, ConstraintSet
from drake_dae.robots.couplings import rotation_error
from drake_dae.robots.links import Application, Frames, Kinematics, Links
from drake_dae.robots.plant_frames import without_round_off
from drake_dae.robots.surface import LETTERS, Letter, Vector


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
    output, by `SurfaceCoordinates`. Limits are not enforced: reports say where c exceeds them. Its
    motor is rigid, without rotor inertia; else cut the loop at another joint.

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
        for key in ("velocity_limit", "effort_limit"):
            if (value := getattr(self, key)) is not None:
                positive(key, value)
        if self.effort_limit is not None and not self.motor:
            raise ModelError("effort_limit is that of a motor; say motor=True")
        low, high = self.limits
        if not low < high:
            raise ModelError(f"lower must be below upper, got {low:g} and {high:g}")
        super().__post_init__()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        unit, force = self.units
        made = {"damping": f"{force} s/{unit}", "stiffness": f"{force}/{unit}"}
        return tuple(
            Parameter(f"{self.name}.{key}", np.array([getattr(self, key)]), per, nonnegative=True)
            for key, per in made.items()
            if getattr(self, key)
        )

    @property
    @abstractmethod
    def held_axes(self) -> tuple[Sequence[str], Sequence[str]]:
        """The axes of F along which M cannot move, and about which it cannot turn."""

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
    def motors(self) -> tuple[Signal, ...]:
        return (Signal(f"{self.name}.motor", self.units[1]),) if self.motor else ()

    def force(self, c: ca.SX, rate: ca.SX) -> ca.SX:
        """That of spring and damper, toward larger c."""
        return -self.symbol("damping") * rate - self.symbol("stiffness") * (c - self.rest)

    @property
    def limits(self) -> tuple[float, float]:
        low, high = self.lower, self.upper
        return -inf if low is None else low, inf if high is None else high

    @property
    def _held(self) -> tuple[list[int], list[int]]:
        """The numbers of `held_axes`."""
        held, turned = ([LETTERS.index(axis) for axis in axes] for axes in self.held_axes)
        return held, turned

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
        ends = [end for end in (*self.limits, self.rest) if np.isfinite(end)]
        if any(abs(end - self._middle) >= pi for end in ends):
            raise ModelError(
                f"lower, upper and rest of '{self.name}' must be within half a turn of "
                f"{self._middle:g} rad, got {brief(ends)}. Leave out both limits for a continuous "
                "joint"
            )

    @property
    def _middle(self) -> float:
        """The middle of the range of the angle."""
        low, high = self.limits
        return (low + high) / 2 if np.isfinite(low) and np.isfinite(high) else 0.0

    @property
    def held_axes(self) -> tuple[Sequence[str], Sequence[str]]:
        across = [letter for letter in LETTERS if letter != self.axis]
        return (across, ()) if self.planar else (LETTERS, across)

    def residual(self, frames: Frames) -> ca.SX:
        R_FM, p_FM = self._relative(frames)
        held, turned = self._held
        a = LETTERS.index(self.axis)
        tilt = 2 / (1 + R_FM[a, a]) * ca.cross(ca.SX(np.eye(3)[a]), R_FM[:, a])
        return ca.vertcat(p_FM[held], tilt[turned])

    def coordinates(self, frames: Frames) -> ca.SX:
        R_FM, _ = self._relative(frames)
        a = LETTERS.index(self.axis)
        b, c = (a + 1) % 3, (a + 2) % 3  # b x c = a.
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
    def held_axes(self) -> tuple[Sequence[str], Sequence[str]]:
        across = [letter for letter in LETTERS if letter not in (self.axis, self.normal)]
        return across, LETTERS if self.normal is None else (self.normal,)

    def residual(self, frames: Frames) -> ca.SX:
        R_FM, p_FM = self._relative(frames)
        held, turned = self._held
        return ca.vertcat(p_FM[held], rotation_error(R_FM)[turned])

    def coordinates(self, frames: Frames) -> ca.SX:
        return self._relative(frames)[1][LETTERS.index(self.axis)]


def _rotation(rpy: Vector) -> ca.SX:
    """The rotation by roll, pitch and yaw; entries that are only round-off are structural zeros."""
    rotation = RollPitchYaw(rpy).ToRotationMatrix().matrix()
    return ca.SX(ca.sparsify(ca.DM(without_round_off(rotation))))


class LoopState:
    """The l joints of a robot that close loops: (c, c') as `state`, with `signals` and `limits`.

    `force` is the generalized force of their springs and dampers, shape (nv, 1), `columns` and
    `motors` are those of unit efforts in all joints and in those with motors, shape (nv, k).
    """

    def __init__(self, constraints: ConstraintSet, links: Links) -> None:
        joints = [joint for joint in constraints.constraints if isinstance(joint, LoopJoint)]
        kinematics, unit = links.kinematics(), ca.SX.sym("unit", len(joints))
        own = ca.vertcat(ca.SX(0, 1), *[joint.coordinates(kinematics) for joint in joints])
        own_rate = kinematics.derivative(own)
        position, rate = kinematics.value(own), kinematics.value(own_rate)
        self.state = ca.vertcat(position, rate)
        named = [signal for joint in joints for signal in joint.coordinate_signals]
        self.signals = (*named, *(signal.derivative(1) for signal in named))
        low, high = np.reshape([joint.limits for joint in joints], (-1, 2)).T
        fastest = [joint.velocity_limit or inf for joint in joints]
        self.limits = np.append(low, np.negative(fastest)), np.append(high, fastest)
        driven = [i for i, joint in enumerate(joints) if joint.motor]
        self.effort_limits = np.array([joints[i].effort_limit or inf for i in driven])
        reaction = kinematics.reaction(ca.dot(unit, own_rate))
        columns = reaction.map(lambda part: ca.jacobian(part, unit))
        self.columns = links.generalized_force(kinematics, columns)
        forces = [joint.force(position[i], rate[i]) for i, joint in enumerate(joints)]
        self.force = ca.sparsify(ca.mtimes(self.columns, ca.vertcat(ca.SX(0, 1), *forces)))
        self.motors = self.columns[:, driven]
