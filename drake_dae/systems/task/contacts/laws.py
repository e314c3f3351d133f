"""The laws of a task: two for each contact that opens and closes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from drake_dae.arguments import checked
from drake_dae.arrays import unknown_name
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.gains import GainDesign
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError
from drake_dae.systems.task.contacts.open_contact import (
    OpeningContact,
    open_contact,
    opened_contact,
    with_latch,
)
from drake_dae.systems.task.phases.plan import PhasePlan

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


def paired_laws(
    plan: PhasePlan, whole: DaeSystem, laws: Sequence[tuple[TrackingLaw, TrackingLaw]]
) -> tuple[ContactLaws, ...]:
    """The laws of each contact of a task, checked.

    Args:
        plan: The order of the phases.
        whole: The system with all constraints.
        laws: For each entry of `plan.pairs` the law in contact and the law without it.

    Raises:
        ModelError: There are too few or too many, or they do not fit together.
    """
    wanted, latches = plan.pairs, plan.latches
    if len(laws) != len(wanted):
        texts = [f"{name} beside {', '.join(sorted(closed))}" for name, closed in wanted]
        raise ModelError(
            f"the task needs the laws of {len(wanted)} contacts ({', '.join(texts)}), got "
            f"{len(laws)}"
        )
    if latches and any(law.integral.outputs for law, _ in laws):
        raise ModelError("a task with latches has laws without integrals of errors; leave them out")
    pairs, forces = [], [signal.name for signal in whole.force_signals]
    for closed_law, free_law in laws:
        contact = opened_contact(closed_law, free_law, bool(latches))
        own = closed_law.system.force_signals
        rows = tuple(forces.index(own[i].name) for i in contact.forces)
        pairs.append(ContactLaws(replace(contact, forces=rows), (free_law, closed_law)))
    return tuple(pairs)


@checked(ModelError)
def laws_of_latches(
    plan: PhasePlan,
    system: DaeSystem,
    gains: GainDesign,
    free_gains: GainDesign | None = None,
    latency: float = 0.0,
) -> tuple[tuple[TrackingLaw, TrackingLaw], ...]:
    """The laws of a task with latches: for each entry of `plan.pairs` (law, free_law).

    Args:
        plan: The order of its phases, `task.plan`.
        system: The system with the constraints of all latches, `RobotModel.dae` for example. Its
            outputs are positions, and as many constraint forces as each latch has. The forces of
            the latch "left" are "left.fx" and so on.
        gains: The gains of the laws that lead forces.
        free_gains: The gains of the laws that lead the distances of an open latch; `gains` if None.
        latency: That of `TrackingLaw`, in s.

    Raises:
        ModelError: There is no such latch, or it does not have as many forces.
        AssumptionError: A law is not defined while these latches are closed.
    """
    pairs = list[tuple[TrackingLaw, TrackingLaw]]()
    for number, (name, _) in enumerate(plan.pairs):
        led = latched_system(plan, system, number)
        free = open_contact(led, _forces_of(system)[name], is_latch=True)
        laws = ((led, gains), (free, free_gains or gains))
        closed_law, free_law = (TrackingLaw(each, g, latency=latency) for each, g in laws)
        pairs.append((closed_law, free_law))
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
