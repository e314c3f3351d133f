"""A task as a controller: the law in contact, the law of the free robot, and a supervisor."""

from collections.abc import Callable, Mapping, Sequence
from math import inf

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import MatrixGain

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, vector
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.dae.zero_dynamics.zero_dynamics import ZeroDynamics
from drake_dae.errors import ModelError, WiringError
from drake_dae.systems.control.contract import Compared, Controller, Derived, check_same_sizes
from drake_dae.systems.control.controller import TrackingController
from drake_dae.systems.control.phase_change import PhaseChange
from drake_dae.systems.control.switch import LawSwitch
from drake_dae.systems.parameterized import function_along
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.task.contacts.open_contact import CONTACT, FREE, LAWS, contact_laws
from drake_dae.systems.task.contacts.outputs import TaskOutputs
from drake_dae.systems.task.progress import ReferenceSegment, places_at
from drake_dae.systems.task.supervisor import TaskSupervisor
from drake_dae.systems.task.task import Task


@checked(ModelError)
class TaskController(Diagram, Controller):
    """A task in phases: approach, touch, press, move, release, retreat.

    In contact, the law (28) of the robot with the contact is active and tracks the contact force;
    otherwise the law of the robot without it, which tracks the distance in place of the force. Each
    phase has goals, and ends by the measured force, the distance by the model or the time. The
    references of a phase start with the values and all derivatives of those before, and go to its
    goals by a polynomial; a reference that did not exist before, such as the force after a touch,
    starts at the measured value.

    The control may jump when the law changes, since both laws explain the same motion by different
    forces. When a robot touches a frictionless surface and the free law presses with lambda, that
    is, it commands phi'' = w = -A lambda there, the jump is

        B (u_c - u_f) = lambda (A M [P; J]^-1 (0, 1) - J^T),

    where P is the Jacobian of the other outputs. It is zero if pressing moves none of them, P M^-1
    J^T = 0. At a release lambda is at most the task's `contact_force`, and the jump is J^T lambda.
    A slow touch, and small gains of the free law for the distance, keep the first jump small.

    Of a plant it needs only the state x and the measured constraint forces. If the laws are for a
    system with a disturbance, one observer serves both, since its equation contains the measured
    force and so holds for closed and open contacts. Guards are evaluated at samples. The whole
    history of a run is in its context.

    Input ports:
        estimated_state: x, shape (n,).
        measured_force: All constraint forces, shape (m,). The control does not depend on it in the
            same instant, unless a law takes a measured force.
        exogenous: The exogenous signals of the laws with their derivatives, as of a surface that
            moves, or an observer's estimates; see `ParameterizedSystem`.
        hold: While it is not 0, no integral is updated, shape (1,); 0 without a wire.
        signal_<name>: A signal that phases wait for, shape (1,); it is present above 1/2. 0 without
            a wire.

    Output ports:
        control: u, shape (p,).
        phase: The index of the phase in the task, shape (1,); after the last one their number.
        ending: 0 while the task goes on, then how it has ended, shape (1,); see `TaskSupervisor`.
        desired_output: The desired positions, forces and distances, shape (p + k,) for a contact
            of k points. In contact the distances are zero, otherwise the forces.
        contact_reference: R of the law in contact while it is active, otherwise 0; for an observer.
        tared_force: The measured forces minus the bias of the sensor; only with a tare_time.
        integral, free_integral: The integrals of each law, if it has any. They are not updated
            while the other law is active; those in contact also not while no force is measured, and
            during the transition after a touch, so that the force of an impact is not integrated.

    Args:
        task: The phases.
        law: The law in contact. Its force, "wall.force" for example, is one of its outputs. A
            contact may have several points, which open and close together: then as many outputs
            are forces, one of them their sum.
        free_law: The law of the free robot, for `open_contact(law.system, "wall.force")`.
        sample_period: The period of guards and integrals of errors, in s.

    Attributes:
        task, law, free_law, sample_period: The arguments.
        supervisor, controller: Blocks in it: the latter has the first law in contact.
        contact: The contact that opens and closes.
        columns: The places of the outputs of both laws in a record.
        output_signals: Names and units of `desired_output`.
        outputs: (x, lambda, parameters) -> the outputs, in the order of `desired_output`, and the
            derivatives of the distances, shape (p + 2 k,) for a contact of k points.

    Raises:
        ModelError: The laws do not belong together, or a phase has a reference that does not fit.
    """

    __slots__ = SHARED_DICTIONARY
    takes_over, shown = True, ("desired_output", "ending")

    def __init__(
        self,
        task: Task,
        law: TrackingLaw,
        free_law: TrackingLaw,
        *,
        sample_period: float,
    ) -> None:
        super().__init__()
        if not 0.0 < sample_period < inf:
            raise ModelError(
                f"sample_period must be positive, got {sample_period:g} s: contact may be lost and "
                "regained at any time, so that a task decides in samples (in a scenario: sampling)"
            )
        self.task, self.law, self.free_law = task, law, free_law
        self.phase_names = (*(phase.name for phase in task.plan.phases), "end")
        self.sample_period = sample_period
        pair = contact_laws(law, free_law)
        self.contact, self.columns = pair.contact, TaskOutputs(pair)
        self.outputs, self.output_signals = self.columns.function, self.columns.signals
        builder = DiagramBuilder()
        measured = law.system.num_constraints
        supervisor = TaskSupervisor(task, pair, self.columns, measured, sample_period)
        self.supervisor = builder.AddSystem(supervisor)
        for name in ("estimated_state", "measured_force", "hold"):
            builder.ExportInput(self.supervisor.GetInputPort(name), name)
        for port in self.supervisor.signal_ports.values():
            builder.ExportInput(port, port.get_name())
        names = [f"{name}_law" for name in LAWS]
        switch = builder.AddSystem(LawSwitch(law.system.num_controls, names))
        builder.Connect(self.supervisor.GetOutputPort("law"), switch.GetInputPort("law"))
        self.controllers = []
        for which, its_law in enumerate(pair.laws):
            controller = builder.AddSystem(TrackingController(its_law, sample_period=sample_period))
            controller.set_name(f"{LAWS[which]}_controller")
            builder.ConnectInput("estimated_state", controller.GetInputPort("estimated_state"))
            reference = self.supervisor.GetOutputPort(f"{LAWS[which]}_reference")
            builder.Connect(reference, controller.GetInputPort("reference"))
            if its_law.measured_force:
                measured = controller.GetInputPort("measured_force")
                if task.tare_time:
                    builder.Connect(self.supervisor.GetOutputPort("tared_force"), measured)
                else:
                    builder.ConnectInput("measured_force", measured)
            if its_law.exogenous_degrees:
                port = controller.GetInputPort("exogenous")
                if which == FREE:
                    builder.ExportInput(port, "exogenous")
                    if self.supervisor.HasInputPort("exogenous"):
                        builder.ConnectInput("exogenous", self.supervisor.GetInputPort("exogenous"))
                else:
                    builder.ConnectInput("exogenous", port)
            if count := len(its_law.integral.outputs):
                hold = builder.AddSystem(MatrixGain(np.ones((count, 1))))
                hold.set_name(f"{LAWS[which]}_hold")
                builder.Connect(
                    self.supervisor.GetOutputPort(f"{LAWS[which]}_hold"), hold.get_input_port()
                )
                builder.Connect(hold.get_output_port(), controller.GetInputPort("hold"))
                shown = "integral" if which == CONTACT else "free_integral"
                builder.ExportOutput(controller.GetOutputPort("integral"), shown)
            builder.Connect(controller.GetOutputPort("control"), switch.GetInputPort(names[which]))
            self.controllers.append(controller)
        self.controller = self.controllers[CONTACT]
        self.exogenous_layout = self.controller.exogenous_layout
        self.exogenous_places = self.controller.exogenous_places
        control = switch.GetOutputPort("control")
        builder.ExportOutput(control, "control")
        if task.controls:
            builder.Connect(control, self.supervisor.GetInputPort("control"))
        names = ["phase", "ending", "desired_output", "contact_reference"]
        for name in [*names, "tared_force"] if task.tare_time else names:
            builder.ExportOutput(self.supervisor.GetOutputPort(name), name)
        builder.BuildInto(self)
        self.set_name("task_controller")

    @checked(ModelError)
    def rest_state(
        self, outputs: ArrayLike, guess: ArrayLike, parameters: ArrayLike | None = None
    ) -> FloatArray:
        """The state of the free robot at rest with given outputs.

        Args:
            outputs: The outputs of the free law, shape (p,), with the distance in place of the
                force.
            guess: x near it, shape (n,).
            parameters: Values of all parameters of the law's system; the defaults if None.

        Raises:
            InconsistentStateError: None is found near the guess.
        """
        law = self.free_law
        goal = np.zeros(law.layout.reference_size)
        goal[law.layout.lowest] = vector(f"{self.get_name()}: outputs", outputs, len(law.degrees))
        values = law.system.parameter_vector(parameters)
        return ZeroDynamics(law.system, structure=law.structure).state(goal, guess, values)

    def changes(self, context: Context) -> tuple[PhaseChange, ...]:
        """The start of each phase of a run, with the reason; empty before a run.

        Args:
            context: The context of this system.
        """
        return tuple(segment.change for segment in self.segments(context))

    def segments(self, context: Context) -> tuple[ReferenceSegment, ...]:
        """The references of a run, one segment for each phase.

        Args:
            context: The context of this system.
        """
        return self.supervisor.progress(self.GetSubsystemContext(self.supervisor, context)).segments

    def desired_along(self, context: Context, times: ArrayLike) -> FloatArray:
        """The values of `desired_output` at times of a run, one row each.

        At the time of a change it is the value of the phase before.

        Args:
            context: The context of this system after the run.
            times: The times, in s, shape (k,).
        """
        moments, segments = vector("times", times, None), self.segments(context)
        if not segments:
            raise ModelError(f"{self.get_name()}: the task has not begun in this context")
        return np.array(
            [
                segments[i].desired(self.columns, time)
                for i, time in zip(places_at(segments, moments), moments, strict=True)
            ]
        ).reshape(moments.size, -1)

    @property
    def phase_signals(self) -> tuple[Signal, ...]:
        """The names of the phases in a record: "1 Approach", "2 Press", ..., "end"."""
        *names, end = self.phase_names
        return (*(Signal(f"{i + 1} {name}") for i, name in enumerate(names)), Signal(end))

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        named: dict[str, Sequence[Signal]] = {"phase": (Signal("phase"),)}
        for name, law in (("integral", self.law), ("free_integral", self.free_law)):
            if law.integral.outputs:
                named[name] = law.integral.signals
        return named

    @property
    def start_structure(self) -> ConstraintStructure:
        return (self.law if self.task.plan.contacts[0] else self.free_law).structure

    def all_parameters(self, context: Context) -> FloatArray:
        return self.controller.all_parameters(self.GetSubsystemContext(self.controller, context))

    def check_plant(self, plant: Plant) -> None:
        check_same_sizes(plant.dae, self.law.system, "task", "the laws for the plant's robot")
        if plant.is_ideal:
            raise WiringError(
                "a task needs a contact that opens, and constraints of this plant hold exactly: "
                "take a CompliantPlant or a ContactPlant (in a scenario: plant: !CompliantContact)"
            )

    def derived(
        self, context: Context | None, times: FloatArray, values: Mapping[str, FloatArray]
    ) -> Derived:
        """The signals of a task in a record.

        The outputs are the positions, the forces and the distances of the contact; in contact the
        desired distances are zero, otherwise the desired forces. "distance" has the distances, then
        their derivatives, and "phase" is 1 for the current phase and 0 for all others.
        """
        signals, columns = self.output_signals, self.columns
        every = function_along(self.outputs, {**values, "force": values["constraint_force"]})
        outputs, rates = every[:, : columns.size], every[:, columns.size :]
        own = [signals[column] for column in columns.distances]
        desired = np.zeros_like(outputs)
        if times.size and context is not None:  # A run that failed at its start has no segments.
            desired = self.desired_along(context, times)
        places = values["phase"].astype(int)
        names = self.phase_signals
        return {
            "phase": ((places == np.arange(len(names))).astype(float), names),
            "distance": (
                np.hstack([outputs[:, columns.distances], rates]),
                (*own, *(signal.derivative(1) for signal in own)),
            ),
            "controlled_output": (outputs, signals),
            "desired_output": (desired, signals),
            "tracking_error": (outputs - desired, signals),
        }

    def compared(self, context: Context, shown: Callable[[str], FloatArray]) -> Compared:
        parameters = self.controller.current_parameters(
            self.GetSubsystemContext(self.controller, context)
        )
        (outputs,) = self.outputs(shown("state"), shown("constraint_force"), parameters)
        desired = self.GetOutputPort("desired_output").Eval(context)
        return outputs[: self.columns.size], desired, self.output_signals

    def predicted_error(
        self, times: FloatArray, values: Mapping[str, FloatArray], parameters: FloatArray
    ) -> FloatArray:
        """Zero: the references of each phase begin as those before it end."""
        return np.zeros((times.size, self.columns.size))

    def set_parameter(self, context: Context, name: str, value: ArrayLike) -> None:
        """Changes a parameter of the laws' model in a context, as `TrackingController` does.

        Args:
            context: The context of this system.
            name: The name of the parameter.
            value: The new value, shape (k,), or a number for all entries.

        Raises:
            ModelError: No parameter has that name, or the value does not fit.
        """
        for controller in self.controllers:
            controller.set_parameter(
                self.GetMutableSubsystemContext(controller, context), name, value
            )
        values = self.controller.parameters(self.GetSubsystemContext(self.controller, context))
        supervisor_context = self.GetMutableSubsystemContext(self.supervisor, context)
        supervisor_context.get_mutable_numeric_parameter(0).SetFromVector(values)
