"""The laws of a task: two for each contact that opens and closes."""

from collections.abc import Sequence
from dataclasses import dataclass

from drake_dae.arguments import checked
from drake_dae.arrays import unknown_name
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.gains import GainDesign
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.task.open_contact import OpeningContact, open_contact, with_latch
from drake_dae.systems.task.phases.plan import PhasePlan
from drake_dae.systems.task.task import Task

FREE, CONTACT = 0, 1
"""The indices of the two laws of a contact. The laws of all contacts are numbered in this order."""


@dataclass(frozen=True, eq=False)
class ContactLaws:
    """The laws of a robot while one contact opens and closes, and the others stay as they are.

    Attributes:
        contact: The contact.
        laws: The law while it is open, and the law while it is closed.
    """

    contact: OpeningContact
    laws: tuple[TrackingLaw, TrackingLaw]


def law_name(which: int, kind: str) -> str:
    """The name of a port or block of a law, by the number of the law: contact_reference."""
    number = f"_{which // 2 + 1}" if which // 2 else ""
    return f"{('free', 'contact')[which % 2]}_{kind}{number}"


class OutputColumns:
    """The places of the outputs of all laws of a task in its record.

    First the outputs of the first law in contact, then the distances of its contact; then forces
    and distances of each further latch.

    Args:
        pairs: The laws of the task.

    Attributes:
        size: The number of all outputs.
        forces, distances: For each pair, the columns with the forces and distances of its contact.
    """

    def __init__(self, pairs: Sequence[ContactLaws]) -> None:
        self._pairs, self.size = pairs, pairs[0].laws[0].system.num_outputs
        known = dict[tuple[int, ...], tuple[list[int], list[int]]]()
        for pair in pairs:
            contact = pair.contact
            if contact.forces in known:
                continue
            forces = list(contact.places)
            if known:
                forces = [self.size + i for i in range(contact.size)]
                self.size += contact.size
            known[contact.forces] = forces, [self.size + i for i in range(contact.size)]
            self.size += contact.size
        self.forces, self.distances = zip(*(known[p.contact.forces] for p in pairs), strict=True)

    def of_law(self, law: int) -> list[int]:
        """The columns of the outputs of a law, by its number."""
        pair = law // 2
        columns = list(range(self._pairs[0].laws[0].system.num_outputs))
        own = self.forces[pair] if law % 2 else self.distances[pair]
        for place, column in zip(self._pairs[pair].contact.places, own, strict=True):
            columns[place] = column
        return columns


@checked(ModelError)
def laws_of_latches(
    task: Task, system: DaeSystem, gains: GainDesign, free_gains: GainDesign | None = None
) -> tuple[tuple[TrackingLaw, TrackingLaw], ...]:
    """The laws of a task with latches: for each entry of `task.plan.pairs` (law, free_law).

    Args:
        task: The task.
        system: The system with the constraints of all latches, `RobotModel.dae` for example. Its
            outputs are positions, and as many constraint forces as each latch has. The forces of
            the latch "left" are "left.fx" and so on.
        gains: The gains of the laws that lead forces.
        free_gains: The gains of the laws that lead the distances of an open latch; `gains` if None.

    Raises:
        ModelError: There is no such latch, or it does not have as many forces.
        AssumptionError: A law is not defined while these latches are closed.
    """
    pairs = list[tuple[TrackingLaw, TrackingLaw]]()
    for number, (name, _) in enumerate(task.plan.pairs):
        led = latched_system(task.plan, system, number)
        free = open_contact(led, _forces_of(system)[name], is_latch=True)
        pairs.append((TrackingLaw(led, gains), TrackingLaw(free, free_gains or gains)))
    return tuple(pairs)


def latched_system(plan: PhasePlan, system: DaeSystem, number: int) -> DaeSystem:
    """The system in which the forces of a latch are outputs, by the number of its pair.

    Args:
        plan: The order of the phases.
        system: As of `laws_of_latches`.
        number: The index in `plan.pairs`.

    Raises:
        ModelError: There is no such latch, or it does not have as many forces.
    """
    forces, (name, others) = _forces_of(system), plan.pairs[number]
    for latch in plan.latches:
        if latch not in forces:
            raise ModelError(f"{system.name}: {unknown_name('latch', latch, forces)}")
    is_open = set(plan.latches) - others - {name}
    closed = [force for owner, own in forces.items() if owner not in is_open for force in own]
    return with_latch(system, forces[name], closed)


def _forces_of(system: DaeSystem) -> dict[str, list[str]]:
    """Name of a constraint -> the names of its forces."""
    forces = dict[str, list[str]]()
    for signal in system.force_signals:
        forces.setdefault(signal.name.split(".")[0], []).append(signal.name)
    return forces
