"""Two of the shipped seven-joint arms that hold one object: 14 actuators, a loop of 6 equations."""

from collections.abc import Sequence

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from drake_dae import AxisCoordinates, JointPositions, PointCoordinates, RobotModel, WeldedFrames
from drake_dae.robots import Stage
from drake_dae.scenario.shipped import FOLDER

LENGTH = 0.2
"""Of the object, in m, as in held_box.urdf."""

NOMINAL = np.tile([0.0, -0.7162933, 0.0, -1.7685105, 0.0, 0.9140075, 0.0], 2)
"""Both elbows up, the object level, 0.4 m above the floor, midway between the bases."""

GRASP = WeldedFrames(
    "object",
    "right::tool",
    RigidTransform(RollPitchYaw(0.0, np.pi / 2, np.pi), [LENGTH / 2, 0.0, 0.0]),
    name="grasp",
)
"""The right tool on the right end of the object; its fx presses the object together."""


def two_arms_plant() -> MultibodyPlant:
    """Arms "left" and "right", and the object of 4 kg, which is fixed to the left tool."""
    plant = MultibodyPlant(0.0)
    add_two_arms(plant)
    plant.Finalize()
    return plant


def add_two_arms(plant: MultibodyPlant, scene: object = None) -> None:
    """Adds them to a plant, as a `ContactPlant` asks for."""
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(FOLDER / "models" / "package.xml"))
    parser.AddModelsFromUrl("package://drake_dae_models/two_arms.dmd.yaml")


def two_arms(actuation: Sequence[Stage] = ()) -> RobotModel:
    """z_1 is the object's position, its orientation, and one joint of each arm's redundancy."""
    return RobotModel.from_multibody(
        two_arms_plant(),
        constraints=[GRASP],
        outputs=[
            PointCoordinates("object", "xyz"),
            AxisCoordinates("object", "x", "yz"),
            AxisCoordinates("object", "y", "z"),
            JointPositions(["left::joint3", "right::joint3"]),
        ],
        nominal_positions=NOMINAL,
        name="two arms",
        actuation=actuation,
    )
