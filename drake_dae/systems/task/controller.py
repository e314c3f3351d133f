"""A task as a controller: a law for each member, and what leads from one to the other."""

from collections.abc import Callable, Mapping, Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import MatrixGain

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, vector
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.dae.zero_dynamics.zero_dynamics import ZeroDynamics
from drake_dae.errors import ModelError, WiringError
from drake_dae.systems.blocks.along import function_along
from drake_dae.systems.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.systems.control.contract import Compared, Controller, Derived, check_same_sizes
from drake_dae.systems.control.controller import TrackingController
from drake_dae.systems.control.phase_change import PhaseChange
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.task.open_contact import opened_contact
from drake_dae.systems.task.planner import CONTACT, FREE
from drake_dae.systems.task.prediction import predicted_errors
from drake_dae.systems.task.progress import ReferenceSegment, places_at
from drake_dae.systems.task.supervisor import TaskSupervisor
from drake_dae.systems.task.switch import LawSwitch
from drake_dae.systems.task.task import Task, check_sampled
from drake_dae.trace.functions import TracedFunction

_REFUSED = {
    "exogenous": "nothing may move in a task; leave it out",
    "tolerances": "the phases of a task have their own, and times to end within; leave it out",
}
"""What a task cannot be wired with, and why."""


@checked(ModelError)
class TaskController(Diagram, Controller):
    """A task in phases: approach, touch, press, move, release, retreat.

    In contact the law (28) of the robot with the contact acts, which tracks the contact's force;
    else that of the robot without it, which tracks the distance in its place. Each phase has goals
    and a guard that ends it, on what is measured: the force, the distance by the model, the time.
    A phase takes over without a bump: its references begin with the values of those before and with
    all derivatives that the law has, and lead to its goals by a polynomial. What has no reference
    before, as a force when the robot touches, begins with what is measured.

    The control itself may jump where the law changes, since the other law explains the same motion
    by other forces. Where a robot touches a surface without friction, and the free law presses with
    lambda, so that phi'' = w = -A lambda is what it wants there, it is

        B (u_c - u_f) = lambda (A M [P; J]^-1 (0, 1) - J^T),

    zero where pressing moves none of the other outputs, P M^-1 J^T = 0; P is the Jacobian of these.
    Where it lets go, lambda is the task's `contact_force` at most, and the jump is J^T lambda. A
    touch that is slow, and a free law that is soft along the distance, keep the first one small.

    It needs of a plant the state x and the constraint forces, as measured; no more. If the laws are
    for a system with a disturbance, one observer feeds both: with the measured force its equation
    holds for the closed and for the open contact. Guards are found by Drake's Simulator as zeros of
    a witness function, which needs a context with an accuracy as `simulate` sets it, or are looked
    at in samples. All that a run has done stands in its context.

    Input ports:
        estimated_state: x, shape (n,).
        measured_force: All constraint forces, shape (m,). The control does not depend on it in the
            same instant, unless a law takes a measured force.
        exogenous: Of an observer: the disturbance, and coefficients of friction; if the laws have
            them.
        hold: Where it is not 0, no integral is updated, shape (1,); may be without a wire.
        signal_<name>: For which phases wait, shape (1,); it has come where it is above 1/2. May be
            without a wire.

    Output ports:
        control: u, shape (p,).
        phase: The place of the phase in the task, shape (1,); the number of phases after the last.
        desired_output: The positions, the force and the distance that are wanted, shape (p + 1,).
            In contact the distance is zero, and else the force.
        contact_reference: R of the law in contact while that acts, and else 0: for an observer.
        tared_force: The measured forces less the bias that was found; with a tare_time.
        integral, free_integral: The integrals of each law, if it has any. They stand still while
            the other law acts, and those in contact also while no force is felt, and while the
            first references after a touch fade in: the force of an impact is no error.

    Args:
        task: The phases.
        law: The law in contact. Its force, "wall.force" for example, is one of its outputs.
        free_law: The law without: of `open_contact(law.system, "wall.force")`.
        sample_period: When guards are looked at and errors are summed, in s; 0 for at all times.

    Attributes:
        task, law, free_law, sample_period: The arguments.
        supervisor, controller, free_controller: The blocks in it.
        place: Which output is the force, or the distance.
        force: Which of the constraint forces is the contact's.
        output_signals: Names and units of `desired_output`.
        outputs: (x, lambda, parameters) -> the outputs, in the order of `desired_output`, and the
            derivative of the distance, shape (p + 2,).

    Raises:
        ModelError: The laws do not belong together, or a phase has a reference that does not fit.
    """

    __slots__ = SHARED_DICTIONARY
    takes_over, shown, refused = True, ("desired_output",), _REFUSED

    def __init__(
        self,
        task: Task,
        law: TrackingLaw,
        free_law: TrackingLaw,
        *,
        sample_period: float = 0.0,
    ) -> None:
        super().__init__()
        check_sampled(task, sample_period)
        self.task, self.law, self.free_law = task, law, free_law
        self.phase_ends = tuple(phase.signal for phase in task.plan.phases)
        self.sample_period = sample_period
        self.place, self.force = opened_contact(law, free_law)
        self.outputs = self._trace_outputs()
        distance = law.system.constraint_output_signals[self.force]
        self.output_signals = (*law.system.output_signals, distance)
        builder = DiagramBuilder()
        size = law.system.num_constraints
        self.supervisor = builder.AddSystem(
            TaskSupervisor(task, (free_law, law), self.place, self.force, size, sample_period)
        )
        builder.ExportInput(self.supervisor.GetInputPort("estimated_state"), "estimated_state")
        builder.ExportInput(self.supervisor.GetInputPort("measured_force"), "measured_force")
        builder.ExportInput(self.supervisor.GetInputPort("hold"), "hold")
        for port in self.supervisor.signal_ports.values():
            builder.ExportInput(port, port.get_name())
        switch = builder.AddSystem(LawSwitch(law.system.num_controls))
        in_contact = self.supervisor.GetOutputPort("in_contact")
        builder.Connect(in_contact, switch.GetInputPort("in_contact"))
        added = []
        for which, name, own in ((FREE, "free", free_law), (CONTACT, "contact", law)):
            controller = builder.AddSystem(TrackingController(own, sample_period=sample_period))
            controller.set_name(f"{name}_controller")
            builder.ConnectInput("estimated_state", controller.GetInputPort("estimated_state"))
            reference = self.supervisor.GetOutputPort(f"{name}_reference")
            builder.Connect(reference, controller.GetInputPort("reference"))
            if own.measured_force:
                measured = controller.GetInputPort("measured_force")
                if task.tare_time:
                    builder.Connect(self.supervisor.GetOutputPort("tared_force"), measured)
                else:
                    builder.ConnectInput("measured_force", measured)
            if own.exogenous_degrees:
                port = controller.GetInputPort("exogenous")
                if which == FREE:
                    builder.ExportInput(port, "exogenous")
                else:
                    builder.ConnectInput("exogenous", port)
            if count := len(own.integral.outputs):
                hold = builder.AddSystem(MatrixGain(np.ones((count, 1))))
                hold.set_name(f"{name}_hold")
                builder.Connect(
                    self.supervisor.GetOutputPort(f"{name}_hold"), hold.get_input_port()
                )
                builder.Connect(hold.get_output_port(), controller.GetInputPort("hold"))
                shown = "integral" if which == CONTACT else "free_integral"
                builder.ExportOutput(controller.GetOutputPort("integral"), shown)
            builder.Connect(controller.GetOutputPort("control"), switch.GetInputPort(name))
            added.append(controller)
        self.free_controller, self.controller = added
        builder.ExportOutput(switch.GetOutputPort("control"), "control")
        if task.watches("control"):
            watching = self.supervisor.GetInputPort("control")
            builder.Connect(switch.GetOutputPort("control"), watching)
        names = ["phase", "desired_output", "contact_reference"]
        for name in [*names, "tared_force"] if task.tare_time else names:
            builder.ExportOutput(self.supervisor.GetOutputPort(name), name)
        builder.BuildInto(self)
        self.set_name("task_controller")

    def _trace_outputs(self) -> TracedFunction:
        system, chain = self.law.system, self.free_law.structure.output_chains[self.place]
        force = ca.SX.sym("force", system.num_constraints)
        outputs = ca.vertcat(system.outputs(force), chain[0], chain[1])
        return system.trace("task outputs", {"value": ca.densify(outputs)}, {"force": force})

    def rest_state(
        self, outputs: ArrayLike, guess: ArrayLike, parameters: ArrayLike | None = None
    ) -> FloatArray:
        """The state at rest, of the free robot, with given outputs.

        Args:
            outputs: The outputs of the free law, shape (p,): the distance in place of the force.
            guess: x near it, shape (n,).
            parameters: Values of all parameters of the law's system; the defaults if None.

        Raises:
            InconsistentStateError: None is found near the guess.
        """
        law = self.free_law
        wanted = vector(f"{self.get_name()}: outputs", outputs, len(law.degrees))
        goal = np.zeros(law.layout.reference_size)
        goal[law.layout.lowest] = wanted
        values = law.system.parameter_vector(parameters)
        return ZeroDynamics(law.system, structure=law.structure).state(goal, guess, values)

    def changes(self, context: Context) -> tuple[PhaseChange, ...]:
        """The record of a run: when each phase began, and why; empty before a run.

        Args:
            context: The context of this system.
        """
        return tuple(segment.change for segment in self.segments(context))

    def segments(self, context: Context) -> tuple[ReferenceSegment, ...]:
        """The references of a run, from one change of phases to the next.

        Args:
            context: The context of this system.
        """
        own = self.GetSubsystemContext(self.supervisor, context)
        return self.supervisor.progress(own).segments

    def desired_along(self, context: Context, times: ArrayLike) -> FloatArray:
        """What was wanted at times of a run, in s, shape (k, p + 1), as `desired_output` was.

        At the moment of a change it is what was wanted before.

        Args:
            context: The context of this system after the run.
            times: The times, in s, shape (k,).
        """
        moments, segments = vector("times", times, None), self.segments(context)
        if not segments:
            raise ModelError(f"{self.get_name()}: the task has not begun in this context")
        return np.array(
            [
                self.supervisor.desired(segments[i], time)
                for i, time in zip(places_at(segments, moments), moments, strict=True)
            ]
        ).reshape(moments.size, -1)

    @property
    def phase_signals(self) -> tuple[Signal, ...]:
        """The names of the phases as a record has them: "1 Approach", "2 Press", ..., "end"."""
        names = [phase.name for phase in self.task.plan.phases]
        return (*(Signal(f"{i + 1} {name}") for i, name in enumerate(names)), Signal("end"))

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        named: dict[str, Sequence[Signal]] = {"phase": (Signal("phase"),)}
        for name, law in (("integral", self.law), ("free_integral", self.free_law)):
            if law.integral.outputs:
                named[name] = law.integral.signals
        return named

    @property
    def start_structure(self) -> ConstraintStructure:
        law = self.law if self.task.contacts[0] else self.free_law
        return law.structure

    def all_parameters(self, context: Context) -> FloatArray:
        return self.controller.all_parameters(self.GetSubsystemContext(self.controller, context))

    def check_plant(self, plant: Plant) -> None:
        system = self.law.system
        check_same_sizes(plant.dae, system, "task", "the laws for the plant's robot")
        if plant.time_step and not self.sample_period:
            raise WiringError(
                f"the plant steps by {plant.time_step:g} s, and its state jumps there: make the "
                f"controller with sample_period={plant.time_step:g} or a multiple of it"
            )
        if not (plant.time_step or plant.is_ideal or self.sample_period):
            raise WiringError(
                "a contact that gives way may be lost and found at any time, and a task that "
                "reacts at once may switch without end: make the controller with a sample_period "
                "(in a scenario: sampling)"
            )
        name = system.force_signals[self.force].name
        if plant.contacts and name.split(".")[0] not in plant.contacts:
            raise WiringError(
                f"the contact with the force '{name}' does not open in this plant; what does is "
                f"{', '.join(plant.contacts)}"
            )

    def derived(
        self, context: Context | None, times: FloatArray, values: Mapping[str, FloatArray]
    ) -> Derived:
        """What a record has of a task.

        The outputs are the positions, the force and the distance; in contact the distance that is
        wanted is zero, and else the force. "distance" has the distance and its derivative, "phase"
        1 for the phase that goes on and 0 for all others, "predicted_error" what theory says, see
        `predicted_errors`.
        """
        signals = self.output_signals
        given = {
            "state": values["state"],
            "force": values["constraint_force"],
            "parameters": values["parameters"],
        }
        found = function_along(self.outputs, given)
        outputs = found[:, :-1]
        desired = np.zeros_like(outputs)
        segments = () if context is None else self.segments(context)
        if times.size and context is not None:  # Not where a run failed before it began.
            desired = self.desired_along(context, times)
        places = values["phase"].astype(int)
        predicted = predicted_errors(
            (self.free_law, self.law), self.place, self.force, segments, times, values
        )
        names = self.phase_signals
        return {
            "phase": ((places == np.arange(len(names))).astype(float), names),
            "distance": (found[:, -2:], (signals[-1], signals[-1].derivative(1))),
            "controlled_output": (outputs, signals),
            "desired_output": (desired, signals),
            "tracking_error": (outputs - desired, signals),
            "predicted_error": (predicted, signals),
        }

    def compared(self, context: Context, shown: Callable[[str], FloatArray]) -> Compared:
        own = self.GetSubsystemContext(self.controller, context)
        parameters = self.controller.current_parameters(own)
        (found,) = self.outputs(shown("state"), shown("constraint_force"), parameters)
        desired = self.GetOutputPort("desired_output").Eval(context)
        return found[:-1], desired, self.output_signals

    def predicted_error(
        self, times: FloatArray, values: Mapping[str, FloatArray], parameters: FloatArray
    ) -> FloatArray:
        return values["predicted_error"]

    def set_parameter(self, context: Context, name: str, value: ArrayLike) -> None:
        """Changes a parameter of the laws' model in a context, as `TrackingController` does.

        Args:
            context: The context of this system.
            name: The name of the parameter.
            value: The new value, shape (k,), or a number for all entries.

        Raises:
            ModelError: No parameter has that name, or the value does not fit.
        """
        for controller in (self.controller, self.free_controller):
            own = self.GetMutableSubsystemContext(controller, context)
            controller.set_parameter(own, name, value)
        known = self.controller.parameters(self.GetSubsystemContext(self.controller, context))
        at_supervisor = self.GetMutableSubsystemContext(self.supervisor, context)
        at_supervisor.get_mutable_numeric_parameter(0).SetFromVector(known)
