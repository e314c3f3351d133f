"""The connections of a closed loop: plant, references and controller."""

from collections.abc import Mapping, Sequence

from pydrake.geometry import Meshcat, SceneGraph
from pydrake.systems.framework import DiagramBuilder, OutputPort, System, TriggerType
from pydrake.systems.primitives import LogVectorOutput, Multiplexer, VectorLogSink

from drake_dae.arguments import checked
from drake_dae.dae import Signal, TrackingLaw
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.parts import (
    ENCODER_NOISE,
    LoopSettings,
    add_block,
    add_exogenous,
    add_noise,
    add_signals,
    check_force_loop,
    hold_before,
    make_observer,
    make_sensor,
    misfits,
)
from drake_dae.errors import DrakeDaeError, WiringError
from drake_dae.references import Reference, references_by_name
from drake_dae.scene.view import add_live_view
from drake_dae.systems.applied_control import ControlHold, ControlLimits
from drake_dae.systems.controller import Controller, TrackingController, check_law
from drake_dae.systems.plant import Plant
from drake_dae.systems.references import CommandedReferences, ReferenceGenerator

Named = dict[str, tuple[OutputPort, Sequence[Signal]]]
"""Name -> output port, names and units of a recorded signal."""


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
        settings: Sensors, drives, sampling and other parts of the loop; none if None.
        scene_graph: The scene graph with which the robot's MultibodyPlant was registered before
            parsing, for drawings of its geometry; None without drawings.
        meshcat: The Meshcat for a live view of surfaces, contact forces, and the robot if there is
            a scene_graph: `FRAME_RATE` times a second, which shortens the integrator's steps. None
            for no live view; `make_animation` does not need it.

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
        outputs = law.layout.values(reference.reference(settings.start_time))
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
        builder.Connect(source, system.GetInputPort(port))

    # The plant, its references and its controller.
    for block in (plant, reference, controller):
        if block is not None:
            add_block(builder, block)
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
        hold = builder.AddSystem(ControlHold(control.size(), hold_before(plant, parts.sampling)))
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
            add_block(builder, sensor)
            connect(force, sensor, "force")
            force = sensor.GetOutputPort("measured_force")
            named["measured_force"] = (force, dae.constraint_input_signals)
            lag = sensor.sample_period or sensor.time_constant
            noise = add_noise(builder, sensor, lag, "force_noise")
        connect(force, controller, "measured_force")
        if controller.HasOutputPort("tared_force"):
            force = controller.GetOutputPort("tared_force")
    if observer is not None and observer.HasInputPort("measured_force"):
        connect(force, observer, "measured_force")

    # Every signal has its own name: it is exported, and logged at each step.
    inputs = Named()
    if moving is not None:
        signals = plant.exogenous_layout.reference_signals(dae.exogenous.signals)
        inputs["exogenous"] = (moving.get_output_port(), signals)
    inputs |= {name: (plant.GetOutputPort(name), s) for name, s in plant.port_signals.items()}
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

    diagram = builder.Build()
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
