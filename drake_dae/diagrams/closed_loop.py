"""A closed loop: a Drake diagram of plant, references and controller, and the record of a run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common import RandomGenerator
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    OutputPort,
    System,
    TriggerType,
)
from pydrake.systems.primitives import LogVectorOutput, Multiplexer, RandomSource, VectorLogSink

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.blocks.traced_system import context_in
from drake_dae.dae import Signal, TrackingLaw
from drake_dae.diagrams.parts import (
    ENCODER_NOISE,
    LoopSettings,
    add_exogenous,
    add_noise,
    add_signals,
    check_force_loop,
    hold_sampling,
    make_observer,
    make_sensor,
    misfits,
)
from drake_dae.diagrams.parts import encoder_seed as seed_of_encoders
from drake_dae.diagrams.record import Record, Recorded, computed_record
from drake_dae.errors import DrakeDaeError, ModelError, WiringError
from drake_dae.references import Reference, references_by_name
from drake_dae.scene.view import add_live_view
from drake_dae.systems.applied_control import ControlHold, ControlLimits
from drake_dae.systems.controller import Controller, PhaseChange, TrackingController, check_law
from drake_dae.systems.estimator import StateEstimator
from drake_dae.systems.plant import Plant, port_signals
from drake_dae.systems.references import CommandedReferences, ReferenceGenerator
from drake_dae.systems.sensors import ForceSensor, StateSensor

Named = dict[str, tuple[OutputPort, Sequence[Signal]]]
"""Name -> output port, names and units of a recorded signal."""


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
        return self.with_errors(logged)

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


@checked(WiringError)
def make_closed_loop(
    plant: Plant,
    law: TrackingLaw,
    references: Sequence[Reference] | Mapping[str, Reference | float],
    settings: LoopSettings | None = None,
    *,
    scene_graph: SceneGraph | None = None,
    meshcat: Meshcat | None = None,
) -> ClosedLoop:
    """Builds the closed loop of a plant, a tracking law and references, with a log and a view.

    On a plant in steps all signals are logged at these. A loop without view, sampling and limits
    converts to AutoDiffXd, for Drake's Linearize.

    Args:
        plant: A `RobotPlant`, or any other `Plant`.
        law: A law for the plant's system, or for a model of the same structure.
        references: References that together cover all controlled outputs, in their order; or name
            -> reference, as `references_by_name` takes them.
        settings: Sensors, drives, sampling and other parts of the loop.
        scene_graph: The scene graph with which the robot's MultibodyPlant was registered before
            parsing, for drawings of its geometry.
        meshcat: The Meshcat for a live view of surfaces, contact forces, and the robot if there is
            a scene_graph: `FRAME_RATE` times a second, which shortens the integrator's steps.

    Warns:
        NonMinimumPhaseWarning: The zero dynamics are unstable; see `TrackingController`.

    Raises:
        WiringError: The parts do not fit together, or measured force would close an algebraic loop,
            or a sampled loop that diverges.
    """
    settings = settings or LoopSettings()
    check_law(plant.dae, law)
    signals, degrees = law.system.output_signals, law.layout.reference_degrees
    if isinstance(references, Mapping):
        references = references_by_name(references, [s.name for s in signals], degrees)
    if settings.commanded:
        reference: ReferenceGenerator = CommandedReferences(references, degrees, signals)
    else:
        reference = ReferenceGenerator(references, degrees)
    try:
        outputs = law.layout.values(reference.reference(0.0))
    except DrakeDaeError:
        outputs = None  # A trajectory that starts later.
    period = settings.period(plant.time_step)
    controller = TrackingController(law, outputs, sample_period=period)
    return wire_loop(
        plant, controller, reference, settings, scene_graph=scene_graph, meshcat=meshcat
    )


@checked(WiringError)
def wire_loop(
    plant: Plant,
    controller: Controller,
    reference: ReferenceGenerator | None = None,
    settings: LoopSettings | None = None,
    *,
    scene_graph: SceneGraph | None = None,
    meshcat: Meshcat | None = None,
) -> ClosedLoop:
    """The closed loop of a plant and any controller, such as that of a task: `make_closed_loop`."""
    parts = settings or LoopSettings()
    controller.check_plant(plant)
    for text in misfits(plant, controller, reference, parts):
        raise WiringError(text)
    builder, period, dae = DiagramBuilder(), parts.period(plant.time_step), plant.dae
    named = Named()

    def connect(source: OutputPort, system: System, port: str) -> None:
        try:
            builder.Connect(source, system.GetInputPort(port))
        except RuntimeError as error:  # Drake names both systems and their sizes.
            raise WiringError(str(error)) from None

    # The plant, its references and its controller.
    for block in (plant, reference, controller):
        if block is not None:
            builder.AddSystem(block)
    if reference is not None:
        goal = reference.GetOutputPort("reference")
        connect(goal, controller, "reference")

    # The state goes to the controller, through encoders.
    state, encoders, encoder_noise = plant.GetOutputPort("state"), None, None
    if parts.encoders is not None:
        encoders = builder.AddSystem(make_sensor(plant, parts.encoders, period))
        connect(state, encoders, "state")
        encoder_noise = add_noise(builder, encoders, period, ENCODER_NOISE)
        state = encoders.GetOutputPort("estimated_state")
        named["estimated_state"] = (state, dae.state_signals)

    # Its control goes to the plant, held between samples and limited by drives.
    control, is_limited = controller.GetOutputPort("control"), None
    if parts.sampling is not None:
        hold = builder.AddSystem(ControlHold(control.size(), hold_sampling(plant, parts.sampling)))
        connect(control, hold, "control")
        control = hold.get_output_port()
    if parts.control_limits is not None:
        limits = builder.AddSystem(ControlLimits(parts.control_limits))
        connect(control, limits, "control")
        control, is_limited = (limits.GetOutputPort(name) for name in ("control", "is_limited"))
    connect(control, plant, "control")

    # Exogenous signals go to the plant, and to the law as known there. Commands pass as many lags
    # to the plant as to the law.
    moving, known = None, None
    degrees = *plant.exogenous_layout.degrees, *controller.exogenous_layout.degrees
    depth = max(degrees, default=0) + 1 if parts.commanded else 0
    moves = parts.exogenous if parts.plant_exogenous is None else parts.plant_exogenous
    if moves:
        moving = add_exogenous(builder, plant, moves, depth)
    if parts.exogenous:
        known = add_exogenous(builder, controller, parts.exogenous, depth)
        builder.ExportOutput(known.get_output_port(), "known_exogenous")

    # An observer estimates model errors for the law, and perhaps its state.
    observer = None
    if parts.observer is not None:
        observer = builder.AddSystem(make_observer(plant, controller, parts))
        if reference is None:
            goal = controller.GetOutputPort("contact_reference")
        connect(state, observer, "measured_state")
        connect(control, observer, "control")
        connect(goal, observer, "reference")
        connect(observer.GetOutputPort("exogenous"), controller, "exogenous")
        if is_limited is not None:
            connect(is_limited, observer, "hold")
        is_limited = observer.GetOutputPort("hold")
        if parts.observer.state_rate is not None:
            if encoders is not None:
                named["measured_state"] = named.pop("estimated_state")
            state = observer.GetOutputPort("estimated_state")
            named["estimated_state"] = (state, dae.state_signals)
    connect(state, controller, "estimated_state")

    # Integrals are not updated while a contact is lost, or a drive is at its limit.
    if is_limited is not None and controller.HasInputPort("hold"):
        connect(is_limited, controller, "hold")
    add_signals(builder, controller, parts.signals)
    if parts.control_limits is not None:
        named["excess"] = (limits.GetOutputPort("excess"), dae.control_signals)

    # The constraint force goes through its sensor to the blocks that measure it.
    force, sensor, noise = plant.GetOutputPort("constraint_force"), parts.sensor, None
    if controller.HasInputPort("measured_force"):
        check_force_loop(plant, controller, sensor, parts.sampling)
        if sensor is not None:
            builder.AddSystem(sensor)
            connect(force, sensor, "force")
            force = sensor.GetOutputPort("measured_force")
            named["measured_force"] = (force, dae.constraint_input_signals)
            lag = sensor.sample_period or sensor.time_constant
            noise = add_noise(builder, sensor, lag, "force_noise")
        connect(force, controller, "measured_force")
        if controller.HasOutputPort("tared_force"):
            force = controller.GetOutputPort("tared_force")
    if observer is not None:
        connect(force, observer, "measured_force")

    # Every signal has its own name: it is exported, and logged at each step.
    inputs = Named()
    if moving is not None:
        signals = plant.exogenous_layout.reference_signals(dae.exogenous.signals)
        inputs["exogenous"] = (moving.get_output_port(), signals)
    own = port_signals(plant.structure)
    inputs |= {name: (plant.GetOutputPort(name), s) for name, s in own.items()}
    if reference is not None:
        inputs["reference"] = (goal, controller.law.reference_signals)
    named = {**inputs, "control": (control, dae.control_signals), **named}
    for block in (controller, observer, plant):
        if block is not None:
            named |= {n: (block.GetOutputPort(n), s) for n, s in block.further_signals.items()}
    shown = {name: port for name, (port, _) in named.items()}
    shown |= {name: controller.GetOutputPort(name) for name in controller.shown}
    if plant.model is not None:
        shown["link_state"] = plant.GetOutputPort("link_state")
    for name, port in shown.items():
        builder.ExportOutput(port, name)
    log = log_steps(builder, [port for port, _ in named.values()], plant)

    # The view: the robot at its link positions, what it touches, the constraint forces.
    if meshcat is not None:
        source = moving.get_output_port() if moving is not None else None
        add_live_view(builder, plant, scene_graph, meshcat, source)

    try:
        diagram = builder.Build()
    except RuntimeError as error:  # An algebraic loop, or a block of another diagram, by name.
        raise WiringError(str(error)) from None
    diagram.set_name("closed_loop")
    return ClosedLoop(
        diagram,
        plant,
        controller,
        reference,
        log,
        {name: tuple(signals) for name, (_, signals) in named.items()},
        scene_graph,
        sensor,
        noise,
        known,
        moving,
        encoders,
        encoder_noise,
        observer,
    )


def log_steps(builder: DiagramBuilder, ports: Sequence[OutputPort], plant: Plant) -> VectorLogSink:
    """Adds one log of several ports, stacked, with one sample per step."""
    stacked = builder.AddSystem(Multiplexer([port.size() for port in ports]))
    stacked.set_name("logged_signals")
    for index, port in enumerate(ports):
        builder.Connect(port, stacked.get_input_port(index))
    port = stacked.get_output_port()
    # After the last step of a run the state of a discrete plant belongs to a time that the run has
    # not reached. Drake's LogVectorOutput with a period keeps the diagram alive (1.51).
    if plant.time_step:
        sink = VectorLogSink(port.size(), {TriggerType.kPeriodic}, plant.time_step)
        log = builder.AddSystem(sink)
        builder.Connect(port, log.get_input_port())
        return log
    return LogVectorOutput(port, builder, {TriggerType.kPerStep})
