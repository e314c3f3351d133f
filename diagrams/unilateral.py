"""Contacts that open and close in a scenario and in a closed loop."""

from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.primitives import AffineSystem

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.robots.model import RobotModel
from drake_dae.simulation.records.record import Record
from drake_dae.systems.plants.unilateral.contacts import coefficient
from drake_dae.systems.plants.unilateral.plant import UnilateralRobotPlant


@checked(ModelError)
@dataclass(frozen=True)
class Unilateral:
    """The plant is a `UnilateralRobotPlant`: its contacts open where they would pull, and impact.

    The law is that of closed contacts, and reads the state alone: it goes on as it is. An open
    contact does to it what a force does that is not there, so that phi'' = -A(x) lambda_d, lambda_d
    being the force that is wanted: the robot comes back where it shall push, and stays away where
    it would have to pull.

    Attributes:
        restitution: Constraint -> its coefficient of restitution, 0 (no bounce) to 1 (no loss), a
            pure number. Other constraints stay closed. Left out, all that can only push open, and
            do not bounce.
        settling_time: Bouncing that would end within this time, in s, ends at once.

    Raises:
        ModelError: A number makes no sense.
    """

    restitution: dict[str, float] = field(default_factory=dict)
    settling_time: float = 1e-3

    def __post_init__(self) -> None:
        positive("settling_time", self.settling_time)
        for name, value in self.restitution.items():
            coefficient(f"restitution.{name}", value)

    def plant(self, model: RobotModel, structure: ConstraintStructure) -> UnilateralRobotPlant:
        """The plant of a robot, and of the structure of its system.

        Raises:
            ModelError: A constraint is not known, or cannot open, or none can.
        """
        pushing = [one.name for one in model.constraints if any(one.can_only_push)]
        if not pushing:
            raise ModelError("the robot has no constraint that can only push, so that none opens")
        chosen = self.restitution or dict.fromkeys(pushing, 0.0)
        return UnilateralRobotPlant(
            model, chosen, settling_time=self.settling_time, structure=structure
        )


def open_holds(
    builder: DiagramBuilder, plant: UnilateralRobotPlant, law: TrackingLaw
) -> list[OutputPort]:
    """Ports for the `hold` of a controller: integrals of forces of open contacts stand still.

    Args:
        builder: The builder of the diagram, with the plant in it.
        plant: The plant.
        law: The law, whose integrals they are.
    """
    inputs = law.measured_force.inputs if law.measured_force else {}
    found = np.zeros((len(law.integral.outputs), len(plant.contacts)))
    for row, output in enumerate(law.integral.outputs):
        for column, normal in enumerate(plant.normals):
            found[row, column] = inputs.get(output) == normal
    if not found.any():
        return []
    system = AffineSystem(D=-found, y0=found.sum(axis=1))
    hold = builder.AddSystem(system)
    hold.set_name("open_contacts")
    builder.Connect(plant.GetOutputPort("mode"), hold.get_input_port())
    return [hold.get_output_port()]


def with_events(
    record: Record, plant: UnilateralRobotPlant, context: Context, after: float | None
) -> Record:
    """A record with the events of its time.

    Args:
        record: The record.
        plant: The plant.
        context: The context of its diagram.
        after: Only what was later than this time, in s; None for all.
    """
    events = plant.events(plant.GetMyContextFromRoot(context))
    begin = -np.inf if after is None else after
    end = record.time[-1] if record.time.size else -np.inf
    return replace(record, events=tuple(e for e in events if begin < e.time <= end))
