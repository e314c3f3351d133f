"""The one wiring: plant, reference, controller, loggers, and a view of the robot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, TriggerType
from pydrake.systems.primitives import LogVectorOutput, RandomSource, VectorLogSink

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.references import Reference
from drake_dae.dae.signals import Signal
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.errors import DrakeDaeError, WiringError
from drake_dae.simulation.record import Record, Recorded
from drake_dae.simulation.view import add_live_view
from drake_dae.systems.block import ParameterizedSystem
from drake_dae.systems.controller import TrackingController
from drake_dae.systems.plant import DaePlant
from drake_dae.systems.references import ReferenceGenerator
from drake_dae.systems.robot_plant import RobotPlant
from drake_dae.systems.sensors import ForceSensor

Block = TypeVar("Block", DaePlant, ForceSensor)


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
        memory: What `rollout` made of the loop, and uses again.
    """

    diagram: Diagram
    plant: DaePlant
    controller: TrackingController
    reference: ReferenceGenerator
    loggers: Mapping[str, tuple[VectorLogSink, Sequence[Signal]]]
    scene_graph: SceneGraph | None
    sensor: ForceSensor | None
    noise: RandomSource | None
    exogenous: ReferenceGenerator | None = None
    memory: dict[str, Any] = field(default_factory=dict, repr=False)

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
        return self.with_errors(Record.from_logs(self.loggers, context, after))

    def with_errors(self, record: Record) -> Record:
        """A record of the logged signals with `desired_output` and `tracking_error` besides."""
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
        return law.predicted_error(
            record.time - record.time[0], record["state"][0], record["reference"][0], parameters
        )


@checked(WiringError)
def make_closed_loop(
    system: DaePlant,
    law: TrackingLaw,
    references: Sequence[Reference],
    *,
    exogenous: Sequence[Reference] = (),
    sensor: ForceSensor | None = None,
    scene_graph: SceneGraph | None = None,
    meshcat: Meshcat | None = None,
    start_time: float = 0.0,
) -> ClosedLoop:
    """Wires plant, reference generator and controller, with loggers and a view.

    Args:
        system: A `RobotPlant`, or any `DaePlant`.
        law: A law for the plant's system, or for a model of the same structure.
        references: References that together cover all controlled outputs, in their order.
        exogenous: The exogenous signals of the plant, which its law knows too, as references that
            together cover all entries of w, in their order; without any nothing moves.
        sensor: The sensor of the constraint force, for a law with measured force. Without one the
            force is connected as it is, where that closes no algebraic loop.
        scene_graph: Where the robot's MultibodyPlant was registered before it was parsed; then
            its geometry can be drawn. Left out where nothing is drawn.
        meshcat: Where to draw the surface, the contact force, and the robot if there is a
            scene_graph, while it runs: `FRAME_RATE` times a second, which shortens the
            integrator's steps. None draws nothing; `make_animation` needs none.
        start_time: When a run begins, in s: the zero dynamics are judged at the references then.

    A loop that draws nothing and samples nothing converts to AutoDiffXd, for Drake's Linearize.

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
    controller = builder.AddSystem(TrackingController(law, outputs))
    builder.Connect(plant.GetOutputPort("state"), controller.GetInputPort("estimated_state"))
    builder.Connect(reference.GetOutputPort("reference"), controller.GetInputPort("reference"))
    builder.Connect(controller.GetOutputPort("control"), plant.GetInputPort("control"))

    moving = [_add_exogenous(builder, block, exogenous) for block in (plant, controller)]

    noise = None
    if law.measured_force:
        noise = _add_force_feedback(builder, plant, controller, sensor)
    elif sensor is not None:
        raise WiringError("the law takes no measured force; make it with measured_force=True")

    # Every signal under its own name: exported, and logged once per step.
    dae = plant.dae
    loggers = {}
    named = {
        "state": (plant, dae.state_signals),
        "constraint_force": (plant, dae.force_signals),
        "constraint_residual": (plant, plant.structure.manifold.residual_signals),
        "controlled_output": (plant, dae.output_signals),
        "control": (controller, dae.control_signals),
        "reference": (reference, law.reference_signals),
    }
    if law.measured_force and sensor is not None:
        named["measured_force"] = (sensor, dae.constraint_input_signals)
    if isinstance(plant, RobotPlant) and plant.model.loop_joints.signals:
        named["loop_state"] = (plant, plant.model.loop_joints.signals)
    if moving[0] is not None:
        signals = plant.exogenous_layout.reference_signals(dae.exogenous.signals)
        builder.ExportOutput(moving[0].get_output_port(), "exogenous")
        sink = LogVectorOutput(moving[0].get_output_port(), builder, {TriggerType.kPerStep})
        loggers["exogenous"] = (sink, signals)
    for name, (owner, signals) in named.items():
        port = owner.GetOutputPort(name)
        builder.ExportOutput(port, name)
        loggers[name] = (LogVectorOutput(port, builder, {TriggerType.kPerStep}), signals)
    builder.ExportOutput(controller.GetOutputPort("tracking_error"), "tracking_error")

    # The view: the robot at its link positions, what it touches, the constraint forces.
    if isinstance(plant, RobotPlant):
        builder.ExportOutput(plant.GetOutputPort("link_state"), "link_state")
        if meshcat is not None:
            source = moving[0].get_output_port() if moving[0] is not None else None
            add_live_view(builder, plant, scene_graph, meshcat, source)

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


def _add_exogenous(
    builder: DiagramBuilder, block: ParameterizedSystem, exogenous: Sequence[Reference]
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


def _add_force_feedback(
    builder: DiagramBuilder,
    plant: DaePlant,
    controller: TrackingController,
    sensor: ForceSensor | None,
) -> RandomSource | None:
    """Connects the constraint force to the controller, through the sensor if there is one.

    Returns:
        The source of the sensor's noise, if it has one.
    """
    force, noise = plant.GetOutputPort("constraint_force"), None
    if sensor is None:
        control = plant.GetInputPort("control").get_index()
        if plant.HasDirectFeedthrough(control, force.get_index()):
            raise WiringError(
                "the constraint force depends on the control in the same instant, so a law that "
                "reads it closes an algebraic loop; pass a sensor=ForceSensor(...) with a "
                "time_constant or a sample_period"
            )
    else:
        measured = controller.law.measured_force
        gain = float(np.linalg.norm(measured.gain, 2)) if measured and force.size() else 0.0
        if gain >= sensor.largest_stable_gain():
            raise WiringError(
                f"the sampled force loop diverges: ||Gbar|| = {gain:.3g}, but each sample "
                "multiplies the force error by -Gbar; it must stay below "
                f"{sensor.largest_stable_gain():.3g}. Lower force_gain, or give the sensor a "
                "time_constant well above its sample_period"
            )
        _add(builder, sensor)
        builder.Connect(force, sensor.GetInputPort("force"))
        force = sensor.GetOutputPort("measured_force")
        if sensor.HasInputPort("noise"):
            size = sensor.GetInputPort("noise").size()
            period = sensor.sample_period or sensor.time_constant
            source = RandomSource(RandomDistribution.kGaussian, size, period)
            noise = builder.AddSystem(source)
            builder.Connect(noise.get_output_port(), sensor.GetInputPort("noise"))
    builder.Connect(force, controller.GetInputPort("measured_force"))
    return noise
