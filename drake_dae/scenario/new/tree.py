"""The bodies and joints of a robot, and the motion of a point by a chain of joints."""

from collections.abc import Sequence

import numpy as np
from pydrake.multibody.parsing import GetScopedFrameByName
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    JacobianWrtVariable,
    Joint,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
)
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.robots.constraints.plant_constraints import couplings_of
from drake_dae.robots.links.frames import joint_names, unique_names
from drake_dae.robots.surfaces.surface import Vector
from drake_dae.scenario.robot_file.loops import joints_of


class Tree:
    """The bodies and joints of a plant, from the world outward."""

    def __init__(self, plant: MultibodyPlant) -> None:
        self.plant = plant
        self.joints = joints_of(plant)
        self.above = {joint.child_body().index(): joint for joint in self.joints}
        self.names = {joint.index(): name for name, joint in joint_names(plant).items()}
        self.couplings = couplings_of(plant) if plant.num_constraints() else []
        bodies = [plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies())]
        self.bodies: dict[str, RigidBody] = dict(
            zip(unique_names(plant, bodies), bodies, strict=True)
        )

    def path(self, body: RigidBody) -> list[Joint]:
        """The joints from the world to a body."""
        joints: list[Joint] = []
        while body.index() in self.above:
            joints.append(self.above[body.index()])
            body = joints[-1].parent_body()
        return joints[::-1]

    @property
    def works(self) -> list[Joint]:
        """The joints that can be in a working chain; see `can_work`."""
        return [joint for joint in self.joints if self.can_work(joint)]

    @property
    def empty(self) -> list[str]:
        """The names of joints whose limits leave a single position."""
        return [
            self.names[joint.index()]
            for joint in self.joints
            if isinstance(joint, RevoluteJoint | PrismaticJoint)
            and joint.position_lower_limits()[0] == joint.position_upper_limits()[0]
        ]

    @property
    def size(self) -> float:
        """The largest distance between bodies, in m, in the default configuration."""
        context = self.plant.CreateDefaultContext()
        places = [
            self.plant.EvalBodyPoseInWorld(context, body).translation()
            for body in self.bodies.values()
        ]
        return float(np.linalg.norm(np.ptp(places, axis=0)))

    def directions(self, chain: Sequence[Joint], frame: str, point: Vector) -> int:
        """The number of directions in which a chain of joints moves a point, in most postures."""
        context = self.plant.CreateDefaultContext()
        columns = [joint.velocity_start() for joint in chain]
        random = np.random.default_rng(0)
        most = 0
        for _ in range(4):
            for joint in chain:
                self.plant.SetPositions(context, _somewhere(joint, random, self.plant, context))
            rows = self.plant.CalcJacobianTranslationalVelocity(
                context,
                JacobianWrtVariable.kV,
                GetScopedFrameByName(self.plant, frame),
                np.array(point),
                self.plant.world_frame(),
                self.plant.world_frame(),
            )[:, columns]
            values = np.linalg.svd(rows, compute_uv=False)
            most = max(most, int(np.count_nonzero(values > 1e-6 * max(values[0], self.size))))
        return most

    @property
    def coupled(self) -> set[str]:
        """The names of mimic joints and of the joints that they follow."""
        return {name for c in self.couplings for name in (c.follower, c.leader)}

    def can_work(self, joint: Joint) -> bool:
        """Whether a joint is revolute or prismatic, can move, and is not coupled to another one."""
        if not isinstance(joint, RevoluteJoint | PrismaticJoint):
            return False
        low, high = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
        return self.names[joint.index()] not in self.coupled and bool(high > low)


def _somewhere(
    joint: Joint, random: np.random.Generator, plant: MultibodyPlant, context: Context
) -> FloatArray:
    """The positions of a plant with those of one joint at random."""
    q = plant.GetPositions(context)
    low = max(joint.position_lower_limits()[0], -1.0)
    high = max(min(joint.position_upper_limits()[0], 1.0), low)
    q[joint.position_start()] = random.uniform(low, high)
    return q
