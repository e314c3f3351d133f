"""The connections of a closed loop: plant, references and controller."""

from collections.abc import Mapping, Sequence

from pydrake.geometry import Meshcat, SceneGraph
from pydrake.systems.framework import DiagramBuilder, OutputPort

from drake_dae.arguments import checked
from drake_dae.dae import TrackingLaw
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.drives import add_drives, hold_before
from drake_dae.diagrams.force_feedback import add_force_feedback
from drake_dae.diagrams.observing import add_observer
from drake_dae.diagrams.parts import (
    add_block,
    add_hold,
    add_signals,
    check_parts,
    contact_reference,
)
from drake_dae.diagrams.recorded import (
    further_signals,
    log_signals,
    signals_of_parts,
    signals_of_plant,
)
from drake_dae.diagrams.settings import LoopSettings
from drake_dae.diagrams.sources import add_exogenous, make_generator
from drake_dae.diagrams.state_feedback import add_encoders
from drake_dae.errors import DrakeDaeError, WiringError
from drake_dae.references import Reference, references_by_name
from drake_dae.scene.view import add_live_view
from drake_dae.systems.control.contract import Controller, check_law
from drake_dae.systems.control.controller import TrackingController
from drake_dae.systems.control.references import ReferenceGenerator
from drake_dae.systems.plants.contract import Plant


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

    With a `ContactPlant` all signals are logged at its steps.

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

    A loop without view, sampling and limits converts to AutoDiffXd, for Drake's
    Linearize.

    Warns:
        NonMinimumPhaseWarning: The zero dynamics are unstable; see `TrackingController`.

    Raises:
        WiringError: The law or the sensor has other sizes than the plant; measured force would
            close an algebraic loop, or a sampled loop that diverges; the law does not use the
            sensor; or an observer lacks sampling or measured force.
    """
    settings = settings or LoopSettings()
    check_law(plant.dae, law)
    if isinstance(references, Mapping):
        names = [signal.name for signal in law.system.output_signals]
        references = references_by_name(references, names, law.layout.reference_degrees)
    period = settings.period(plant.time_step)
    reference = make_generator(references, law, settings)
    try:
        outputs = law.layout.values(reference.reference(settings.start_time))
    except DrakeDaeError:
        outputs = None  # A trajectory that starts later.
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
    """Builds the closed loop of a plant and any controller, such as that of a task.

    Args:
        plant: The plant.
        controller: The controller.
        reference: The source of its references; None if the controller plans them itself.
        settings, scene_graph, meshcat: As for `make_closed_loop`.

    Raises:
        WiringError: The controller does not fit this plant or one of these parts; or as for
            `make_closed_loop`.
    """
    parts = settings or LoopSettings()
    controller.check_plant(plant)
    check_parts(plant, controller, reference, parts)
    builder, law = DiagramBuilder(), controller.law

    # The plant, its references and its controller.
    for block in (plant, reference, controller):
        if block is not None:
            add_block(builder, block)
    goal = contact_reference(controller, reference)

    # The state goes to the controller, through encoders.
    state, measured = plant.GetOutputPort("state"), None
    if parts.encoders is not None:
        measured = add_encoders(builder, plant, parts.encoders, parts.period(plant.time_step))
        state = measured.output
    observing = parts.observer if goal is not None else None
    if observing is None:
        builder.Connect(state, controller.GetInputPort("estimated_state"))

    # Its control goes to the plant, held between samples and limited by drives.
    sampling = None if parts.sampling is None else hold_before(plant, parts.sampling)
    control = controller.GetOutputPort("control")
    control, limits = add_drives(builder, control, sampling, parts.control_limits)
    builder.Connect(control, plant.GetInputPort("control"))
    if goal is not None and controller.HasInputPort("reference"):
        builder.Connect(goal, controller.GetInputPort("reference"))

    # Exogenous signals go to the plant, and to the law as known there.
    moving, known = add_exogenous(builder, plant, controller, parts)

    # An observer estimates model errors for the law, and perhaps its state. Integrals are not
    # updated while a contact is lost, or a drive is at its limit.
    holds, observer = list[OutputPort](), None
    if observing is not None and goal is not None:
        ports = state, sampling, control, goal, limits
        observer = add_observer(builder, plant, controller, observing, *ports, parts.encoders)
        if observing.state_rate is not None:
            state = observer.GetOutputPort("estimated_state")
        holds.append(observer.GetOutputPort("hold"))
    if limits is not None and observer is None:
        holds.append(limits.GetOutputPort("is_limited"))
    add_hold(builder, controller, holds)
    add_signals(builder, controller, parts.signals)

    # The constraint force goes through its sensor to the blocks that measure it.
    noise = None
    if controller.HasInputPort("measured_force"):
        if parts.sensor is not None:
            add_block(builder, parts.sensor)
        ways = parts.sensor, parts.sampling, [] if observer is None else [observer]
        noise = add_force_feedback(builder, plant, controller, *ways)

    # Every signal has its own name: it is exported, and logged at each step.
    named = {
        **signals_of_plant(plant, moving, reference, law, control),
        **signals_of_parts(plant, controller, measured, limits, observer, parts.sensor),
    }
    if reference is not None:
        named |= further_signals(reference)
    log = log_signals(builder, plant, controller, named)

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
        parts.sensor,
        noise,
        known,
        moving,
        measured,
        observer,
    )
