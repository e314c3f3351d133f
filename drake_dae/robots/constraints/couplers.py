"""Joints that move together: gears, racks, mimic joints."""

from dataclasses import dataclass, field
from typing import Literal

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import brief
from drake_dae.dae import Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.constraints.constraint import Application, Constraint
from drake_dae.robots.links.kinematics import Frames, Kinematics, position_index


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
    parameters: tuple[Parameter, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.follower == self.leader:
            raise ModelError(f"'{self.follower}' cannot follow itself; name another leader")
        if self.ratio == 0.0:
            raise ModelError("ratio must not be zero; weld the joint if it shall not move")
        if not isinstance(self.unit, str) or self.unit not in ("rad", "m"):
            raise ModelError(f"unit must be 'rad' or 'm', got {brief(self.unit)}")
        ratio = Parameter(f"{self.name}.ratio", np.array([self.ratio]))
        offset = Parameter(f"{self.name}.offset", np.array([self.offset]), self.unit)
        object.__setattr__(self, "parameters", (ratio, offset))

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
            axes = share * axis.force, share * axis.moment
            applications.append(Application(axis.point, *axes, axis.child, axis.parent))
        return tuple(applications)
