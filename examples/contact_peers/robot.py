"""What the textbook's laws know of a robot, by Drake's MultibodyPlant; and the task in its joints.

Task coordinates are those of the tool: x along the wall's normal, into the wall; y and z along it;
and the y and z of its axis, which stands normal to the wall.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydrake.math import VectorToSkewSymmetric
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable

from drake_dae.arrays import FloatArray

WALL = 0.7
"""Where the laws believe that the wall is, in m."""

NORMAL = np.array([-1.0, 0.0, 0.0])
POSTURE = (2, 6)
"""The joints that the task leaves free: joint3 and joint7."""

SLOW = 1e-3
"""The speed in m/s below which friction fades, as in the model of a `PointOnSurface`."""


@dataclass(frozen=True)
class RobotState:
    """M v' + bias = u + J_p^T F, and the task coordinates with their rates J v.

    Attributes:
        q, v: Positions and velocities, shape (7,).
        mass: M, shape (7, 7).
        bias: Coriolis forces less gravity, N m, shape (7,).
        jacobian: J of the task coordinates, shape (5, 7); J_p is its first three rows.
        drift: J' v, shape (5,).
        position, velocity: The task coordinates and their rates, shape (5,).
    """

    q: FloatArray
    v: FloatArray
    mass: FloatArray
    bias: FloatArray
    jacobian: FloatArray
    drift: FloatArray
    position: FloatArray
    velocity: FloatArray

    @cached_property
    def inertia(self) -> FloatArray:
        """Lambda = (J M^-1 J^T)^-1, shape (5, 5)."""
        return np.linalg.inv(self.jacobian @ np.linalg.solve(self.mass, self.jacobian.T))


class Robot:
    """A MultibodyPlant of seven joints with a frame `tool`."""

    def __init__(self, plant: MultibodyPlant) -> None:
        self.plant, self._context = plant, plant.CreateDefaultContext()
        self._tool, self._world = plant.GetFrameByName("tool"), plant.world_frame()

    def at(self, state: FloatArray) -> RobotState:
        """All that the laws take, at x = (q, v)."""
        plant, context = self.plant, self._context
        plant.SetPositionsAndVelocities(context, state)
        q, v = np.split(np.array(state), 2)
        bias = plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context)
        of = JacobianWrtVariable.kV, self._tool, np.zeros(3), self._world, self._world
        spatial = plant.CalcJacobianSpatialVelocity(context, *of)
        drift = plant.CalcBiasSpatialAcceleration(context, *of)
        pose = self._tool.CalcPoseInWorld(context)
        axis = pose.rotation().col(2)
        turning = spatial[:3] @ v
        # axis' = omega x axis, and once more.
        of_axis = -VectorToSkewSymmetric(axis)
        axis_drift = of_axis @ drift.rotational()
        axis_drift += turning * (turning @ axis) - axis * (turning @ turning)
        jacobian = np.vstack([spatial[3:], (of_axis @ spatial[:3])[1:]])
        return RobotState(
            q,
            v,
            plant.CalcMassMatrix(context),
            bias,
            jacobian,
            np.concatenate([drift.translational(), axis_drift[1:]]),
            np.concatenate([pose.translation(), axis[1:]]),
            jacobian @ v,
        )


@dataclass(frozen=True)
class Goal:
    """What the task wants now.

    Attributes:
        position, velocity, acceleration: Of the task coordinates, shape (5,).
        force: How the tool shall press, N.
        contact: What the wall then does to the tool, with its friction, N, shape (3,).
        q, v, acceleration_of_joints: The same motion in joints, shape (7,).
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    force: float
    contact: FloatArray
    q: FloatArray
    v: FloatArray
    acceleration_of_joints: FloatArray


class Goals:
    """Goals from the reference R of our law: six positions with two derivatives, and the force.

    Args:
        robot: The robot as the laws know it.
        start: Joint positions near which the task begins, shape (7,).
        friction: The coefficient in which the law believes.
    """

    def __init__(self, robot: Robot, start: FloatArray, friction: float) -> None:
        self._robot, self._q, self._friction = robot, np.array(start), friction
        self._known: dict[bytes, Goal] = {}

    def at(self, reference: FloatArray) -> Goal:
        """The goal at R, shape (19,)."""
        key = reference.tobytes()
        if key not in self._known:
            self._known[key] = self._found(reference)
        return self._known[key]

    def _found(self, reference: FloatArray) -> Goal:
        rows, force = reference[:18].reshape(6, 3), float(reference[18])
        position, velocity, acceleration = (
            np.concatenate([[first], rows[:4, k]]) for k, first in enumerate((WALL, 0.0, 0.0))
        )
        # The joints: Newton from where they were last.
        for _ in range(20):
            found = self._robot.at(np.concatenate([self._q, np.zeros(7)]))
            whole = np.vstack([found.jacobian, np.eye(7)[[*POSTURE]]])
            off = np.concatenate([found.position - position, self._q[[*POSTURE]] - rows[4:, 0]])
            if np.max(np.abs(off)) < 1e-12:
                break
            self._q = self._q - np.linalg.solve(whole, off)
        v = np.linalg.solve(whole, np.concatenate([velocity, rows[4:, 1]]))
        drift = self._robot.at(np.concatenate([self._q, v])).drift
        rates = np.concatenate([acceleration - drift, rows[4:, 2]])

        along = np.array([0.0, *velocity[1:3]])
        frictional = self._friction * along / np.hypot(np.linalg.norm(along), SLOW)
        return Goal(
            position,
            velocity,
            acceleration,
            force,
            force * (NORMAL - frictional),
            self._q.copy(),
            v,
            np.linalg.solve(whole, rates),
        )
