"""Rods, pins, welds and couplers; and the constraints of a plant itself."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Literal

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.inverse_kinematics import AddMultibodyPlantConstraints
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PrismaticJoint
from pydrake.solvers import MathematicalProgram

from drake_dae.arguments import checked
from drake_dae.arrays import check_axes
from drake_dae.dae import Parameter, Signal, signals
from drake_dae.errors import ModelError
from drake_dae.robots.constraint import Constraint
from drake_dae.robots.links import Application, Frames, Kinematics, Links, position_index
from drake_dae.robots.plant_frames import constant_pose, joint_names
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

    A length of zero has no gradient: use `CoincidentPoints`. A rope is not covered.

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
        return length_of(_apart(self, frames)) - self.parameters[0].symbol

    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        apart = _apart(self, kinematics)
        point = kinematics.position(self.frame_b, self.point_b)
        away = apart / length_of(apart)
        return (Application(point, away, ca.SX(3, 1), self.frame_b, self.frame_a),)


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
        return _apart(self, frames)[self._rows]

    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        point = kinematics.position(self.frame_b, self.point_b)
        axes = ca.SX.eye(3)[:, self._rows], ca.SX(3, len(self.axes))
        return (Application(point, *axes, self.frame_b, self.frame_a),)

    @property
    def _rows(self) -> list[int]:
        return ["xyz".index(axis) for axis in self.axes]


def _apart(ends: FixedDistance | CoincidentPoints, frames: Frames) -> ca.SX:
    """p_WB - p_WA in m, shape (3, 1)."""
    start = frames.position(ends.frame_a, ends.point_a)
    return frames.position(ends.frame_b, ends.point_b) - start


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class WeldedFrames(Constraint):
    """Frame B has a fixed pose (R, p) in frame A, as with Drake's AddWeldConstraint:

        phi(q) = (p_AB(q) - p, 2 tan(theta / 2) n),    R_AB(q) R^T = turn by theta about n,

    all in the axes of A. The constraint force is what A exerts on B, a force in N at B's origin and
    a moment in N m, in the axes of A; B exerts the opposite on A at the same point. For with E =
    R_AB R^T and the angular velocity w of B in A the orientation error

        r = 2 tan(theta / 2) n = 2 vee(E - E^T) / (1 + tr E)

    has r' = w + w x r / 2 + (w . r) r / 4, which is w at r = 0. It is smooth up to half a turn,
    where it is infinite, and its only zero is the pose itself. The parameter "<name>.position" is
    p.

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


@checked(ModelError)
@dataclass(frozen=True)
class JointCoupler(Constraint):
    """A joint follows another one, by gears without backlash, or as a mimic joint of a URDF:

        phi(q) = q_follower - ratio q_leader - offset.

    So do Drake's AddCouplerConstraint and <mimic multiplier="ratio" offset="offset">. Two gears of
    n_1 and n_2 teeth that mesh have the ratio -n_1 / n_2 from the first to the second; a rack on a
    pinion of radius r has r, in m/rad, with the unit "m" of the follower.

    The constraint force is the generalized force on the follower, in N m (N with the unit "m"), and
    the leader gets -ratio times it. It acts on the child of each joint along the joint's axis, and
    the opposite on the parent. The parameters "<name>.ratio" and "<name>.offset" are its numbers.

    Attributes:
        follower: Name of the position that follows, as in the links' `position_signals`.
        leader: Name of the position that it follows.
        ratio: The motion of the follower per unit of the leader; not zero.
        offset: The follower's position for a leader at zero, in rad or m.
        unit: The unit of the follower's position, "rad" or "m".
        name: The name of the constraint, the prefix of its force and its parameters.
    """

    follower: str
    leader: str
    ratio: float = 1.0
    offset: float = 0.0
    unit: Literal["rad", "m"] = "rad"
    name: str = "coupler"

    def __post_init__(self) -> None:
        if self.follower == self.leader:
            raise ModelError(f"'{self.follower}' cannot follow itself; name another leader")
        if self.ratio == 0.0:
            raise ModelError("ratio must not be zero; weld the joint if it shall not move")
        super().__post_init__()

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter(f"{self.name}.ratio", np.array([self.ratio])),
            Parameter(f"{self.name}.offset", np.array([self.offset]), self.unit),
        )

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        if self.unit == "m":
            return (Signal(f"{self.name}.force", "N"),)
        return (Signal(f"{self.name}.moment", "N m"),)

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        return (Signal(f"{self.name}.slip", self.unit),)

    def residual(self, frames: Frames) -> ca.SX:
        ratio, offset = (parameter.symbol for parameter in self.parameters)
        follower, leader = (position_index(frames, name) for name in (self.follower, self.leader))
        unit = frames.position_signals[follower].unit
        if unit not in ("", self.unit):
            raise ModelError(
                f"'{self.name}': the position of '{self.follower}' is in {unit}; give that as unit"
            )
        return frames.q[follower] - ratio * frames.q[leader] - offset

    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        both = (self.follower, 1.0), (self.leader, -self.parameters[0].symbol)
        applications = []
        for name, share in both:
            axis = kinematics.joint_axis(name)
            if axis is None:
                return ()
            axes = share * axis.force_axes, share * axis.moment_axes
            applications.append(Application(axis.point, *axes, axis.frame_b, axis.frame_a))
        return tuple(applications)


def plant_constraints(links: Links) -> tuple[Constraint, ...]:
    """The constraints of the plant of the links, which Drake enforces only in discrete plants.

    Couplers and mimic joints are a `JointCoupler` "<follower>_coupler"; others raise ModelError.
    """
    plant = links.plant
    if plant is None or plant.num_constraints() == 0:
        return ()
    constraints = couplings_of(plant)
    others = plant.num_constraints() - len(constraints)
    if others:
        raise ModelError(
            f"the plant has {others} constraint(s) that cannot be read back from it; take them out "
            "of the plant or of its file, and give them as `constraints`: a ball constraint is "
            "CoincidentPoints, a weld constraint WeldedFrames, a distance constraint FixedDistance"
        )
    return tuple(constraints)


def couplings_of(plant: MultibodyPlant) -> list[JointCoupler]:
    """The couplers of a finalized plant, read from a mathematical program of Drake."""
    program = MathematicalProgram()
    q = program.NewContinuousVariables(plant.num_positions(), "q")
    try:
        AddMultibodyPlantConstraints(plant, q, program, plant.CreateDefaultContext())
    except RuntimeError as error:
        raise ModelError(
            f"the plant has a constraint that is not supported ({error}); leave it out of the plant"
        ) from None
    couplers: list[JointCoupler] = []
    followers: set[str] = set()
    joints = joint_names(plant)
    names = {joint.position_start(): name for name, joint in joints.items()}
    for binding in program.linear_equality_constraints():
        if binding.variables().size != 2:
            continue
        row = binding.evaluator()
        pair = [names[i] for i in program.FindDecisionVariableIndices(binding.variables())]
        factors = [float(factor) for factor in np.reshape(row.GetDenseA(), 2)]
        # The follower has the factor 1. If both have it, either may be; no joint follows twice.
        able = [i for i in (1, 0) if factors[i] == 1.0] or [0]
        place = next((i for i in able if pair[i] not in followers), able[0])
        follower, leader = pair[place], pair[1 - place]
        followers.add(follower)
        ratio = -factors[1 - place] / factors[place]
        offset = float(row.lower_bound()[0]) / factors[place]
        unit: Literal["m", "rad"] = "m" if isinstance(joints[follower], PrismaticJoint) else "rad"
        couplers.append(JointCoupler(follower, leader, ratio, offset, unit, f"{follower}_coupler"))
    return couplers
