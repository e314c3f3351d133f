"""The one wiring: plant, reference, controller, loggers, and a view of the robot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common import RandomGenerator
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.multibody.meshcat import ContactVisualizer
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    OutputPort,
    System,
    TriggerType,
)
from pydrake.systems.primitives import (
    LogVectorOutput,
    MatrixGain,
    RandomSource,
    VectorLogSink,
)

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.references import Reference
from drake_dae.dae.signals import Signal
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.diagrams.contact_plant import ContactPlant
from drake_dae.diagrams.force_feedback import add_force_feedback
from drake_dae.errors import DrakeDaeError, WiringError
from drake_dae.simulation.record import Record, Recorded
from drake_dae.simulation.view import RobotBlock, add_live_view
from drake_dae.systems.block import ParameterizedSystem
from drake_dae.systems.controller import TrackingController
from drake_dae.systems.limits import ControlLimits
from drake_dae.systems.plant import DaePlant
from drake_dae.systems.references import ReferenceGenerator
from drake_dae.systems.sampling import ControlHold, Sampling
from drake_dae.systems.sensors import ForceSensor

Block = TypeVar("Block", bound=System)


@checked(WiringError)
@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A plant that follows a reference under the law (28).

    Attributes:
        diagram: The diagram, with the output ports `state`, `constraint_force`,
            `constraint_residual`, `controlled_output`, `control`, `reference` and
            `tracking_error`; `link_state` for a robot, and `loop_state` if joints close its loops.
        plant, controller, reference: The systems in it.
        loggers: Port name -> (sink, names and units), one sample per step.
        scene_graph: The geometry of the robot, or None.
        sensor: The sensor of the constraint force, or None.
        noise: The source of the sensor's noise, or None.
        exogenous: The generator of the exogenous signals for the law, or None.
    """

    diagram: Diagram
    plant: DaePlant | ContactPlant
    controller: TrackingController
    reference: ReferenceGenerator
    loggers: Mapping[str, tuple[VectorLogSink, Sequence[Signal]]]
    scene_graph: SceneGraph | None
    sensor: ForceSensor | None
    noise: RandomSource | None
    exogenous: ReferenceGenerator | None = None

    def __repr__(self) -> str:
        return f"ClosedLoop('{self.plant.dae.name}', logs {', '.join(self.loggers)})"

    def set_seed(self, context: Context, seed: int) -> None:
        """Chooses the noise of the sensor; without a call it is the same in every run.

        Args:
            context: The diagram's context.
            seed: The seed of the random numbers.
        """
        if self.noise is not None:
            own = self.noise.GetMyMutableContextFromRoot(context)
            self.noise.SetRandomContext(own, RandomGenerator(seed))

    def record(self, context: Context, after: float | None = None) -> Record:
        """What was logged up to now, with `desired_output` r and `tracking_error` z - r (29).

        Args:
            context: The diagram's context.
            after: Only what was logged later than this time, in s; None for all.
        """
        record = Record.from_logs(self.loggers, context, after)
        desired = record["reference"][:, self.controller.law.layout.lowest]
        outputs = record.signals["controlled_output"]
        derived = {
            "desired_output": Recorded(desired, outputs.signals),
            "tracking_error": Recorded(outputs.values - desired, outputs.signals),
        }
        return Record(record.time, {**record.signals, **derived})

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


@checked(WiringError)
def make_closed_loop(
    system: DaePlant | ContactPlant,
    law: TrackingLaw,
    references: Sequence[Reference],
    *,
    exogenous: Sequence[Reference] = (),
    sensor: ForceSensor | None = None,
    sampling: Sampling | None = None,
    control_limits: ArrayLike | None = None,
    scene_graph: SceneGraph | None = None,
    meshcat: Meshcat | None = None,
    start_time: float = 0.0,
) -> ClosedLoop:
    """Wires plant, reference generator and controller, with loggers and a view.

    Args:
        system: A `RobotPlant`, any `DaePlant`, or a `ContactPlant`, with which everything is logged
            at its steps.
        law: A law for the plant's system, or for a model of the same structure.
        references: References that together cover all controlled outputs, in their order.
        exogenous: The exogenous signals of the plant, which its law knows too, as references that
            together cover all entries of w, in their order; without any nothing moves.
        sensor: The sensor of the constraint force, for a law with measured force. Without one the
            force is connected as it is, where that closes no algebraic loop.
        sampling: When the law reads and acts: a period and a delay, and its control is held
            between. The error is that of the theory up to one order of these times. None for a law
            that acts continuously.
        control_limits: The largest |u| that the drives give, shape (p,), such as
            `model.control_limits`; the signal "excess" of the record tells what was cut off, and
            when. Integrals stand still meanwhile. None for drives without limits.
        scene_graph: Where the robot's MultibodyPlant was registered before it was parsed; then
            its geometry can be drawn. Left out where nothing is drawn.
        meshcat: Where to draw the surface, the contact force, and the robot if there is a
            scene_graph, while it runs: `FRAME_RATE` times a second, which shortens the
            integrator's steps. None draws nothing; `make_animation` needs none.
        start_time: When a run begins, in s: the zero dynamics are judged at the references then.

    A loop that draws, samples and limits nothing converts to AutoDiffXd, for Drake's Linearize.

    Warns:
        NonMinimumPhaseWarning: The zero dynamics are unstable; see `TrackingController`.

    Raises:
        WiringError: The law or the sensor has other sizes than the plant; measured force would
            close an algebraic loop, or a sampled loop that diverges; or no law uses the sensor.
    """
    _check_sizes(system, law, sensor)
    builder = DiagramBuilder()

    # The plant, its reference and its controller.
    plant = _add(builder, system)
    reference = builder.AddSystem(ReferenceGenerator(references, law.degrees))
    try:
        outputs = law.layout.values(reference.reference(start_time))
    except DrakeDaeError:
        outputs = None  # A trajectory that begins later.
    period = plant.time_step if sampling is None else sampling.period
    controller = builder.AddSystem(TrackingController(law, outputs, sample_period=period))
    builder.Connect(plant.GetOutputPort("state"), controller.GetInputPort("estimated_state"))
    builder.Connect(reference.GetOutputPort("reference"), controller.GetInputPort("reference"))
    held = None if sampling is None else _hold_before(plant, sampling)
    control, limits = _add_drives(builder, controller, held, control_limits)
    builder.Connect(control, plant.GetInputPort("control"))

    moving = [_add_exogenous(builder, block, exogenous) for block in (plant, controller)]

    noise = None
    if law.measured_force:
        if sensor is not None:
            _add(builder, sensor)
        noise = add_force_feedback(builder, plant, controller, sensor, sampling)
    elif sensor is not None:
        raise WiringError("the law takes no measured force; make it with measured_force=True")

    # Every signal under its own name: exported, and logged once per step.
    dae = plant.dae
    loggers: dict[str, tuple[VectorLogSink, Sequence[Signal]]] = {}
    named: dict[str, tuple[System, Sequence[Signal]]] = {
        "state": (plant, dae.state_signals),
        "constraint_force": (plant, dae.force_signals),
        "constraint_residual": (plant, plant.structure.manifold.residual_signals),
        "controlled_output": (plant, dae.output_signals),
        "control": (control.get_system(), dae.control_signals),
        "reference": (reference, law.reference_signals),
    }
    if isinstance(plant, ContactPlant):
        named["contact_force"] = (plant, plant.contact_force_signals)
    if limits is not None:
        named["excess"] = (limits, dae.control_signals)
    if law.integral.outputs:
        named["integral"] = (controller, law.integral.signals)
    if law.measured_force and sensor is not None:
        named["measured_force"] = (sensor, dae.constraint_input_signals)
    if isinstance(plant, RobotBlock) and plant.model.loop_joints.signals:
        named["loop_state"] = (plant, plant.model.loop_joints.signals)
    if moving[0] is not None:
        signals = plant.exogenous_layout.reference_signals(dae.exogenous.signals)
        builder.ExportOutput(moving[0].get_output_port(), "exogenous")
        loggers["exogenous"] = (_log(builder, moving[0].get_output_port(), plant), signals)
    for name, (owner, labels) in named.items():
        port = owner.GetOutputPort(name)
        builder.ExportOutput(port, name)
        loggers[name] = (_log(builder, port, plant), labels)
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
        diagram, plant, controller, reference, loggers, scene_graph, sensor, noise, moving[1]
    )


def _add(builder: DiagramBuilder, block: Block) -> Block:
    """Adds what the caller made."""
    try:
        return builder.AddSystem(block)
    except RuntimeError:
        raise WiringError(
            f"'{block.get_name()}' stands in another diagram already; make a new one for this loop"
        ) from None


def _log(
    builder: DiagramBuilder, port: OutputPort, plant: DaePlant | ContactPlant
) -> VectorLogSink:
    """Logs once per step.

    Of a discrete plant it is by the clock: after the last step of a run its state is that of an
    instant that the run has not reached.
    """
    if plant.time_step:
        return LogVectorOutput(port, builder, {TriggerType.kPeriodic}, plant.time_step)
    return LogVectorOutput(port, builder, {TriggerType.kPerStep})


def _hold_before(plant: DaePlant | ContactPlant, sampling: Sampling) -> Sampling:
    """The sampling of the hold: a discrete plant takes what was held one step of its own before."""
    step = plant.time_step
    if step and sampling.delay < step * (1.0 - 1e-9):
        raise WiringError(
            f"the plant steps by {step:g} s and takes the control that was held before, so that a "
            f"sampling's delay is {step:g} s or more, got {sampling.delay:g} s. A law without "
            "delay at each step of the plant needs no sampling"
        )
    return replace(sampling, delay=max(sampling.delay - step, 0.0))


def _add_drives(
    builder: DiagramBuilder,
    controller: TrackingController,
    sampling: Sampling | None,
    control_limits: ArrayLike | None,
) -> tuple[OutputPort, ControlLimits | None]:
    """Adds what stands between controller and plant, and returns the control that arrives."""
    control, limits = controller.GetOutputPort("control"), None
    if sampling is not None:
        hold = builder.AddSystem(ControlHold(control.size(), sampling))
        builder.Connect(control, hold.get_input_port())
        control = hold.get_output_port()
    if control_limits is not None:
        limits = builder.AddSystem(ControlLimits(control_limits))
        if limits.limits.size != control.size():
            raise WiringError(
                f"control_limits has {limits.limits.size} entries, there are {control.size()} "
                "controls"
            )
        builder.Connect(control, limits.get_input_port())
        control = limits.GetOutputPort("control")
        if controller.law.integral.outputs:
            hold = builder.AddSystem(MatrixGain(np.ones((len(controller.law.integral.outputs), 1))))
            builder.Connect(limits.GetOutputPort("is_limited"), hold.get_input_port())
            builder.Connect(hold.get_output_port(), controller.GetInputPort("hold"))
    return control, limits


def _add_exogenous(
    builder: DiagramBuilder,
    block: ParameterizedSystem | ContactPlant,
    exogenous: Sequence[Reference],
) -> ReferenceGenerator | None:
    """Adds the generator of a block's exogenous signals, each with the derivatives that it needs.

    Raises:
        WiringError: The references are not as many as the signals.
    """
    names = [signal.name for signal in block.dae.exogenous.signals]
    size = sum(reference.size for reference in exogenous)
    if exogenous and size != len(names):
        raise WiringError(
            f"the references of exogenous signals cover {size}, '{block.dae.name}' has "
            f"{len(names)}: {', '.join(names) or 'none'}"
        )
    if not exogenous:
        return None
    generator = builder.AddSystem(ReferenceGenerator(exogenous, block.exogenous_layout.degrees))
    generator.set_name(f"{block.get_name()}_exogenous")
    builder.Connect(generator.get_output_port(), block.GetInputPort("exogenous"))
    return generator


def _check_sizes(plant: DaePlant, law: TrackingLaw, sensor: ForceSensor | None) -> None:
    """Refuses wrong sizes: Drake would name the ports, but not what is wrong with them."""
    own, other = plant.dae, law.system
    sizes = [(s.num_states, s.num_controls, s.num_constraints) for s in (own, other)]
    if sizes[0] != sizes[1]:
        has, takes = ("{} states, {} controls and {} constraints".format(*size) for size in sizes)
        raise WiringError(
            f"the law is for '{other.name}' with {takes}, the plant '{own.name}' has {has}. Make "
            "the law for the plant's system, TrackingLaw(plant.dae, ...), or for a model of the "
            "same structure"
        )
    if sensor is not None:
        size = sensor.GetInputPort("force").size()
        if size != own.num_constraints:
            names = ", ".join(signal.name for signal in own.constraint_input_signals) or "none"
            raise WiringError(
                f"the sensor measures {size} forces, the plant '{own.name}' has "
                f"{own.num_constraints} ({names}); make it as ForceSensor({own.num_constraints}, "
                "...)"
            )
