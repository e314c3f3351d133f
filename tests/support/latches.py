"""Two carts on a rail that pass a puck between them by latches."""

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

import drake_dae as dd

MASSES = {"left": 2.0, "puck": 1.0, "right": 3.0}

_LINK = """
<link name="{name}"><inertial><mass value="{mass}"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{name}_x" type="prismatic"><parent link="rail"/><child link="{name}"/>
<axis xyz="1 0 0"/><limit effort="1000" lower="-10" upper="10" velocity="100"/></joint>"""

_MOTOR = """
<transmission name="{name}_drive"><type>transmission_interface/SimpleTransmission</type>
<joint name="{name}_x"/><actuator name="{name}_motor"/></transmission>"""

LINKS = "".join(_LINK.format(name=name, mass=mass) for name, mass in MASSES.items())
MOTORS = "".join(_MOTOR.format(name=name) for name in ("left", "right"))
URDF = f'<robot name="carts"><link name="rail"/>{LINKS}{MOTORS}</robot>'


def carts():
    """The robot: q = (left, puck, right) in m, and a latch of each cart and the puck."""
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(URDF, "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("rail"))
    plant.Finalize()
    latches = [
        dd.CoincidentPoints(cart, (0, 0, 0), "puck", (0, 0, 0), axes="x", name=f"{cart}_hand")
        for cart in ("left", "right")
    ]
    outputs = [dd.JointPositions(["puck_x"])]
    return dd.RobotModel.from_multibody(plant, latches, outputs, forces=["right_hand.fx"])


def hand_over(**of_close):
    """The left cart holds the puck; the right one takes it, and the left one retreats."""
    return dd.Task(
        [
            dd.Close(over=0.4, contact="right_hand", name="grasp", **of_close),
            dd.Move({"right_hand.fx": -6.0}, 0.3, over=0.2, name="pull"),
            dd.Release(over=0.4, contact="left_hand", name="pass"),
            dd.Move({"left_hand.x": 0.2}, 0.5, over=0.4, name="retreat"),
        ],
        contact_force=0.01,
    )


def controller_of(task, model, **settings):
    """The controller of a task with latches."""
    first, *further = dd.laws_of_latches(task.plan, model.dae, dd.poles(-8.0))
    return dd.TaskController(task, *first, further=further, whole=model.dae, **settings)
