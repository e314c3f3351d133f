"""The robot of a scenario as links for the library, and in a MultibodyPlant of Drake's."""

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import QuaternionFloatingJoint

from drake_dae.errors import ModelError
from drake_dae.robots import Constraint, MultibodyExpressions, joint_names, plant_constraints
from drake_dae.scenario.forms.keys import at
from drake_dae.scenario.robot_file.changes import add_payloads, change_robot, finalize
from drake_dae.scenario.robot_file.loops import cut_loops, joints_of, loop_constraints
from drake_dae.scenario.robot_file.reading import read_robot
from drake_dae.scenario.robot_file.robot import Payload, Robot

RobotLinks = tuple[MultibodyExpressions, list[Constraint]]
"""The links of a robot, and its loop-closing joints as constraints."""

_MASSLESS = 1e-12
"""An eigenvalue of M(q) below this fraction of the largest one is zero up to round-off."""


@at("robot.file")
def add_robot(
    robot: Robot,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    payloads: Sequence[Payload] = (),
) -> None:
    """Adds the robot of a scenario to a plant that is not finalized."""
    _, mender = read_robot(robot, scene_graph, plant=plant)
    change_robot(robot, plant, mender)
    add_payloads("plant.payloads", payloads, plant)
    cut_loops(plant, mender.parent_frames)


@at("robot.file")
def robot_links(
    robot: Robot,
    scene_graph: SceneGraph,
    payloads: Sequence[Payload] = (),
    drawn: bool = True,
) -> RobotLinks:
    """The links of a scenario's robot, and its loop-closing joints as constraints."""
    plant, mender = read_robot(robot, scene_graph, drawn)
    change_robot(robot, plant, mender)
    add_payloads("plant.payloads", payloads, plant)
    cuts = cut_loops(plant, mender.parent_frames)
    finalize(plant)
    for joint in joints_of(plant):
        if isinstance(joint, QuaternionFloatingJoint):
            name = joint.child_body().name()
            raise ModelError(
                f"body '{name}' is free, with a quaternion, which is not supported. Weld it to the "
                f"world by robot.base, as base: {{weld: {name}}}, or name it in robot.free, which "
                "gives it a joint in roll, pitch and yaw"
            )
    links = MultibodyExpressions(plant, scene_graph)
    _check_mass(plant)
    try:
        plant_constraints(links)
    except ModelError as error:
        raise ModelError(
            f"{error}. robot.leave_out takes them out, as [equality/connect] of MJCF, or "
            "[robot/drake:ball_constraint] of a URDF"
        ) from None
    return links, loop_constraints(cuts, plant)


def _check_mass(plant: MultibodyPlant) -> None:
    """Checks that each joint moves a mass; otherwise its acceleration is not determined."""
    context = plant.CreateDefaultContext()
    default = plant.GetPositions(context)
    random = np.random.default_rng(0)
    # A point mass at the end of a straight arm makes M(q) singular in that configuration only.
    for step in (np.zeros_like(default), *random.uniform(-1.0, 1.0, (3, default.size))):
        plant.SetPositions(context, default + step)
        values, modes = np.linalg.eigh(plant.CalcMassMatrix(context))
        null = modes[:, values <= _MASSLESS * values[-1]]
        if not null.size:
            return
    massless = {}
    for name, joint in joint_names(plant).items():
        velocities = slice(joint.velocity_start(), joint.velocity_start() + joint.num_velocities())
        if np.any(np.abs(null[velocities]) > 0.1):
            massless[name] = joint.child_body().name()
    raise ModelError(
        f"joints that move no mass: {', '.join(massless)}. Links without it, which no force can "
        f"move: {', '.join(massless.values())}; give them <inertial> with mass and inertia, or "
        "lock the joints by robot.locked"
    )
