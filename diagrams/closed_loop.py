"""A closed loop: plant, reference, controller, loggers, and the record of a run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.systems.framework import (
    Context,
    Diagram,
)
from pydrake.systems.primitives import RandomSource, VectorLogSink

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.diagrams.force_feedback import seed_noise
from drake_dae.diagrams.state_feedback import MeasuredState
from drake_dae.diagrams.unilateral import with_events
from drake_dae.errors import DrakeDaeError, WiringError
from drake_dae.simulation.records.record import Record, Recorded
from drake_dae.systems.blocks.along import function_along
from drake_dae.systems.control.controller import TrackingController
from drake_dae.systems.control.observer import DisturbanceObserver
from drake_dae.systems.control.references import ReferenceGenerator
from drake_dae.systems.plants.contact.contact_plant import ContactPlant
from drake_dae.systems.plants.dae_plant import DaePlant
from drake_dae.systems.plants.unilateral.plant import UnilateralRobotPlant
from drake_dae.systems.sensing.force_sensor import ForceSensor

Plant = DaePlant | ContactPlant | UnilateralRobotPlant


@checked(WiringError)
@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A plant that follows a reference under the law (28).

    Attributes:
        diagram: The diagram, with the output ports `state`, `constraint_force`,
            `constraint_residual`, `controlled_output`, `control`, `reference` and
            `tracking_error`; `link_state` for a robot, and `loop_state` if joints close its loops.
        plant, controller, reference: The systems in it.
        loggers: Port name -> (sink, names and units), one sample per step: of what has memory of
            its own. `record` computes everything else from that, when it is asked for.
        signals: Names and units of each signal of a record.
        scene_graph: The geometry of the robot, or None.
        sensor: The sensor of the constraint force, or None.
        noise: The source of the sensor's noise, or None.
        exogenous: The generator of the exogenous signals for the law, or None.
        plant_exogenous: That for the plant, or None.
        encoders: What measures the state for the law, or None.
        observer: The observer that feeds the law instead, or None.
        memory: What `rollout` made of the loop, and uses again.
    """

    diagram: Diagram
    plant: Plant
    controller: TrackingController
    reference: ReferenceGenerator
    loggers: Mapping[str, tuple[VectorLogSink, Sequence[Signal]]]
    signals: Mapping[str, Sequence[Signal]]
    scene_graph: SceneGraph | None
    sensor: ForceSensor | None
    noise: RandomSource | None
    exogenous: ReferenceGenerator | None = None
    plant_exogenous: ReferenceGenerator | None = None
    encoders: MeasuredState | None = None
    observer: DisturbanceObserver | None = None
    memory: dict[str, Any] = field(default_factory=dict, repr=False)

    def __repr__(self) -> str:
        return f"ClosedLoop('{self.plant.dae.name}', logs {', '.join(self.signals)})"

    @property
    def moves_otherwise(self) -> bool:
        """Whether the plant has other exogenous signals than its law knows."""
        pair = (self.exogenous, self.plant_exogenous)
        known, own = ([id(one) for one in each.references] if each else [] for each in pair)
        return known != own

    def set_seed(self, context: Context, seed: int) -> None:
        """Chooses the noise of the sensor; without a call it is the same in every run.

        Args:
            context: The diagram's context.
            seed: The seed of the random numbers.
        """
        seed_noise(self.noise, context, seed)

    def record(self, context: Context, after: float | None = None) -> Record:
        """What was logged up to now, and what follows from it.

        With `desired_output` r and `tracking_error` z - r (29). Parameters and gains are those that
        the blocks had at each moment.

        Args:
            context: The diagram's context.
            after: Only what was logged later than this time, in s; None for all.

        Raises:
            WiringError: An input port of plant or controller has a fixed value in this context, of
                which nobody knows since when.
        """
        logged = Record.from_logs(self.loggers, context, after)
        if not isinstance(self.plant, ContactPlant):
            logged = self._completed(logged, self.plant, context)
        found = self.with_errors(logged).while_finite()
        if isinstance(self.plant, UnilateralRobotPlant):
            return with_events(found, self.plant, context, after)
        return found

    def _completed(
        self, logged: Record, plant: DaePlant | UnilateralRobotPlant, context: Context
    ) -> Record:
        """A record with what follows from what was logged."""
        self._refuse_fixed_ports(plant, context)
        times, values = logged.time, {name: logged[name] for name in logged.signals}
        known = {**values, "parameters": self._parameters_along(plant, context, times)}
        if self.plant_exogenous is not None:
            values["exogenous"] = self.plant_exogenous.along(times)
        values["reference"] = self.reference.along(times)
        if "control" not in known:
            law = self.controller.law
            gains = motion = None
            if isinstance(plant, DaePlant):
                gains = plant.laws_along(plant.GetMyContextFromRoot(context), times)
                motion = plant.motion_under(law.function) if gains is not None else None
            if gains is None:
                gains = self._parameters_along(self.controller, context, times)
            given = {**known, "reference": values["reference"], "parameters": gains}
            if law.measured_force and "measured_force" not in known:
                # Without a sensor; a law that does but integrate the force reads none here.
                given["measured_force"] = (
                    plant.along("constraint_force", known)
                    if law.control_takes_force
                    else np.zeros((times.size, plant.dae.num_constraints))
                )
            if motion is not None and motion.is_machine_code:
                # Machine code that is there, in place of some for the law alone.
                given |= {"law": gains, "plant": known["parameters"]}
                control = function_along(motion, given, self._control_alone)
            else:
                control = function_along(law.function, given)
            values["control"] = known["control"] = control
        values |= {port: plant.along(port, known) for port in plant.functions}
        return Record(times, {n: Recorded(values[n], tuple(self.signals[n])) for n in self.signals})

    def _control_alone(self, moment: tuple[FloatArray, ...]) -> tuple[FloatArray, ...] | None:
        """The control where the plant has no value with it."""
        law = self.controller.law.function
        values = law.evaluate(*moment[:3])
        return values if law.is_valid else None

    def with_errors(self, record: Record) -> Record:
        """A record with `desired_output` and `tracking_error` besides."""
        desired = record["reference"][:, self.controller.law.layout.lowest]
        outputs = record.signals["controlled_output"]
        derived = {
            "desired_output": Recorded(desired, outputs.signals),
            "tracking_error": Recorded(outputs.values - desired, outputs.signals),
        }
        return Record(record.time, {**record.signals, **derived})

    def _refuse_fixed_ports(self, plant: DaePlant | UnilateralRobotPlant, context: Context) -> None:
        taker, own = self.controller, self.controller.GetMyContextFromRoot(context)
        measured = (plant, "state", "estimated_state")
        if self.encoders is not None:
            measured = (self.encoders.sensor, "estimated_state", "estimated_state")
        for giver, source, name in (
            measured,
            (self.reference, "reference", "reference"),
        ):
            port = taker.GetInputPort(name)
            if not port.HasValue(own):
                continue  # The law knows its references, and is fed back.
            try:
                given = giver.GetOutputPort(source).Eval(giver.GetMyContextFromRoot(context))
            except DrakeDaeError:
                continue  # Where a run failed.
            if not np.array_equal(given, port.Eval(own), equal_nan=True):
                raise _fixed(name, taker)
        if plant.HasInputPort("feedback"):
            at_plant, port = plant.GetMyContextFromRoot(context), plant.GetInputPort("control")
            if plant.GetInputPort("feedback").HasValue(at_plant) and port.HasValue(at_plant):
                raise _fixed("control", plant)

    def _parameters_along(
        self,
        block: DaePlant | UnilateralRobotPlant | TrackingController,
        context: Context,
        times: FloatArray,
    ) -> FloatArray:
        """The parameters of a block at each time, those that move as they did."""
        values = block.parameters_along(block.GetMyContextFromRoot(context), times)
        moving = self.plant_exogenous if block is self.plant else self.exogenous
        if moving is not None:
            values[:, block.exogenous_places] = moving.along(times)
        return values

    def predicted_error(self, record: Record) -> FloatArray:
        """The error (30), (31) that theory predicts for a record's start, shape (k, p)."""
        law = self.controller.law
        parameters = law.system.parameter_values
        if self.exogenous is not None:
            moving = self.exogenous.reference(record.time[0])
            parameters[self.controller.exogenous_places] = moving
        integral = record["integral"][0] if law.integral.outputs else None
        time = record.time - record.time[0]
        start = record["state"][0], record["reference"][0]
        return law.predicted_error(time, *start, parameters, integral)


def _fixed(port: str, block: DaePlant | UnilateralRobotPlant | TrackingController) -> WiringError:
    return WiringError(
        f"the port '{port}' of {block.get_name()} has a fixed value in this context, so that its "
        "control does not follow from the state; wire plant and controller in a diagram of your "
        "own, with a LogVectorOutput"
    )
