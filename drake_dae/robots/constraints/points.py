"""Points at a fixed distance, points that coincide, and frames with a fixed relative pose."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform

from drake_dae.arguments import checked
from drake_dae.arrays import check_axes
from drake_dae.dae import Parameter, Signal, signals
from drake_dae.errors import ModelError
from drake_dae.robots.constraints.constraint import Constraint
from drake_dae.robots.links.links import Application, Frames, Kinematics
from drake_dae.robots.links.plant_frames import constant_pose
from drake_dae.robots.surfaces.surface import Vector
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
