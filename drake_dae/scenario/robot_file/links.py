"""The links of a scenario's robot, and the same robot for a plant of Drake's."""

from collections.abc import Sequence

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import QuaternionFloatingJoint

from drake_dae.errors import ModelError
from drake_dae.robots.constraints import Constraint
from drake_dae.robots.constraints.plant_constraints import plant_constraints
from drake_dae.robots.links.multibody import MultibodyExpressions
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.robot_file.changes import change_robot, finalize
from drake_dae.scenario.robot_file.loops import cut_loops, loop_constraints
from drake_dae.scenario.robot_file.payloads import Payload, add_payloads
from drake_dae.scenario.robot_file.reading import read_into, read_robot
from drake_dae.scenario.robot_file.robot import Robot


@at("robot.file")
def add_robot(
    robot: Robot,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    payloads: Sequence[Payload] = (),
) -> None:
    """Adds the robot of a scenario to a plant that is not finalized.

    Args:
        robot: The robot.
        plant: The plant, registered in the scene graph.
        scene_graph: The scene graph.
        payloads: What the scenario has under `plant_payloads`.

    Raises:
        ScenarioError: Drake cannot read the file, or drops something of it; or what the scenario
            says beside it does not fit.
    """
    change_robot(robot, plant, read_into(plant, robot, scene_graph))
    add_payloads("plant_payloads", payloads, plant)
    cut_loops(plant)


@at("robot.file")
def robot_links(
    robot: Robot, scene_graph: SceneGraph, payloads: Sequence[Payload] = ()
) -> tuple[MultibodyExpressions, list[Constraint]]:
    """The links of a scenario's robot, and the constraints that those joints are which close loops.

    Args:
        robot: What the scenario has under `robot`.
        scene_graph: Where its geometry is registered.
        payloads: What the scenario has under `plant_payloads`, for the links of the plant.

    Raises:
        ScenarioError: Something does not fit; the message names its key.
    """
    plant, efforts = read_robot(robot, scene_graph)
    change_robot(robot, plant, efforts)
    add_payloads("plant_payloads", payloads, plant)
    cuts = cut_loops(plant)
    finalize(plant)
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        if isinstance(joint, QuaternionFloatingJoint):
            name = joint.child_body().name()
            raise ModelError(
                f"body '{name}' is free; weld it to the world by "
                f"robot.base, as base: {{weld: {name}}}, or name it in robot.free, which gives it "
                "a joint in roll, pitch and yaw. A quaternion is not supported: no force keeps its "
                "length"
            )
    links = MultibodyExpressions(plant)
    try:
        plant_constraints(links)
    except ModelError as error:
        raise ModelError(
            f"{error}. With leave_out: [constraints] under robot the file stays as it is"
        ) from None
    return links, loop_constraints(cuts, plant)
