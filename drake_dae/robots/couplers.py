"""Joints that move together: gears, racks, mimic joints; and the constraints of a plant itself."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import casadi as ca
import numpy as np
from pydrake.multibody.inverse_kinematics import AddMultibodyPlantConstraints
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PrismaticJoint
from pydrake.solvers import LinearEqualityConstraint, MathematicalProgram

from drake_dae.arguments import checked
from drake_dae.dae import Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.constraint import Constraint
from drake_dae.robots.links import Application, Frames, Kinematics, Links, position_index
from drake_dae.robots.loops import FixedDistance
from drake_dae.robots.plant_frames import frame_name, joint_names
from drake_dae.robots.surface import triple


@checked(ModelError)
@dataclass(frozen=True)
class JointCoupler(Constraint):
    """A joint follows another one, by gears without backlash, or as a mimic joint of a URDF:

        phi(q) = q_follower - ratio q_leader - offset.

    So do Drake's AddCouplerConstraint and <mimic multiplier="ratio" offset="offset">. Two gears of
    n_1 and n_2 teeth that mesh have the ratio -n_1 / n_2 from the first to the second; a rack on a
    pinion of radius r has r, in m/rad, with the unit "m" of the follower.

    The constraint force is the generalized force on the follower, in N m (N with the unit "m"):
    positive pushes the follower toward larger positions, and the leader gets -ratio times it. It
    acts on the child of each joint along the joint's axis, and the opposite on the parent, so the
    housing of a gear carries the difference. The parameters "<name>.ratio" and "<name>.offset" are
    its numbers.

    Backlash, elastic belts and one-way drives are not covered. Weld a joint that must not move.

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
    """The constraints of the plant of the links; none without a plant.

    Couplers, which mimic joints are, become a `JointCoupler` "<follower>_coupler", and rods of
    AddDistanceConstraint a `FixedDistance` "rod0", "rod1", ... Drake enforces them only in discrete
    plants; here they hold in continuous time as well.

    Raises:
        ModelError: The plant has other constraints, or a rod with a stiffness.
    """
    plant = links.plant
    if plant is None or plant.num_constraints() == 0:
        return ()
    constraints = (*couplings_of(plant), *_rods(plant))
    others = plant.num_constraints() - len(constraints)
    if others:
        raise ModelError(
            f"the plant has {others} constraint(s) that cannot be read back from it; take them out "
            "of the plant or of its file, and give them as `constraints`: a ball constraint is "
            "CoincidentPoints, a weld constraint WeldedFrames"
        )
    return constraints


def couplings_of(plant: MultibodyPlant) -> list[JointCoupler]:
    """The couplers of a finalized plant, read from a mathematical program of Drake.

    Raises:
        ModelError: The plant has a constraint that Drake does not describe.
    """
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
    index = {variable.get_id(): i for i, variable in enumerate(q)}
    for binding in program.GetAllConstraints():
        row = binding.evaluator()
        if not isinstance(row, LinearEqualityConstraint) or binding.variables().size != 2:
            continue
        pair = [names[index[variable.get_id()]] for variable in binding.variables()]
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


def _rods(plant: MultibodyPlant) -> list[FixedDistance]:
    found = []
    rods = plant.GetDefaultDistanceConstraintParams()
    for number, key in enumerate(sorted(rods, key=lambda key: key.get_value())):
        rod = rods[key]
        bodies = [plant.get_body(index) for index in (rod.bodyA(), rod.bodyB())]
        start, end = (frame_name(plant, body.body_frame()) for body in bodies)
        if np.isfinite(rod.stiffness()):
            raise ModelError(
                f"the distance constraint between '{start}' and '{end}' has a stiffness of "
                f"{rod.stiffness():g} N/m: that is a spring and no rod; add a LinearSpringDamper"
            )
        point_a, point_b = (triple("a point", point) for point in (rod.p_AP(), rod.p_BQ()))
        found.append(FixedDistance(start, point_a, end, point_b, rod.distance(), f"rod{number}"))
    return found
