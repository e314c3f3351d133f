"""The references of each phase, which continue those of the phase before."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae.references import ConstantReference, Reference, stack_references
from drake_dae.dae.references.by_name import assigned, in_order
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError, ReferenceSignalError
from drake_dae.systems.control.phase_change import PhaseChange
from drake_dae.systems.task.contacts.laws import CONTACT, FREE, ContactLaws
from drake_dae.systems.task.contacts.open_contact import OpeningContact
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
        pairs: The laws of each contact with other closed ones; see `PhasePlan.pairs`.

    Attributes:
        goals: The references of each phase.
        rates: The final rates of all outputs in each phase, shape (p,).
        motion_functions: For each pair: (x, parameters) -> the distance and its derivative by the
            model, then all outputs in m including the distance, then their derivatives. Of several
            distances it has the mean, and of a latch the largest one.
        moved: The number of these outputs.
        controls: The index of the control that each phase measures, None for none; last None.

    Raises:
        ModelError: A phase has a reference that does not fit its law.
    """

    def __init__(self, task: Task, pairs: Sequence[ContactLaws]) -> None:
        self._task, self._pairs = task, pairs
        self._laws = [law for pair in pairs for law in pair.laws]
        self._phases = task.plan.phases
        self.goals, self.rates, self.controls = [], [], list[int | None]()
        for index in range(len(self._phases)):
            number = task.plan.law_of(index)
            contact, closed = pairs[number // 2].contact, number % 2 == CONTACT
            self.goals.append(_goals(task, index, self._laws[number], contact, closed))
            self.rates.append(_rates(task, index, self._laws[number], contact, closed))
            self.controls.append(_measured_control(task, index, self._laws[number]))
        self.controls.append(None)
        self._nothing = [_no_goals(law) for law in self._laws]
        self.motion_functions, self.moved = [], 0
        for pair in pairs:
            free, contact = pair.laws[FREE], pair.contact
            chains = free.structure.output_chains
            own = [
                ca.vertcat(*(chains[place][order] for place in contact.places)) for order in (0, 1)
            ]
            distance = [
                ca.norm_inf(part) if contact.is_latch else ca.sum1(part) / contact.size
                for part in own
            ]
            moved = [
                distance if place == contact.main else chains[place]
                for place, signal in enumerate(free.system.output_signals)
                if place == contact.main or (signal.unit == "m" and place not in contact.places)
            ]
            rows = [*distance, *(chain[0] for chain in moved), *(chain[1] for chain in moved)]
            function = free.system.trace("motion", {"value": ca.vertcat(*rows)})
            self.motion_functions.append(function)
            self.moved = len(moved)

    def motion(self, now: ModelMoment, law: int) -> tuple[float, float, FloatArray, FloatArray]:
        """The distance and its derivative, then all outputs in m and their derivatives.

        Args:
            now: The moment.
            law: The number of the law that acts.
        """
        function = self.motion_functions[law // 2]
        values = function.evaluate(now.state, now.parameters)[0].copy()
        first, rates = values[2 : 2 + self.moved], values[2 + self.moved :]
        return float(values[0]), float(values[1]), first, rates

    def first(self, now: ModelMoment) -> ReferenceSegment:
        """The references of the first phase, which start at the current outputs."""
        law, force = self._task.plan.law_of(0), 0.0
        contact = self._pairs[law // 2].contact
        if law % 2 == CONTACT and not contact.is_latch:
            force = self._task.contact_force
        moment = Moment(0.0, force, *self.motion(now, law)[:2], 0.0)
        present = self._met(now, law, moment, [0.0] * contact.size)
        return self._started(now, 0, self._name(0), law, BEGIN, moment, present)

    def following(
        self,
        now: ModelMoment,
        before: ReferenceSegment,
        moment: Moment,
        place: int | None,
        cause: PhaseCause,
        forces: Callable[[int], Sequence[float]],
    ) -> ReferenceSegment:
        """The references of the next phase, which continue those before.

        Args:
            now: The moment.
            before: The references before.
            moment: The measurements.
            place: The index of the next phase, the number of phases when the task is done; None if
                the robot rests for another reason.
            cause: The reason.
            forces: The number of a law -> the measured forces of its contact.
        """
        was, present = before.law, before.reference(now.time)
        end = len(self._phases)
        name = HELD if place is None else self._name(place)
        if place is None or place == end:  # The robot rests as it is: it touches, or is free.
            ends = cause.ends_in_contact
            is_closed = before.change.in_contact if ends is None else ends
            if not self._pairs[was // 2].contact.is_latch:
                is_closed = is_closed and moment.force >= self._task.contact_force
            law, place = was - was % 2 + int(is_closed), end
        else:
            law = self._task.plan.law_of(place)
        if law != was:
            old, present = present, self._met(now, law, moment, forces(law))
            places = {*self._pairs[law // 2].contact.places, *self._pairs[was // 2].contact.places}
            for i, first in enumerate(self._laws[law].layout.lowest):
                if i not in places:
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
            in_contact=number % 2 == CONTACT,
            reason=cause.reason,
            force=float(moment.force),
            distance=float(moment.distance),
            distance_rate=float(moment.rate),
            chosen=cause.chosen,
            failed=cause.failed,
            law=number,
            followed=self._followed(place, number),
        )
        origin = self.motion(now, number)[2]
        return ReferenceSegment.begin(
            change, law.layout, goals.function, goals.named, rate, present, over, origin
        )

    def _met(
        self, now: ModelMoment, number: int, moment: Moment, forces: Sequence[float]
    ) -> FloatArray:
        """R of a law from the current outputs, z_i, z_i', ...; zero for the highest derivatives.

        A force of degree 0 is the measured one, and moments of degree 0 are zero: from an even
        pressure on, all points of a face are pressed to the surface. All forces and moments of a
        latch are the measured ones.
        """
        law, contact = self._laws[number], self._pairs[number // 2].contact
        reference = np.zeros(law.layout.reference_size)
        coordinates = law.error_coordinates(now.state, reference, now.parameters)
        reference[law.layout.chained] = np.delete(coordinates, _integral_places(law))
        if number % 2 == CONTACT and law.degrees[contact.main] == 0:
            if contact.is_latch:
                reference[law.layout.lowest[list(contact.places)]] = forces
            else:
                reference[law.layout.lowest[contact.main]] = moment.force
        return reference

    def _followed(self, place: int, number: int) -> tuple[str, ...]:
        """The names of the contacts whose points draw the line that a phase finds."""
        if place >= len(self._phases) or not self._phases[place].finds_line:
            return ()
        signals = self._laws[number].system.force_signals
        return tuple(signals[i].name.split(".")[0] for i in self._pairs[number // 2].contact.forces)

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

    With a goal for the force of a face, its moments without goals go to zero; with one for the
    first of its distances, the others go to the same. So it is for a latch in phases that open or
    close it.
    """
    phase = task.plan.phases[index]
    names = [signal.name for signal in law.system.output_signals]
    assignments, degrees = [], law.degrees
    goals = phase.goals_of_latch if contact.is_latch else phase.goals
    for name, reference in goals(names[contact.main]).items():
        try:
            assignments.append(assigned(name, reference, names, degrees))
        except ReferenceSignalError as error:
            raise ModelError(f"{task.plan.where(index)}: reference '{name}': {error}") from error
    named = tuple(i for assignment in assignments for i in assignment.places)
    leads_all = not contact.is_latch or phase.ends_in_contact is not None
    for assignment in [a for a in assignments if leads_all and list(a.places) == [contact.main]]:
        for place in contact.others:
            if place not in named:
                reference = ConstantReference(0.0) if closed else assignment.reference
                assignments.append(assigned(names[place], reference, names, degrees))
                named += (place,)
    rest = [name for i, name in enumerate(names) if i not in named]
    assignments += [assigned(name, ConstantReference(0.0), names, degrees) for name in rest]
    try:
        references = tuple(in_order(assignments, names))
        here = () if phase.is_relative else named
        return PhaseReferences(stack_references(references, degrees), here, references)
    except ReferenceSignalError as error:
        raise ModelError(f"{task.plan.where(index)}: {error}") from error


def _rates(
    task: Task, index: int, law: TrackingLaw, contact: OpeningContact, closed: bool
) -> FloatArray:
    """The final rates of the outputs of a phase, shape (p,); those of all distances are equal."""
    signals, rates = law.system.output_signals, np.zeros(len(law.degrees))
    names = [signal.name for signal in signals]
    for name, rate in task.plan.phases[index].rates(names[contact.main]).items():
        if name not in names:
            text = unknown_name("output", name, names)
            raise ModelError(f"{task.plan.where(index)}: direction: {text}")
        if signals[names.index(name)].unit != "m":
            unit = signals[names.index(name)].unit or "1"
            raise ModelError(
                f"{task.plan.where(index)}: direction: '{name}' is in {unit}, and a move goes "
                "along outputs in m"
            )
        rates[names.index(name)] = rate
    if task.plan.phases[index].speed_of_approach and not rates[contact.main] < 0.0:
        raise ModelError(
            f"{task.plan.where(index)}: direction: it does not lead to the surface; give it a "
            f"negative component of '{names[contact.main]}'"
        )
    if not closed:
        rates[contact.others] = rates[contact.main]
    return rates


def _measured_control(task: Task, index: int, law: TrackingLaw) -> int | None:
    """The index of the control that a phase measures; None for none."""
    name = task.plan.phases[index].measured_control
    names = [signal.name for signal in law.system.control_signals]
    if name and name not in names:
        text = unknown_name("control", name, names)
        raise ModelError(f"{task.plan.where(index)}: {text}")
    return names.index(name) if name else None


def _no_goals(law: TrackingLaw) -> PhaseReferences:
    zero = np.zeros(law.layout.reference_size)
    return PhaseReferences(lambda time: zero, ())
