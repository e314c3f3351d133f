"""The references of each phase, which continue those of the phase before."""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError, ReferenceSignalError
from drake_dae.references import ConstantReference, Reference, stack_references
from drake_dae.references.by_name import assign, in_order
from drake_dae.systems.control.phase_change import PhaseChange
from drake_dae.systems.task.contacts.open_contact import (
    CONTACT,
    FREE,
    ContactLaws,
    OpeningContact,
)
from drake_dae.systems.task.phases import Moment
from drake_dae.systems.task.progress import DONE, HELD, ReferenceSegment
from drake_dae.systems.task.task import Task


@dataclass(frozen=True, eq=False)
class PhaseReferences:
    """The references of a phase for its law.

    Attributes:
        function: R as a function of the time in s since its start; zero for outputs without goals.
        named: The indices of the outputs with absolute goals.
        references: The references of all outputs, in their order.
    """

    function: Callable[[float], FloatArray]
    named: tuple[int, ...]
    references: tuple[Reference, ...] = ()


@dataclass(frozen=True, eq=False)
class ModelMoment:
    """Time, state and parameters of the laws' model at one moment of a run.

    Attributes:
        time: The time, in s.
        state: x, shape (n,).
        parameters: All parameters of the laws' system.
    """

    time: float
    state: FloatArray
    parameters: FloatArray


@dataclass(frozen=True)
class PhaseCause:
    """The reason for the start of a phase.

    Attributes:
        reason: The reason in words.
        chosen: The key word that led here: the name of a phase, "next", "stop" and so on.
        failed: Whether the phase before failed.
        ends_in_contact: Whether the phase before ended in contact; None for no change.
    """

    reason: str
    chosen: str = ""
    failed: bool = False
    ends_in_contact: bool | None = None


BEGIN = PhaseCause("the task begins")


class TaskPlanner:
    """Makes the references of each phase of a task.

    Args:
        task: The phases.
        pair: The laws of the task.

    Attributes:
        goals: The references of each phase.
        rates: The final rates of all outputs in each phase, shape (p,).
        motion_function: (x, parameters) -> the distance and its derivative by the model, then all
            outputs in m including the distance. Of several distances it has the mean.
        moved: The number of these outputs.
        control_places: Name of each control that a phase watches -> its index.

    Raises:
        ModelError: A phase has a reference that does not fit its law.
    """

    def __init__(self, task: Task, pair: ContactLaws) -> None:
        self._task, self._contact, self._laws = task, pair.contact, pair.laws
        self._phases = task.plan.phases
        self.goals, self.rates = [], []
        for index in range(len(self._phases)):
            closed = task.plan.contacts[index]
            law = pair.laws[int(closed)]
            self.goals.append(_goals(task, index, law, pair.contact, closed))
            self.rates.append(_rates(task, index, law, pair.contact, closed))
        self._nothing = [_no_goals(law) for law in pair.laws]
        free, contact = pair.laws[FREE], pair.contact
        chains = free.structure.output_chains
        distance = [
            sum((chains[place][order] for place in contact.places), ca.SX(0)) / contact.size
            for order in (0, 1)
        ]
        moved = [
            distance[0] if place == contact.main else chains[place][0]
            for place, signal in enumerate(free.system.output_signals)
            if place == contact.main or (signal.unit == "m" and place not in contact.places)
        ]
        self.motion_function = free.system.trace("motion", {"value": ca.vertcat(*distance, *moved)})
        self.moved = len(moved)
        names = [signal.name for signal in free.system.control_signals]
        for name in filter(None, task.controls):
            if name not in names:
                raise ModelError(f"condition of a control: {unknown_name('control', name, names)}")
        self.control_places = {name: names.index(name) for name in task.controls if name}

    def motion(self, now: ModelMoment) -> tuple[float, float, FloatArray]:
        """The distance and its derivative, then all outputs in m.

        Args:
            now: The moment.
        """
        values = self.motion_function.evaluate(now.state, now.parameters)[0].copy()
        return float(values[0]), float(values[1]), values[2:]

    def first(self, now: ModelMoment) -> ReferenceSegment:
        """The references of the first phase, which start at the current outputs."""
        closed = self._task.plan.contacts[0]
        force = self._task.contact_force if closed else 0.0
        moment = Moment(0.0, force, *self.motion(now)[:2], 0.0)
        present = self._met(now, int(closed), moment)
        return self._started(now, 0, self._name(0), int(closed), BEGIN, moment, present)

    def following(
        self,
        now: ModelMoment,
        before: ReferenceSegment,
        moment: Moment,
        place: int | None,
        cause: PhaseCause,
    ) -> ReferenceSegment:
        """The references of the next phase, which continue those before.

        Args:
            now: The moment.
            before: The references before.
            moment: The measurements.
            place: The index of the next phase, the number of phases when the task is done; None if
                the robot rests for another reason.
            cause: The reason.
        """
        was, present = before.law, before.reference(now.time)
        end = len(self._phases)
        name = HELD if place is None else self._name(place)
        if place is None or place == end:  # The robot rests as it is: it touches, or is free.
            ends = cause.ends_in_contact
            is_closed = before.change.in_contact if ends is None else ends
            is_closed = is_closed and moment.force >= self._task.contact_force
            law, place = int(is_closed), end
        else:
            law = int(self._task.plan.contacts[place])
        if law != was:
            old, present = present, self._met(now, law, moment)
            for i, first in enumerate(self._laws[law].layout.lowest):
                if i not in self._contact.places:
                    size, start = self._laws[law].degrees[i] + 1, before.layout.lowest[i]
                    present[first : first + size] = old[start : start + size]
        return self._started(now, place, name, law, cause, moment, present)

    def _started(
        self,
        now: ModelMoment,
        place: int,
        name: str,
        number: int,
        cause: PhaseCause,
        moment: Moment,
        present: FloatArray,
    ) -> ReferenceSegment:
        law, phases = self._laws[number], self._phases
        rate, over, goals = np.zeros(len(law.degrees)), phases[-1].over, self._nothing[number]
        if place < len(phases):
            over, goals, rate = phases[place].over, self.goals[place], self.rates[place]
        change = PhaseChange(
            time=float(now.time),
            phase=name,
            place=place,
            in_contact=number == CONTACT,
            reason=cause.reason,
            force=float(moment.force),
            distance=float(moment.distance),
            distance_rate=float(moment.rate),
            chosen=cause.chosen,
            failed=cause.failed,
        )
        origin = self.motion(now)[2]
        return ReferenceSegment.begin(
            change, law.layout, goals.function, goals.named, rate, present, over, origin
        )

    def _met(self, now: ModelMoment, number: int, moment: Moment) -> FloatArray:
        """R of a law from the current outputs, z_i, z_i', ...; zero for the highest derivatives.

        A force of degree 0 is the measured one, and differences of forces of degree 0 are zero:
        from an even pressure on, all points are pressed to the surface.
        """
        law, main = self._laws[number], self._contact.main
        reference = np.zeros(law.layout.reference_size)
        coordinates = law.error_coordinates(now.state, reference, now.parameters)
        reference[law.layout.chained] = np.delete(coordinates, _integral_places(law))
        if number == CONTACT and law.degrees[main] == 0:
            reference[law.layout.lowest[main]] = moment.force
        return reference

    def _name(self, place: int) -> str:
        return self._phases[place].name if place < len(self._phases) else DONE


def _integral_places(law: TrackingLaw) -> list[int]:
    """The indices of integrals among the error coordinates."""
    places, place = [], 0
    for i, degree in enumerate(law.degrees):
        if i in law.integral.outputs:
            places.append(place)
            place += 1
        place += degree
    return places


def _goals(
    task: Task, index: int, law: TrackingLaw, contact: OpeningContact, closed: bool
) -> PhaseReferences:
    """The references of a phase.

    With a goal for the force of several points, their differences of forces without goals go to
    zero; with one for the first of their distances, the others go to the same.
    """
    phase = task.plan.phases[index]
    names = [signal.name for signal in law.system.output_signals]
    assignments, degrees = [], law.degrees
    for name, reference in phase.goals(names[contact.main]).items():
        try:
            assignments.append(assign(name, reference, names, degrees))
        except ReferenceSignalError as error:
            raise ModelError(f"{task.plan.where(index)}: reference '{name}': {error}") from error
    named = tuple(i for assignment in assignments for i in assignment.places)
    for assignment in [a for a in assignments if list(a.places) == [contact.main]]:
        for place in contact.others:
            if place not in named:
                reference = ConstantReference(0.0) if closed else assignment.reference
                assignments.append(assign(names[place], reference, names, degrees))
                named += (place,)
    rest = [name for i, name in enumerate(names) if i not in named]
    assignments += [assign(name, ConstantReference(0.0), names, degrees) for name in rest]
    try:
        references = tuple(in_order(assignments, names))
        return PhaseReferences(stack_references(references, degrees), named, references)
    except ReferenceSignalError as error:
        raise ModelError(f"{task.plan.where(index)}: {error}") from error


def _rates(
    task: Task, index: int, law: TrackingLaw, contact: OpeningContact, closed: bool
) -> FloatArray:
    """The final rates of the outputs of a phase, shape (p,); those of all distances are equal."""
    names, rates = [s.name for s in law.system.output_signals], np.zeros(len(law.degrees))
    for name, rate in task.plan.phases[index].rates(names[contact.main]).items():
        if name not in names:
            raise ModelError(f"{task.plan.where(index)}: {unknown_name('output', name, names)}")
        rates[names.index(name)] = rate
    if not closed:
        rates[contact.others] = rates[contact.main]
    return rates


def _no_goals(law: TrackingLaw) -> PhaseReferences:
    zero = np.zeros(law.layout.reference_size)
    return PhaseReferences(lambda time: zero, ())
