"""The task, and the plants on which each law does it.

The task is that of the shipped scenarios: the tool of a 7-joint arm goes round a circle of 0.1 m
radius at 0.1 m/s on a wall, and presses with 20 + 5 sin 2t N.
"""

from dataclasses import dataclass

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, MatrixGain, RandomSource

from drake_dae.scenario.files import load_scenario
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.shipped import find_scenario
from drake_dae.systems.plants.contact.contact_plant import ContactPlant

FRICTION = 0.3
"""The coefficient of the plant; a law knows it, or believes that there is none."""

PERIOD = 1e-3
SETTLED = 2.0
"""Figures are of the time after this, in s."""

DURATION = SETTLED + np.pi
"""Then they are of half a turn, and of a period of the force."""

ANGLE_NOISE, RATE_NOISE, FORCE_NOISE = 5e-6, 1e-3, 0.3
"""Standard deviations at each sample, in rad, rad/s and N."""

SEED = 1


@dataclass(frozen=True)
class Condition:
    """A plant, and what is not as the laws believe.

    Attributes:
        title: What the table calls it.
        scenario: The shipped scenario.
        settings: What it has otherwise.
        load: What the tool weighs more than the laws believe, in kg.
        noise: How much of the noise there is, 0 or 1.
        asked: Which errors are asked of our law there, in mm and N.
    """

    title: str
    scenario: str = "wall_point_contact"
    settings: tuple[str, ...] = ("plant.stiffness=1e5",)
    load: float = 0.0
    noise: float = 0.0
    asked: tuple[float, float] = (0.02, 0.03)


CONDITIONS = (
    Condition("point 1e5 N/m"),
    Condition("point 1e6 N/m", settings=("plant.stiffness=1e6",)),
    Condition("hydro 1e8 Pa", "wall_hydroelastic", ("plant.modulus=1e8",), asked=(0.02, 0.05)),
    Condition("hydro 1e7 Pa", "wall_hydroelastic", ("plant.modulus=1e7",), asked=(0.02, 0.05)),
    Condition(
        "wall +2 mm",
        settings=("plant.stiffness=1e5", "plant_parameters={wall.position: [0.702, 0.0, 0.0]}"),
    ),
    Condition("tool +0.5 kg", load=0.5, asked=(0.1, 0.03)),
    Condition("noise", noise=1.0, asked=(0.02, 0.1)),
)


def task(condition: Condition, friction: float, *settings: str) -> Scenario:
    """The scenario of a condition, whose law believes in a coefficient of friction."""
    noise = FORCE_NOISE * condition.noise
    return load_scenario(
        find_scenario(condition.scenario),
        [
            f"plant.friction={FRICTION}",
            f"constraints.0.friction={friction}",
            f"force_feedback=!MeasuredForce {{sample_period: {PERIOD}, noise_deviation: {noise}}}",
            f"duration={DURATION}",
            *condition.settings,
            *settings,
        ],
    )


class MeasuredPlant(ContactPlant):
    """Drake's contact, whose port `state` has the noise of encoders; `link_state` has none.

    Args:
        plant: The plant without noise.
        noise: How much of the noise there is.
    """

    __slots__ = ()

    def __init__(self, plant: ContactPlant, noise: float) -> None:
        Diagram.__init__(self)
        # What else it tells of itself; Drake has dunder-like names of its own there.
        own = {name: one for name, one in vars(plant).items() if "pydrake" not in name}
        self.__dict__.update(own)
        joints = plant.dae.num_states // 2
        builder = DiagramBuilder()
        builder.AddSystem(plant)
        self._noise = builder.AddSystem(
            RandomSource(RandomDistribution.kGaussian, 2 * joints, PERIOD)
        )
        scale = noise * np.repeat([ANGLE_NOISE, RATE_NOISE], joints)
        scaled = builder.AddSystem(MatrixGain(np.diag(scale)))
        measured = builder.AddSystem(Adder(2, 2 * joints))
        builder.Connect(self._noise.get_output_port(), scaled.get_input_port())
        builder.Connect(plant.GetOutputPort("state"), measured.get_input_port(0))
        builder.Connect(scaled.get_output_port(), measured.get_input_port(1))
        builder.ExportInput(plant.GetInputPort("control"), "control")
        builder.ExportOutput(measured.get_output_port(), "state")
        for index in range(plant.num_output_ports()):
            port = plant.get_output_port(index)
            if port.get_name() != "state":
                builder.ExportOutput(port, port.get_name())
        builder.BuildInto(self)
        self.set_name(plant.get_name())

    def set_seed(self, context: Context, seed: int) -> None:
        """Chooses the noise, in the context of the plant."""
        own = self._noise.GetMyMutableContextFromRoot(context)
        self._noise.SetRandomContext(own, RandomGenerator(seed))


def vary(condition: Condition, plant: MeasuredPlant, context: Context) -> None:
    """Puts into a root context what is not in the scenario: the load, and which noise."""
    body = plant.multibody.GetBodyByName("tool")
    own = plant.multibody.GetMyMutableContextFromRoot(context)
    body.SetMass(own, body.get_mass(own) + condition.load)
    plant.set_seed(context, SEED)
