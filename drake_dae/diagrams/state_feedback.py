"""The wire from a plant's state to its law, through encoders."""

from dataclasses import dataclass

from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.primitives import RandomSource

from drake_dae.diagrams.sources import add_noise, seed_noise
from drake_dae.errors import ModelError, WiringError
from drake_dae.robots import velocities_are_rates
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.sensing.encoders import Encoders, StateSensor

ENCODER_NOISE = "encoder_noise"
"""The name of the source of the noise of encoders."""


@dataclass(frozen=True, eq=False)
class MeasuredState:
    """The measurement between a plant's state and its law.

    Attributes:
        sensor: The encoders.
        noise: The source of their noise, if they have any.
    """

    sensor: StateSensor
    noise: RandomSource | None

    @property
    def output(self) -> OutputPort:
        """The measured state."""
        return self.sensor.GetOutputPort("estimated_state")

    def set_seed(self, context: Context, seed: int) -> None:
        """Sets the seed of the noise, below 2^32, in the context of the diagram."""
        seed_noise(self.noise, context, encoder_seed(seed))


def encoder_seed(seed: int) -> int:
    """The seed of the noise of encoders for a user's seed below 2^32.

    It differs from the user's seed, which a force sensor uses, so that their noise is independent.
    """
    return (seed + 2**31) % 2**32


def make_sensor(plant: Plant, encoders: Encoders, period: float) -> StateSensor:
    """Makes the encoders of a robot; the arguments and errors are those of `add_encoders`."""
    if not period:
        raise WiringError(
            "encoders are read at samples, and this law acts continuously; give it a sampling"
        )
    if plant.model is None:
        raise WiringError(
            "encoders measure the positions of a robot: a RobotPlant or a ContactPlant"
        )
    links = plant.model.links
    if encoders.velocity_bandwidth is not None and not velocities_are_rates(links):
        raise WiringError(
            "velocities from differences need q' = v, and this robot has a body with q' = N(q) v; "
            "leave velocity_bandwidth out"
        )
    try:
        return StateSensor(plant.dae.num_states, links.q.numel(), encoders, period)
    except ModelError as error:
        raise WiringError(str(error)) from None


def add_encoders(
    builder: DiagramBuilder, plant: Plant, encoders: Encoders, period: float
) -> MeasuredState:
    """Adds the encoders of a robot, sampled with its law.

    Args:
        builder: The builder of the diagram, with the plant in it.
        plant: The robot.
        encoders: The encoders.
        period: The time between samples in s; 0 for a continuous law.

    Raises:
        WiringError: The law is not sampled, the plant is not a robot, or velocities are to be
            differences of positions of which they are not the derivatives.
    """
    sensor = make_sensor(plant, encoders, period)
    builder.AddSystem(sensor)
    builder.Connect(plant.GetOutputPort("state"), sensor.GetInputPort("state"))
    return MeasuredState(sensor, add_noise(builder, sensor, period, ENCODER_NOISE))
