"""The wiring of a closed loop: plant, reference, controller, loggers, and a view of the robot."""

from collections.abc import Mapping, Sequence

from numpy.typing import ArrayLike
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.multibody.meshcat import ContactVisualizer
from pydrake.systems.framework import (
    DiagramBuilder,
    OutputPort,
    System,
)

from drake_dae.arguments import checked
from drake_dae.dae.references import Reference, references_by_name
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.diagrams.closed_loop import ClosedLoop, Plant
from drake_dae.diagrams.force_feedback import add_force_feedback
from drake_dae.diagrams.observing import add_observer
from drake_dae.diagrams.state_feedback import MeasuredState, add_encoders
from drake_dae.diagrams.unilateral import open_holds
from drake_dae.diagrams.wiring import (
    add_block,
    add_drives,
    add_exogenous,
    add_hold,
    add_watch,
    check_sizes,
    hold_before,
    log_steps,
)
from drake_dae.errors import DrakeDaeError, WiringError
from drake_dae.pictures.view import RobotBlock, add_live_view
from drake_dae.systems.control.controller import TrackingController
from drake_dae.systems.control.limits import ControlLimits
from drake_dae.systems.control.observer import DisturbanceObserver
from drake_dae.systems.control.observer_rates import Observing
from drake_dae.systems.control.references import ReferenceGenerator, SystemReference
from drake_dae.systems.control.sampling import Sampling
from drake_dae.systems.plants.contact.contact_plant import ContactPlant
from drake_dae.systems.plants.unilateral.plant import UnilateralRobotPlant
from drake_dae.systems.sensing.encoders import Encoders
from drake_dae.systems.sensing.force_sensor import ForceSensor
from drake_dae.systems.sensing.tolerances import Tolerances


def can_be_fed_back(
    law: TrackingLaw, sampling: Sampling | None, control_limits: ArrayLike | None
) -> bool:
    """Whether a plant can take a law itself, in place of its control: see `DaePlant.feedback`.

    So it is where the law acts continuously, through no drive with limits, and takes the state and
    references alone; the arguments are those of `make_closed_loop`.
    """
    takes_more = law.measured_force or law.integral.outputs or law.exogenous_degrees
    is_direct = sampling is None and control_limits is None
    return is_direct and law.system.num_controls > 0 and not takes_more


@checked(WiringError)
def make_closed_loop(
    system: Plant,
    law: TrackingLaw,
    references: Sequence[Reference] | Mapping[str, Reference | float] | System,
    *,
    exogenous: Sequence[Reference] = (),
    plant_exogenous: Sequence[Reference] | None = None,
    sensor: ForceSensor | None = None,
    sampling: Sampling | None = None,
    encoders: Encoders | None = None,
    control_limits: ArrayLike | None = None,
    tolerances: Tolerances | None = None,
    observer: Observing | None = None,
    scene_graph: SceneGraph | None = None,
    meshcat: Meshcat | None = None,
    start_time: float = 0.0,
) -> ClosedLoop:
    """Wires plant, reference generator and controller, with loggers and a view.

    Args:
        system: A `RobotPlant`, any `DaePlant`, or a `ContactPlant`, with which everything is logged
            at its steps; or a `UnilateralRobotPlant`: while a contact of it is open the law goes on
            as it is, so that phi'' = -A(x) lambda_d, lambda_d being the force that is wanted, and
            the integral of its force stands still.
        law: A law for the plant's system, or for a model of the same structure.
        references: References that together cover all controlled outputs, in their order; or name
            -> reference, as `references_by_name` takes them; or a Drake System that gives R(t), as
            a `SystemReference` with all degrees of the law takes it.
        exogenous: The exogenous signals of the plant, which its law knows too, as references that
            together cover all entries of w, in their order; without any nothing moves.
        plant_exogenous: Those of the plant, where its law knows others, or has none; None for the
            same.
        sensor: The sensor of the constraint force, for a law with measured force. Without one the
            force is connected as it is, where that closes no algebraic loop.
        sampling: When the law reads and acts: a period and a delay, and its control is held
            between. The error is that of the theory up to one order of these times. None for a law
            that acts continuously.
        encoders: How the state is measured that the law gets, when it reads; the signal
            "estimated_state" of the record tells it. None where it gets the state as it is.
        control_limits: The largest |u| that the drives give, shape (p,), such as
            `model.control_limits`; the signal "excess" of the record tells what was cut off, and
            when. Integrals stand still meanwhile. None for drives without limits.
        tolerances: How large errors may be, or a run ends with an exception that tells it.
        observer: How a `DisturbanceObserver` observes what the law's model lacks, for a sampled law
            with measured force of a system that `with_disturbance` made. The signals "disturbance"
            and "friction" of the record are what it found, and integrals stand still while a
            contact is lost.
        scene_graph: Where the robot's MultibodyPlant was registered before it was parsed; then
            its geometry can be drawn. Left out where nothing is drawn.
        meshcat: Where to draw the surface, the contact force, and the robot if there is a
            scene_graph, while it runs: `FRAME_RATE` times a second, which shortens the
            integrator's steps. None draws nothing; `make_animation` needs none.
        start_time: When a run begins, in s: the zero dynamics are judged at the references then.

    A loop that draws, samples, limits and watches nothing converts to AutoDiffXd, for Drake's
    Linearize.

    Warns:
        NonMinimumPhaseWarning: The zero dynamics are unstable; see `TrackingController`.

    Raises:
        WiringError: The law or the sensor has other sizes than the plant; measured force would
            close an algebraic loop, or a sampled loop that diverges; no law uses the sensor; or an
            observer lacks samples or measured force.
    """
    check_sizes(system, law, sensor)
    if isinstance(references, System):
        references = [SystemReference(references, law.degrees)]
    if isinstance(references, Mapping):
        names = [signal.name for signal in law.system.output_signals]
        references = references_by_name(references, names, law.degrees)
    builder = DiagramBuilder()

    # The plant, its reference and its controller.
    plant = add_block(builder, system)
    reference = builder.AddSystem(ReferenceGenerator(references, law.degrees))
    try:
        outputs = law.layout.values(reference.reference(start_time))
    except DrakeDaeError:
        outputs = None  # A trajectory that begins later.
    period = plant.time_step if sampling is None else sampling.period
    is_fed_back = plant.HasInputPort("feedback") and can_be_fed_back(law, sampling, control_limits)
    controller = TrackingController(
        law,
        outputs,
        sample_period=period,
        references=reference if is_fed_back else None,
        feedback=is_fed_back,
    )
    builder.AddSystem(controller)
    state, measured = plant.GetOutputPort("state"), None
    if encoders is not None:
        measured = add_encoders(builder, plant, encoders, period)
        state = measured.output
    builder.Connect(state, controller.GetInputPort("estimated_state"))
    held = None if sampling is None else hold_before(plant, sampling)
    control, limits = add_drives(builder, controller, held, control_limits)
    if is_fed_back:
        builder.Connect(controller.GetOutputPort("feedback"), plant.GetInputPort("feedback"))
    else:
        builder.Connect(reference.GetOutputPort("reference"), controller.GetInputPort("reference"))
        builder.Connect(control, plant.GetInputPort("control"))

    own = exogenous if plant_exogenous is None else plant_exogenous
    moving = [add_exogenous(builder, *pair) for pair in ((plant, own), (controller, exogenous))]
    holds = open_holds(builder, plant, law) if isinstance(plant, UnilateralRobotPlant) else []
    watch = None
    if observer is not None:
        goal = reference.GetOutputPort("reference")
        watch = add_observer(
            builder, plant, controller, observer, state, held, control, goal, limits
        )
        holds.append(watch.GetOutputPort("hold"))
    elif limits is not None:
        holds.append(limits.GetOutputPort("is_limited"))
    add_hold(builder, controller, holds)

    noise = None
    if law.measured_force:
        if sensor is not None:
            add_block(builder, sensor)
        others = [] if watch is None else [watch]
        noise = add_force_feedback(builder, plant, controller, sensor, sampling, others)
    elif sensor is not None:
        raise WiringError("the law takes no measured force; make it with measured_force=True")

    # Every signal under its own name: exported, and logged once per step if nothing else tells it.
    named = _named_signals(
        plant, controller, reference, control, moving[0], measured, limits, watch, sensor
    )
    if tolerances is not None:
        add_watch(builder, plant, reference, law, tolerances)
    told: set[str] = set()
    if not isinstance(plant, ContactPlant):
        told = {*plant.functions, "reference", "exogenous"}
        if control.get_system() is controller:
            told.add("control")
    loggers = {}
    for name, (port, signals) in named.items():
        builder.ExportOutput(port, name)
        if name not in told:
            loggers[name] = (log_steps(builder, port, plant), signals)
    builder.ExportOutput(controller.GetOutputPort("tracking_error"), "tracking_error")

    # The view: the robot at its link positions, what it touches, the constraint forces.
    if isinstance(plant, RobotBlock):
        builder.ExportOutput(plant.GetOutputPort("link_state"), "link_state")
        if meshcat is not None:
            source = moving[0].get_output_port() if moving[0] is not None else None
            add_live_view(builder, plant, scene_graph, meshcat, source)
            if isinstance(plant, ContactPlant):
                contact = builder.AddSystem(ContactVisualizer(meshcat))
                for name in ("contact_results", "query_object"):
                    builder.Connect(plant.GetOutputPort(name), contact.GetInputPort(name))

    diagram = builder.Build()
    diagram.set_name("closed_loop")
    return ClosedLoop(
        diagram,
        plant,
        controller,
        reference,
        loggers,
        {name: tuple(signals) for name, (_, signals) in named.items()},
        scene_graph,
        sensor,
        noise,
        moving[1],
        moving[0],
        encoders=measured,
        observer=watch,
    )


def _named_signals(
    plant: Plant,
    controller: TrackingController,
    reference: ReferenceGenerator,
    control: OutputPort,
    moving: ReferenceGenerator | None,
    measured: MeasuredState | None,
    limits: ControlLimits | None,
    watch: DisturbanceObserver | None,
    sensor: ForceSensor | None,
) -> dict[str, tuple[OutputPort, Sequence[Signal]]]:
    """Name -> output port, names and units of all that a record has."""
    dae, law = plant.dae, controller.law
    named: dict[str, tuple[OutputPort, Sequence[Signal]]] = {}
    if moving is not None:
        signals = plant.exogenous_layout.reference_signals(dae.exogenous.signals)
        named["exogenous"] = (moving.get_output_port(), signals)
    for name, (owner, signals) in {
        "state": (plant, dae.state_signals),
        "constraint_force": (plant, dae.force_signals),
        "constraint_residual": (plant, plant.structure.manifold.residual_signals),
        "controlled_output": (plant, dae.output_signals),
        "reference": (reference, law.reference_signals),
    }.items():
        named[name] = (owner.GetOutputPort(name), signals)
    named["control"] = (control, dae.control_signals)
    if isinstance(plant, ContactPlant):
        port = plant.GetOutputPort("contact_force")
        named["contact_force"] = (port, plant.contact_force_signals)
    if measured is not None:
        named["estimated_state"] = (measured.output, dae.state_signals)
    if limits is not None:
        named["excess"] = (limits.GetOutputPort("excess"), dae.control_signals)
    if law.integral.outputs:
        named["integral"] = (controller.GetOutputPort("integral"), law.integral.signals)
    if watch is not None:
        for name in ("disturbance", "friction"):
            signals = getattr(watch, f"{name}_signals")
            named |= {name: (watch.GetOutputPort(name), signals)} if signals else {}
    if law.measured_force and sensor is not None:
        port = sensor.GetOutputPort("measured_force")
        named["measured_force"] = (port, dae.constraint_input_signals)
    if isinstance(plant, RobotBlock) and plant.model.loop_joints.signals:
        named["loop_state"] = (plant.GetOutputPort("loop_state"), plant.model.loop_joints.signals)
    if isinstance(plant, UnilateralRobotPlant):
        named["mode"] = (plant.GetOutputPort("mode"), plant.mode_signals)
        named["gap"] = (plant.GetOutputPort("gap"), plant.gap_signals)
    return named
