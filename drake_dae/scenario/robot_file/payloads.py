"""Masses that a scenario attaches to a robot."""

from collections.abc import Sequence
from dataclasses import dataclass

from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, UnitInertia

from drake_dae.arrays import positive
from drake_dae.errors import ModelError
from drake_dae.robots.links.frames import frame_named
from drake_dae.robots.surfaces.surface import Vector
from drake_dae.scenario.forms.keys import at


@dataclass(frozen=True)
class Payload:
    """A point mass attached to a robot.

    Attributes:
        frame: Name of the frame to which it is attached.
        mass: Its mass, in kg; the parameter "<name>.mass".
        point: Its position in the frame, m.
        name: The name of its body.
    """

    frame: str
    mass: float
    point: Vector = (0.0, 0.0, 0.0)
    name: str = "payload"

    def __post_init__(self) -> None:
        positive("the mass of a payload", self.mass)


def add_payloads(key: str, payloads: Sequence[Payload], plant: MultibodyPlant) -> None:
    """Adds payloads to a plant that is not finalized.

    Args:
        key: The key of the scenario with these payloads.
        payloads: The payloads.
        plant: The plant.

    Raises:
        ScenarioError: There is no such frame of the robot, or another body has the name.
    """
    for index, payload in enumerate(payloads):
        with at(f"{key}.{index}"):
            _add(payload, plant)


def _add(payload: Payload, plant: MultibodyPlant) -> None:
    frame = frame_named(plant, payload.frame)
    if frame.body() == plant.world_body():
        raise ModelError(
            f"'{payload.frame}' is a frame of the world, and a payload there moves nothing; name a "
            "frame of the robot"
        )
    if plant.HasBodyNamed(payload.name):
        raise ModelError(f"a payload needs a name of its own; a body '{payload.name}' is there")
    inertia = SpatialInertia(payload.mass, [0.0, 0.0, 0.0], UnitInertia(0.0, 0.0, 0.0))
    body = plant.AddRigidBody(payload.name, frame.model_instance(), inertia)
    plant.WeldFrames(frame, body.body_frame(), RigidTransform(list(payload.point)))
