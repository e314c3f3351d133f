"""The one wiring: plant, reference, controller, loggers, and a view of the robot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams, Rgba, SceneGraph
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, TriggerType
from pydrake.systems.primitives import LogVectorOutput, RandomSource, VectorLogSink
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from drake_dae.arrays import FloatArray
from drake_dae.dae.references import Reference
from drake_dae.dae.signals import Signal
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.errors import DrakeDaeError, InconsistentStateError, ModelError, WiringError
from drake_dae.robots.links.multibody import MultibodyExpressions
from drake_dae.simulation.record import Record, Recorded
from drake_dae.simulation.view import (
    FRAME_RATE,
    ContactForceVisualizer,
    ContactPoints,
    draw_path,
    draw_surface,
    frame_times,
    scene_extent,
)
from drake_dae.systems.controller import TrackingController
from drake_dae.systems.plant import DaePlant
from drake_dae.systems.references import ReferenceGenerator
from drake_dae.systems.robot_plant import RobotPlant
from drake_dae.systems.sensors import ForceSensor

_ON_REQUEST = 1e9
"""A publish period so long that only a forced publish draws."""

_DESIRED, _ACTUAL = Rgba(0.1, 0.6, 0.2, 1.0), Rgba(0.1, 0.2, 0.8, 1.0)


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A plant that follows a reference under the law (28).

    Attributes:
        diagram: With the output ports `state`, `constraint_force`, `constraint_residual`,
            `controlled_output`, `control`, `reference` and `tracking_error`; `link_state` for a
            robot.
        plant, controller, reference: Its systems.
        loggers: Port name -> (sink, names and units), one sample per step.
        meshcat: Where the robot is drawn, or None.
        sensor: Of the constraint force, or None.
    """

    diagram: Diagram
    plant: DaePlant
    controller: TrackingController
    reference: ReferenceGenerator
    loggers: Mapping[str, tuple[VectorLogSink, Sequence[Signal]]]
    meshcat: Meshcat | None
    sensor: ForceSensor | None

    def __repr__(self) -> str:
        return f"ClosedLoop('{self.plant.dae.name}', logs {', '.join(self.loggers)})"

    def set_seed(self, context: Context, seed: int) -> None:
        """Chooses the noise of the sensor; without a call it is the same in every run.

        Args:
            context: Of the diagram.
            seed: Of the random numbers.
        """
        for system in self.diagram.GetSystems():
            if isinstance(system, RandomSource):
                own = system.GetMyMutableContextFromRoot(context)
                system.SetRandomContext(own, RandomGenerator(seed))

    def record(self, context: Context) -> Record:
        """What was logged up to now, with `desired_output` r and `tracking_error` z - r (29).

        Args:
            context: Of the diagram.
        """
        record = Record.from_logs(self.loggers, context)
        desired = record["reference"][:, self.controller.law.layout.lowest]
        outputs = record.signals["controlled_output"]
        derived = {
            "desired_output": Recorded(desired, outputs.signals),
            "tracking_error": Recorded(outputs.values - desired, outputs.signals),
        }
        return Record(record.time, {**record.signals, **derived})

    def predicted_error(self, record: Record) -> FloatArray:
        """The error (30), (31) that theory predicts for a record's start, shape (k, p)."""
        return self.controller.law.predicted_error(
            record.time - record.time[0], record["state"][0], record["reference"][0]
        )


def make_closed_loop(
    system: DaePlant,
    law: TrackingLaw,
    references: Sequence[Reference],
    *,
    sensor: ForceSensor | None = None,
    scene_graph: SceneGraph | None = None,
    meshcat: Meshcat | None = None,
    live: bool = True,
    start_time: float = 0.0,
) -> ClosedLoop:
    """Wires plant, reference generator and controller, with loggers and a view.

    Args:
        system: A `RobotPlant`, or any `DaePlant`.
        law: For a system of the same structure.
        references: Together one for each controlled output.
        sensor: Measures the constraint force for a law with measured force. Without one the force
            is connected as it is, where that closes no algebraic loop.
        scene_graph: Where the robot's MultibodyPlant was registered before it was parsed; then
            its geometry can be drawn. Left out where nothing is drawn.
        meshcat: Where to draw the surface, the contact force, and the robot if there is a
            scene_graph; None draws nothing.
        live: Draw while simulating, `FRAME_RATE` times a second; this shortens the integrator's
            steps. False draws only in `make_animation`.
        start_time: When a run begins, in s: the zero dynamics are judged at the references then.

    A loop that draws nothing and samples nothing converts to AutoDiffXd, for Drake's Linearize.

    Warns:
        NonMinimumPhaseWarning: As `TrackingController`.

    Raises:
        WiringError: A law or a sensor of sizes that are not the plant's; measured force that would
            close an algebraic loop, or a sampled loop that diverges; or a sensor that no law uses.
    """
    if not isinstance(system, DaePlant):
        raise WiringError(
            f"make_closed_loop needs a DaePlant or RobotPlant, got {type(system).__name__}"
        )
    _check_sizes(system, law, sensor)
    builder = DiagramBuilder()

    # The plant, its reference and its controller.
    plant = builder.AddSystem(system)
    reference = builder.AddSystem(ReferenceGenerator(references, law.degrees))
    try:
        outputs = law.layout.values(reference.reference(start_time))
    except DrakeDaeError:
        outputs = None  # A trajectory that begins later.
    controller = builder.AddSystem(TrackingController(law, outputs))
    builder.Connect(plant.GetOutputPort("state"), controller.GetInputPort("estimated_state"))
    builder.Connect(reference.GetOutputPort("reference"), controller.GetInputPort("reference"))
    builder.Connect(controller.GetOutputPort("control"), plant.GetInputPort("control"))

    if law.measured_force:
        _add_force_feedback(builder, plant, controller, sensor)
    elif sensor is not None:
        raise WiringError("the law takes no measured force; make it with measured_force=True")

    # Every signal under its own name: exported, and logged once per step.
    dae = plant.dae
    named = {
        "state": (plant, dae.state_signals),
        "constraint_force": (plant, dae.constraint_input_signals),
        "constraint_residual": (plant, plant.structure.manifold.residual_signals),
        "controlled_output": (plant, dae.output_signals),
        "control": (controller, dae.control_signals),
        "reference": (reference, law.reference_signals),
    }
    if law.measured_force and sensor is not None:
        named["measured_force"] = (sensor, dae.constraint_input_signals)
    loggers = {}
    for name, (owner, signals) in named.items():
        port = owner.GetOutputPort(name)
        builder.ExportOutput(port, name)
        loggers[name] = (LogVectorOutput(port, builder, {TriggerType.kPerStep}), signals)
    builder.ExportOutput(controller.GetOutputPort("tracking_error"), "tracking_error")

    # The view: the robot at its link positions, the surfaces, the contact forces.
    if isinstance(plant, RobotPlant):
        builder.ExportOutput(plant.GetOutputPort("link_state"), "link_state")
        if meshcat is not None:
            if scene_graph is not None:
                _add_geometry(builder, plant, scene_graph, meshcat, live)
            _add_contacts(builder, plant, meshcat, live)

    diagram = builder.Build()
    diagram.set_name("closed_loop")
    return ClosedLoop(diagram, plant, controller, reference, loggers, meshcat, sensor)


def _check_sizes(plant: DaePlant, law: TrackingLaw, sensor: ForceSensor | None) -> None:
    """Drake would name the ports, but not what is wrong with them."""
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
) -> None:
    """From the constraint force, through the sensor if there is one, to the controller."""
    force = plant.GetOutputPort("constraint_force")
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
        builder.AddSystem(sensor)
        builder.Connect(force, sensor.GetInputPort("force"))
        force = sensor.GetOutputPort("measured_force")
        if sensor.HasInputPort("noise"):
            size = sensor.GetInputPort("noise").size()
            period = sensor.sample_period or sensor.time_constant
            source = RandomSource(RandomDistribution.kGaussian, size, period)
            noise = builder.AddSystem(source)
            builder.Connect(noise.get_output_port(), sensor.GetInputPort("noise"))
    builder.Connect(force, controller.GetInputPort("measured_force"))


def make_animation(loop: ClosedLoop, record: Record, context: Context) -> str:
    """Replays a record of a robot in Meshcat, with the paths of the contact points.

    Args:
        loop: Made with a meshcat, for a `RobotPlant`.
        record: Of a run of this loop.
        context: Of its diagram, for the parameters; not changed.

    Returns:
        One HTML page that holds the scene and the animation.

    Raises:
        ModelError: There is no meshcat or no robot.
    """
    meshcat, plant = loop.meshcat, loop.plant
    if meshcat is None or not isinstance(plant, RobotPlant):
        raise ModelError("an animation needs a closed loop of a RobotPlant, made with a meshcat")
    parameters = plant.parameters(plant.GetMyContextFromRoot(context))
    points = ContactPoints(plant.model, parameters)

    # Between the steps the signals are drawn as straight lines.
    times = frame_times(record.time[-1] - record.time[0])
    states, forces, desired = (
        np.column_stack(
            [np.interp(times, record.time - record.time[0], column) for column in record[name].T]
        ).reshape(len(times), -1)
        for name in ("state", "constraint_force", "desired_output")
    )
    _draw_surfaces(meshcat, plant, points, states[0], parameters)
    _draw_paths(meshcat, plant, points, states, desired, parameters)

    # The robot and the arrows, frame by frame.
    replay = context.Clone()
    replayed = plant.GetMyMutableContextFromRoot(replay)
    systems = loop.diagram.GetSystems()
    robots = [system for system in systems if isinstance(system, MeshcatVisualizer)]
    (arrows,) = [system for system in systems if isinstance(system, ContactForceVisualizer)]
    arrows.largest_force = float(np.max(np.abs(forces), initial=1e-6))
    meshcat.StartRecording(frames_per_second=FRAME_RATE)
    for time, state, force in zip(times, states, forces, strict=True):
        replay.SetTime(time)
        plant.set_state(replayed, state)
        for robot in robots:
            robot.ForcedPublish(robot.GetMyContextFromRoot(replay))
        arrows.draw(state, force, time, points)
    meshcat.StopRecording()
    meshcat.PublishRecording()
    return meshcat.StaticHtml()


def _draw_surfaces(
    meshcat: Meshcat,
    plant: RobotPlant,
    points: ContactPoints,
    state: FloatArray,
    parameters: FloatArray,
) -> None:
    _, size = scene_extent(plant.model, state[: plant.model.links.q.numel()])
    for contact, center in zip(points.contacts, points(state)[0], strict=True):
        position = parameters[plant.dae.parameter_slice(f"{contact.name}.position")]
        draw_surface(meshcat, contact, position, center, size)


def _draw_paths(
    meshcat: Meshcat,
    plant: RobotPlant,
    points: ContactPoints,
    states: FloatArray,
    desired: FloatArray,
    parameters: FloatArray,
) -> None:
    """Where each contact point went, and where the reference wanted it."""
    model = plant.model
    guess = states[0, : model.links.q.numel()]
    configurations = []
    try:
        for row in desired[:, : len(model.position_signals)]:
            guess = model.configuration(row, guess, parameters)
            configurations.append(guess)
    except InconsistentStateError:
        pass  # The reference leaves what the robot can reach: its path ends there.
    for number, contact in enumerate(points.contacts):
        draw_path(meshcat, f"{contact.name}/actual", points.path(states, number), _ACTUAL, 4.0)
        if configurations:
            path = points.path(np.array(configurations), number)
            draw_path(meshcat, f"{contact.name}/desired", path, _DESIRED, 2.0)


def _add_geometry(
    builder: DiagramBuilder,
    plant: RobotPlant,
    scene_graph: SceneGraph,
    meshcat: Meshcat,
    live: bool,
) -> None:
    """Drake's own picture of the robot, posed by our link state; its plant is not simulated."""
    links = plant.model.links
    if not isinstance(links, MultibodyExpressions) or links.plant.get_source_id() is None:
        return
    builder.AddSystem(scene_graph)
    pose = builder.AddSystem(
        MultibodyPositionToGeometryPose(links.plant, input_multibody_state=True)
    )
    builder.Connect(plant.GetOutputPort("link_state"), pose.get_input_port())
    builder.Connect(
        pose.get_output_port(), scene_graph.get_source_pose_port(links.plant.get_source_id())
    )
    period = 1.0 / FRAME_RATE if live else _ON_REQUEST
    MeshcatVisualizer.AddToBuilder(
        builder, scene_graph, meshcat, MeshcatVisualizerParams(publish_period=period)
    )


def _add_contacts(builder: DiagramBuilder, plant: RobotPlant, meshcat: Meshcat, live: bool) -> None:
    model = plant.model
    state = plant.structure.manifold.project(model.dae.nominal_state)
    _draw_surfaces(meshcat, plant, ContactPoints(model), state, model.dae.parameter_values)
    # From behind, the side and a little above.
    middle, size = scene_extent(model, state[: model.links.q.numel()])
    meshcat.SetCameraPose(middle + size * np.array([-0.6, -0.85, 0.4]), middle)
    period = 1.0 / FRAME_RATE if live else None
    forces = builder.AddSystem(ContactForceVisualizer(meshcat, model, period, 0.2 * size))
    builder.Connect(plant.GetOutputPort("link_state"), forces.GetInputPort("link_state"))
    builder.Connect(
        plant.GetOutputPort("constraint_force"), forces.GetInputPort("constraint_force")
    )
