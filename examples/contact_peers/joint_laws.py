"""Drake's own controllers of joints, with the torques of the wall's force besides."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from pydrake.systems.controllers import InverseDynamicsController, JointStiffnessController
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Adder

from contact_peers.robot import Goals, Robot
from drake_dae.arrays import FloatArray
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY, weakly


class JointGoals(LeafSystem):
    """The task in joints, and what the joints give to press with its force."""

    __slots__ = SHARED_DICTIONARY

    def __init__(self, robot: Robot, goals: Goals) -> None:
        super().__init__()
        self._robot, self._goals = robot, goals
        self._reference = self.DeclareVectorInputPort("reference", 19)
        self.DeclareVectorOutputPort("desired_state", 14, weakly(self._calc_state))
        self.DeclareVectorOutputPort("desired_acceleration", 7, weakly(self._calc_acceleration))
        self.DeclareVectorOutputPort("pressing", 7, weakly(self._calc_pressing))

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        goal = self._goals.at(self._reference.Eval(context))
        output.SetFromVector(np.concatenate([goal.q, goal.v]))

    def _calc_acceleration(self, context: Context, output: BasicVector) -> None:
        goal = self._goals.at(self._reference.Eval(context))
        output.SetFromVector(goal.acceleration_of_joints)

    def _calc_pressing(self, context: Context, output: BasicVector) -> None:
        goal = self._goals.at(self._reference.Eval(context))
        there = self._robot.at(np.concatenate([goal.q, goal.v]))
        output.SetFromVector(-there.jacobian[:3].T @ goal.contact)


class InverseDynamics(Diagram):
    """Drake's InverseDynamicsController, and J^T lambda.

    Without integral action: it would press until the tool stands where the laws believe that the
    wall is, and there the force is zero.
    """

    __slots__ = SHARED_DICTIONARY

    LIMITS: ClassVar = {"motion": (2.0, 25.0), "damping_ratio": (0.3, 4.0)}

    def __init__(
        self, robot: Robot, goals: Goals, gains: Mapping[str, float], start: FloatArray
    ) -> None:
        super().__init__()
        self.robot = robot  # Drake's controller does not own it.
        rate = np.full(7, gains["motion"])
        damping = 2.0 * gains["damping_ratio"] * rate
        law = InverseDynamicsController(robot.plant, rate**2, 0.0 * rate, damping, True)
        _wire(self, law, JointGoals(robot, goals))


class JointStiffness(Diagram):
    """Drake's JointStiffnessController, and J^T lambda.

    K and D are those of a bandwidth with the inertia of each joint at the start.
    """

    __slots__ = SHARED_DICTIONARY

    LIMITS: ClassVar = {"motion": (2.0, 25.0), "damping_ratio": (0.3, 4.0)}

    def __init__(
        self, robot: Robot, goals: Goals, gains: Mapping[str, float], start: FloatArray
    ) -> None:
        super().__init__()
        self.robot = robot
        masses, rate = np.diag(robot.at(start).mass), gains["motion"]
        stiffness, damping = masses * rate**2, 2.0 * gains["damping_ratio"] * rate * masses
        law = JointStiffnessController(robot.plant, stiffness, damping)
        _wire(self, law, JointGoals(robot, goals))


def _wire(
    diagram: Diagram, law: InverseDynamicsController | JointStiffnessController, goals: JointGoals
) -> None:
    """Gives a controller of Drake its goals, adds the force, and the ports of a `TaskLaw`."""
    builder = DiagramBuilder()
    for system in (law, goals):
        builder.AddSystem(system)
    total = builder.AddSystem(Adder(2, 7))
    builder.Connect(goals.GetOutputPort("desired_state"), law.GetInputPort("desired_state"))
    if law.HasInputPort("desired_acceleration"):
        port = law.GetInputPort("desired_acceleration")
        builder.Connect(goals.GetOutputPort("desired_acceleration"), port)
    builder.Connect(law.get_output_port(0), total.get_input_port(0))
    builder.Connect(goals.GetOutputPort("pressing"), total.get_input_port(1))
    builder.ExportInput(law.GetInputPort("estimated_state"), "estimated_state")
    builder.ExportInput(goals.GetInputPort("reference"), "reference")
    builder.ExportOutput(total.get_output_port(), "control")
    builder.BuildInto(diagram)
