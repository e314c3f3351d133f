"""The wiring of a task: a plant whose contact opens and closes, and its controller in phases."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import RandomSource, VectorLogSink

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.diagrams.force_feedback import add_force_feedback, seed_noise
from drake_dae.diagrams.unilateral import with_events
from drake_dae.diagrams.wiring import add_block, check_system, hold_before, log_steps
from drake_dae.errors import WiringError
from drake_dae.pictures.view import RobotBlock, add_live_view
from drake_dae.simulation.records.record import Record, Recorded
from drake_dae.systems.blocks.along import function_along
from drake_dae.systems.control.sampling import ControlHold, Sampling
from drake_dae.systems.plants.contact.contact_plant import ContactPlant
from drake_dae.systems.plants.robot_plant import RobotPlant
from drake_dae.systems.plants.unilateral.plant import UnilateralRobotPlant
from drake_dae.systems.sensing.force_sensor import ForceSensor
from drake_dae.systems.task.controller import TaskController
from drake_dae.systems.task.prediction import predicted_errors
from drake_dae.systems.task.progress import PhaseChange

Plant = UnilateralRobotPlant | ContactPlant | RobotPlant


@checked(WiringError)
@dataclass(frozen=True, eq=False)
class TaskLoop:
    """A plant under a `TaskController`.

    Attributes:
        diagram: The diagram, with the output ports `state`, `constraint_force`, `control`, `phase`
            and `desired_output`.
        plant, controller: The systems in it.
        loggers: Port name -> (sink, names and units), one sample per step.
        scene_graph: The geometry of the robot, or None.
        noise: The source of the sensor's noise, or None.
    """

    diagram: Diagram
    plant: Plant
    controller: TaskController
    loggers: Mapping[str, tuple[VectorLogSink, Sequence[Signal]]]
    scene_graph: SceneGraph | None = None
    noise: RandomSource | None = None

    def __repr__(self) -> str:
        return f"TaskLoop('{self.plant.dae.name}', {self.controller.task!r})"

    def set_seed(self, context: Context, seed: int) -> None:
        """Chooses the noise of the sensor, as `ClosedLoop.set_seed` does.

        Args:
            context: The diagram's context.
            seed: The seed of the random numbers.
        """
        seed_noise(self.noise, context, seed)

    def set_state(self, context: Context, state: ArrayLike) -> None:
        """Starts the robot at a state, shape (n,), in contact or not.

        Args:
            context: The diagram's context.
            state: x; `rest_state` makes one.

        Raises:
            ModelError: The shape is wrong.
        """
        own = self.plant.GetMyMutableContextFromRoot(context)
        self.plant.set_state(own, state)

    def changes(self, context: Context) -> tuple[PhaseChange, ...]:
        """When each phase of a run began, and why."""
        return self.controller.changes(self.controller.GetMyContextFromRoot(context))

    def record(self, context: Context, after: float | None = None) -> Record:
        """What was logged up to now, and what follows from it.

        The outputs are the positions, the force and the distance; in contact the distance that is
        wanted is zero, and else the force. "distance" has the distance and its derivative, "phase"
        1 for the phase that goes on and 0 for all others, "predicted_error" what theory says, see
        `predicted_errors`. At the moment of an impact or of a change of phases all is
        what was before.

        Args:
            context: The diagram's context.
            after: Only what was logged later than this time, in s; None for all.
        """
        logged = Record.from_logs(self.loggers, context, after)
        own, controller = self.controller.GetMyContextFromRoot(context), self.controller
        count = controller.law.system.parameter_values.size
        parameters = self.plant.parameters(self.plant.GetMyContextFromRoot(context))[:count]
        given = {
            "state": logged["state"],
            "force": logged["constraint_force"],
            "parameters": np.tile(parameters, (logged.time.size, 1)),
        }
        found = function_along(controller.outputs, given)
        outputs, signals = found[:, :-1], controller.output_signals
        desired = np.zeros_like(outputs)
        if logged.time.size:  # Not where a run failed before it began.
            desired = controller.desired_along(own, logged.time)
        places, names = logged["phase"].astype(int), self.phase_signals
        values = {name: recorded.values for name, recorded in logged.signals.items()}
        derived = {
            "phase": (places == np.arange(len(names))).astype(float),
            "distance": found[:, -2:],
            "controlled_output": outputs,
            "desired_output": desired,
            "tracking_error": outputs - desired,
            "predicted_error": predicted_errors(
                controller, controller.segments(own), logged.time, values
            ),
        }
        named = {
            "phase": names,
            "distance": (signals[-1], signals[-1].derivative(1)),
        }
        told = {n: Recorded(v, named.get(n, signals)) for n, v in derived.items()}
        record = Record(logged.time, {**logged.signals, **told}).while_finite()
        if isinstance(self.plant, UnilateralRobotPlant):
            return with_events(record, self.plant, context, after)
        return record

    @property
    def phase_signals(self) -> tuple[Signal, ...]:
        """The names of the phases as a record has them: "1 Approach", "2 Press", ..., "end"."""
        names = [phase.name for phase in self.controller.task.phases]
        return (*(Signal(f"{i + 1} {name}") for i, name in enumerate(names)), Signal("end"))

    def predicted_error(self, record: Record) -> FloatArray:
        """The error that theory predicts for a record of a run, shape (k, p + 1)."""
        return record["predicted_error"]


@checked(WiringError)
def make_task_loop(
    plant: Plant,
    controller: TaskController,
    *,
    sensor: ForceSensor | None = None,
    sampling: Sampling | None = None,
    scene_graph: SceneGraph | None = None,
    meshcat: Meshcat | None = None,
) -> TaskLoop:
    """Wires a plant and the controller of a task, with loggers.

    Args:
        plant: A `UnilateralRobotPlant` whose contact opens and closes, a `ContactPlant`, with which
            everything is logged at its steps, or a `RobotPlant`, for a task without Approach.
        controller: The controller; its laws are for the plant's robot.
        sensor: The sensor of the constraint forces. Without one they are measured as they are.
        sampling: When the control is computed and acts; it is held between. None for a controller
            that acts at all times, or, with a `ContactPlant`, at each of its steps.
        scene_graph: Where the robot's MultibodyPlant was registered before it was parsed; then its
            geometry can be drawn.
        meshcat: Where to draw while it runs; None draws nothing.

    Raises:
        WiringError: The controller's laws are for another robot, its guards would be looked at at
            all times where the plant has steps, or a law would close an algebraic loop.
    """
    _check(plant, controller)
    builder = DiagramBuilder()
    add_block(builder, plant)
    add_block(builder, controller)
    control = controller.GetOutputPort("control")
    if sampling is not None:
        hold = builder.AddSystem(ControlHold(control.size(), hold_before(plant, sampling)))
        builder.Connect(control, hold.get_input_port())
        control = hold.get_output_port()
    builder.Connect(control, plant.GetInputPort("control"))
    builder.Connect(plant.GetOutputPort("state"), controller.GetInputPort("estimated_state"))
    if sensor is not None:
        add_block(builder, sensor)
    noise = add_force_feedback(builder, plant, controller, sensor, sampling)
    loggers = {}
    for name, (port, signals) in _signals(plant, controller, control).items():
        builder.ExportOutput(port, name)
        loggers[name] = (log_steps(builder, port, plant), signals)
    builder.ExportOutput(controller.GetOutputPort("desired_output"), "desired_output")
    builder.ExportOutput(plant.GetOutputPort("link_state"), "link_state")
    if meshcat is not None and isinstance(plant, RobotBlock):
        add_live_view(builder, plant, scene_graph, meshcat)
    diagram = builder.Build()
    diagram.set_name("task_loop")
    return TaskLoop(diagram, plant, controller, loggers, scene_graph, noise)


def _signals(
    plant: Plant, controller: TaskController, control: OutputPort
) -> dict[str, tuple[OutputPort, Sequence[Signal]]]:
    """What is logged: the rest follows."""
    dae, law = plant.dae, controller.law
    named: dict[str, tuple[OutputPort, Sequence[Signal]]] = {
        name: (plant.GetOutputPort(name), signals)
        for name, signals in (
            ("state", dae.state_signals),
            ("constraint_force", dae.force_signals),
            ("constraint_residual", law.structure.manifold.residual_signals),
        )
    }
    named["control"] = (control, dae.control_signals)
    named["phase"] = (controller.GetOutputPort("phase"), (Signal("phase"),))
    if isinstance(plant, UnilateralRobotPlant):
        named["mode"] = (plant.GetOutputPort("mode"), plant.mode_signals)
        named["gap"] = (plant.GetOutputPort("gap"), plant.gap_signals)
    if isinstance(plant, ContactPlant):
        named["contact_force"] = (plant.GetOutputPort("contact_force"), plant.contact_force_signals)
    for name, one in (("integral", law), ("free_integral", controller.free_law)):
        if one.integral.outputs:
            named[name] = (controller.GetOutputPort(name), one.integral.signals)
    return named


def _check(plant: Plant, controller: TaskController) -> None:
    own, other = plant.dae, controller.law.system
    check_system(own, other, "task", "the laws for the plant's robot")
    if plant.time_step and not controller.sample_period:
        raise WiringError(
            f"the plant steps by {plant.time_step:g} s, and its state jumps there: make the "
            f"controller with sample_period={plant.time_step:g} or a multiple of it"
        )
    name = other.force_signals[controller.force].name
    if isinstance(plant, UnilateralRobotPlant) and name.split(".")[0] not in plant.contacts:
        raise WiringError(
            f"the contact with the force '{name}' does not open in this plant; what does is "
            f"{', '.join(plant.contacts)}"
        )
