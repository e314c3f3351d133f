"""A closed loop: a diagram with named parts, and the record of a run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common import RandomGenerator
from pydrake.geometry import SceneGraph
from pydrake.systems.framework import Context, Diagram
from pydrake.systems.primitives import RandomSource, VectorLogSink

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.blocks.traced_system import context_in
from drake_dae.dae import Signal
from drake_dae.diagrams.parts import encoder_seed as seed_of_encoders
from drake_dae.diagrams.record import Record, Recorded, computed_record
from drake_dae.errors import ModelError, WiringError
from drake_dae.systems.controller import Controller, PhaseChange
from drake_dae.systems.estimator import StateEstimator
from drake_dae.systems.plant import Plant
from drake_dae.systems.references import ReferenceGenerator
from drake_dae.systems.sensors import ForceSensor, StateSensor


@checked(WiringError)
@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A plant under a controller: a Drake diagram with named parts, and the record of its runs.

    With the numbers of a context, `TracedSystem(compile_diagram(loop.diagram, context=context))` is
    the loop as one block with the same output ports. Drake's contact and sources of noise stay
    outside, and their outputs are its inputs.

    Attributes:
        diagram: The diagram, with the output ports `state`, `constraint_force`,
            `constraint_residual`, `controlled_output`, `control`, further signals of plant,
            controller and sensors such as `reference`, further ports of the controller such as
            `tracking_error`, and `link_state` of a robot.
        signals: Names and units of each logged signal, in their order in the log.

    The other attributes are its parts, or None where it has none.
    """

    diagram: Diagram
    plant: Plant
    controller: Controller
    generator: ReferenceGenerator | None  # None for a controller that plans its references itself
    log: VectorLogSink  # one sample per step: all signals, stacked
    signals: Mapping[str, Sequence[Signal]]
    scene_graph: SceneGraph | None = None
    sensor: ForceSensor | None = None
    noise: RandomSource | None = None  # of the sensor
    exogenous: ReferenceGenerator | None = None  # for the law
    plant_exogenous: ReferenceGenerator | None = None
    encoders: StateSensor | None = None
    encoder_noise: RandomSource | None = None
    observer: StateEstimator | None = None
    memory: dict[str, Any] = field(default_factory=dict, repr=False)  # of rollouts

    def __repr__(self) -> str:
        return f"ClosedLoop('{self.plant.dae.name}', logs {', '.join(self.signals)})"

    @property
    def reference(self) -> ReferenceGenerator:
        """The generator of references, or a ModelError."""
        if self.generator is None:
            raise ModelError(f"{self.controller.get_name()} plans its references itself")
        return self.generator

    def set_seed(self, context: Context, seed: int, encoder_seed: int | None = None) -> None:
        """Sets the seeds of the noise of the force sensor, and of the encoders if not None.

        Without it they are the same in every run of a loop. `context` is that of the diagram.
        """
        # Other numbers for the encoders, so that both noises are independent.
        of_encoders = None if encoder_seed is None else seed_of_encoders(encoder_seed)
        for source, number in ((self.noise, seed), (self.encoder_noise, of_encoders)):
            if source is not None and number is not None:
                source.SetRandomContext(context_in(source, context), RandomGenerator(number))

    @checked(WiringError)
    def set_state(self, context: Context, state: ArrayLike) -> None:
        """Sets the state x of the plant, shape (n,), without a projection onto the constraints.

        `context` is that of the diagram.
        """
        self.plant.set_state(context_in(self.plant, context), state)

    def changes(self, record: Record) -> tuple[PhaseChange, ...]:
        """The start of each phase of a run, with the reason, from its record; none without phases.

        Phases of which the record has no sample are left out.
        """
        return self.controller.changes({name: record[name] for name in record.signals})

    def record(self, context: Context, after: float | None = None) -> Record:
        """The record of a run: the logged signals up to now, and signals computed from them.

        It includes `desired_output` r, `tracking_error` z - r (29), and further signals of the
        controller. At a change of phase, values are those before it. With `after` only samples
        later than this time, in s. `context` is that of the diagram.
        """
        context_in(self.plant, context)  # The log has no name.
        logged = Record.from_log(self.log, self.signals, context, after)
        return self.with_errors(logged).while_finite()

    @checked(WiringError)
    def with_errors(self, record: Record) -> Record:
        """Adds the derived signals of the controller, such as `tracking_error`, to a record."""
        values = {name: recorded.values for name, recorded in record.signals.items()}
        derived = self.controller.derived(values)
        added = {name: Recorded(v, signals) for name, (v, signals) in derived.items()}
        return computed_record(record.time, {**record.signals, **added})

    @checked(WiringError)
    def plant_parameters(self, record: Record, context: Context) -> FloatArray:
        """The parameters of the plant at the times of a record, one row each.

        They are those of the context after the run, and exogenous ones those of the record.
        """
        own = self.plant.parameters(context_in(self.plant, context))
        values = np.tile(own, (record.time.size, 1))
        if "exogenous" in record:
            values[:, self.plant.exogenous_places] = record["exogenous"]
        return values

    @checked(WiringError)
    def predicted_error(self, record: Record) -> FloatArray:
        """The predicted error (30), (31) of a record, one column for each output.

        Raises:
            ModelError: The record has no rows.
        """
        if not record.time.size:
            raise ModelError("the record has no rows, from which an error is predicted")
        parameters = self.controller.law.system.parameter_values
        if self.exogenous is not None:
            moving = self.exogenous.reference(record.time[0])
            parameters[self.controller.exogenous_places] = moving
        values = {name: recorded.values for name, recorded in record.signals.items()}
        return self.controller.predicted_error(record.time, values, parameters)
