"""A task as a controller: the law in contact, the law of the free robot, and the phases."""

from collections.abc import Callable, Mapping, Sequence
from math import inf

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, vector
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.dae import ConstraintStructure, Signal, TrackingLaw, ZeroDynamics
from drake_dae.errors import ModelError, WiringError
from drake_dae.systems.automaton import (
    ALL_DONE,
    BEGUN,
    CHANGE,
    GIVEN_UP,
    GUARD,
    LATE,
    LOST,
    SUCCESS,
    Automaton,
)
from drake_dae.systems.controller import Compared, Controller, Derived, PhaseChange, check_law
from drake_dae.systems.plant import ParameterizedSystem, Plant
from drake_dae.systems.task import Task, opening_contact


@checked(ModelError)
class TaskController(ParameterizedSystem, Controller):
    """A task in phases: approach, touch, press, move, release, retreat.

    In contact, the law (28) of the robot with the contact is active and tracks the contact force;
    otherwise the law of the robot without it, which tracks the distance in place of the force. A
    phase ends at a sample; see `Phase`. The control may jump when the law changes, by
    lambda (A M [P; J]^-1 (0, 1) - J^T) at a frictionless touch where the free law presses with
    lambda; P is the Jacobian of the other outputs. A slow touch keeps it small.

    Input ports:
        estimated_state: x, shape (n,).
        measured_force: All constraint forces, shape (m,). The control does not depend on it in the
            same instant, unless a law takes a measured force.
        exogenous: The exogenous signals of the laws with their derivatives.
        hold: While it is not 0, no integral is updated, shape (1,); 0 without a wire.
        signal_<name>: A signal that phases wait for, shape (1,); 0 without a wire.

    Output ports:
        control: u, shape (p,).
        phase: The index of the phase in the task; after the last one their number.
        ending: 0 while the task goes on; 1 when it is done; 2 when the robot rests by "hold" or
            "leave" after a success, 3 when the task is given up.
        desired_output: The desired outputs of `law`, and then the distance, shape (p + 1,). In
            contact the distance is zero, otherwise the force.
        contact_reference: R of the law in contact while it is active, otherwise 0, as before the
            first sample; for an observer.
        tared_force: The measured forces minus the bias of the sensor; only with a tare_time.
        change: The last change of phase, `CHANGE`.
        integral, free_integral: The integrals of each law, if it has any. They are not updated
            while the other law is active, no force is measured, or just after a touch.

    `law` acts in contact, with the force among its outputs. `free_law` is for
    `open_contact(law.system, "wall.force")`.
    """

    __slots__ = SHARED_DICTIONARY
    takes_over, shown = True, ("phase", "ending", "contact_reference")

    def __init__(
        self, task: Task, law: TrackingLaw, free_law: TrackingLaw, *, sample_period: float = 1e-3
    ) -> None:
        if not 0.0 < sample_period < inf:
            raise ModelError(f"sample_period must be positive, got {sample_period:g} s")
        self.task, self.law, self.free_law = task, law, free_law
        self.phase_names = (*(phase.name for phase in task.all_phases), "end")
        self.sample_period = sample_period
        contact, system = opening_contact(law, free_law), law.system
        distance = system.constraint_output_signals[contact[1]]
        self.output_signals = (*system.output_signals, distance)
        # The columns of the distance and of its derivative in constraint_residual.
        first = sum(law.structure.constraint_degrees[: contact[1]])
        self._motion = [first, first + 1]
        block = Automaton(task, contact, (free_law, law), sample_period).block()
        super().__init__(system, block, law.exogenous_degrees, sees_steps=True)

    @checked(ModelError)
    def rest_state(
        self, outputs: ArrayLike, guess: ArrayLike, parameters: ArrayLike | None = None
    ) -> FloatArray:
        """The state of the free robot at rest near a guess, with these outputs of the free law."""
        law = self.free_law
        goal = np.zeros(law.layout.reference_size)
        goal[law.layout.lowest] = vector(f"{self.get_name()}: outputs", outputs, len(law.degrees))
        values = law.system.parameter_vector(parameters)
        return ZeroDynamics(law.system, structure=law.structure).state(goal, guess, values)

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        named = {"change": CHANGE, "desired_output": self.output_signals}
        for name, law in (("integral", self.law), ("free_integral", self.free_law)):
            if law.integral.outputs:
                named[name] = law.integral.signals
        return named

    @property
    def start_structure(self) -> ConstraintStructure:
        return (self.law if self.task.contacts[0] else self.free_law).structure

    def all_parameters(self, context: Context) -> FloatArray:
        self.check_context(context)
        return np.array(self._values(context)[: self.law.all_parameters().size])

    def check_plant(self, plant: Plant) -> None:
        check_law(plant.dae, self.law)
        if plant.is_ideal:
            raise WiringError(
                "a task needs a contact that opens, and constraints of this plant hold exactly: "
                "take a CompliantPlant or a ContactPlant (in a scenario: plant: !CompliantContact)"
            )

    def _outputs(self, outputs: FloatArray, residual: FloatArray) -> FloatArray:
        """Those of the law in contact, then the distance."""
        return np.concatenate([outputs, residual[..., self._motion[:1]]], axis=-1)

    def derived(self, values: Mapping[str, FloatArray]) -> Derived:
        """Outputs include the distance; "phase" is 1 for the current one, else 0."""
        signals, residual = self.output_signals, values["constraint_residual"]
        outputs = self._outputs(values["controlled_output"], residual)
        motion = signals[-1], signals[-1].derivative(1)
        *names, end = self.phase_names
        phases = (*(Signal(f"{i + 1} {name}") for i, name in enumerate(names)), Signal(end))
        places = values["change"][..., 1:2].astype(int)
        return {
            "phase": ((places == np.arange(len(phases))).astype(float), phases),
            "distance": (residual[..., self._motion], motion),
            "controlled_output": (outputs, signals),
            "tracking_error": (outputs - values["desired_output"], signals),
        }

    def compared(self, context: Context, shown: Callable[[str], FloatArray]) -> Compared:
        outputs = self._outputs(shown("controlled_output"), shown("constraint_residual"))
        return outputs, self.GetOutputPort("desired_output").Eval(context), self.output_signals

    def predicted_error(
        self, times: FloatArray, values: Mapping[str, FloatArray], parameters: FloatArray
    ) -> FloatArray:
        """Zero: the references of each phase begin as those before it end."""
        return np.zeros((times.size, len(self.output_signals)))

    def changes(self, values: Mapping[str, FloatArray]) -> tuple[PhaseChange, ...]:
        task, rows, changes = self.task, values["change"], list[PhaseChange]()
        end = len(task.all_phases)
        # Those between two samples of the record are left out.
        first = np.unique(rows[:, 0], return_index=True)[1]
        for row in rows[first].tolist():
            number, place, is_closed, start, cause, force, distance, rate, ending, before = row
            if not number:
                continue  # The task has not begun.
            at = int(place)
            rests = "done" if ending == ALL_DONE else "held"
            name = task.all_phases[at].name if at < end else rests
            failed = ending == GIVEN_UP if at == end else cause > SUCCESS
            lasted = f" {start - changes[-1].time:.4g} s" if changes else ""
            reason = _reason(task, int(before), int(cause), lasted)
            again = sum(change.place == at for change in changes)
            if again and at < end:
                reason += f", retry {again} of {task.retries_of(at)}"
            motion = force, distance, rate
            changes.append(PhaseChange(start, name, at, bool(is_closed), reason, *motion, failed))
        return tuple(changes)


def _reason(task: Task, place: int, cause: int, lasted: str) -> str:
    """Why a phase ended, after it lasted so long."""
    if cause == BEGUN:
        return "the task begins"
    if place == len(task.all_phases):
        return "the contact is lost at rest"
    phase = task.all_phases[place]
    awaits = phase.awaits(task.contact_force)
    if cause == SUCCESS:
        return f"after {awaits}"
    if cause == LATE:
        return f"{phase.name} has waited{lasted} for {awaits}"
    if cause == LOST:
        return f"the contact of {phase.name} is lost"
    return f"{phase.name} is ended by {phase.guards[cause - GUARD]}"
