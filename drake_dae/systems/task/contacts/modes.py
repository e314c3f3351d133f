"""The closed contacts of a task in each of its phases."""

from collections.abc import Sequence
from dataclasses import dataclass

from drake_dae.systems.task.phases.phase import Phase


@dataclass(frozen=True)
class ContactMode:
    """The closed contacts of a task, and the one that it leads.

    Attributes:
        contact: The name of the contact that opens and closes; empty in a task with one contact.
        is_closed: Whether this contact is closed.
        others: The names of the other latches that are closed.
    """

    contact: str
    is_closed: bool
    others: frozenset[str] = frozenset()

    @property
    def closed(self) -> frozenset[str]:
        """The names of all closed contacts."""
        return self.others | {self.contact} if self.is_closed else self.others


def modes_of(phases: Sequence[Phase]) -> tuple[ContactMode, ...]:
    """The mode in which each phase begins; last the mode in which the last one ends.

    A contact is closed at the start if the first phase that opens, closes or needs it says so.
    """
    names, name = list[str](), ""
    for phase in phases:
        name = phase.contact or name
        names.append(name)
    closed, known = set[str](), set[str]()
    for name, phase in zip(names, phases, strict=True):
        if phase.begins_in_contact is not None and name not in known:
            known.add(name)
            closed |= {name} if phase.begins_in_contact else set()
    modes = []

    def add(name: str, says: bool | None) -> None:
        if says is not None:
            (closed.add if says else closed.discard)(name)

    for name, phase in zip(names, phases, strict=True):
        add(name, phase.begins_in_contact)
        modes.append(ContactMode(name, name in closed, frozenset(closed - {name})))
        add(name, phase.ends_in_contact)
    modes.append(ContactMode(names[-1], names[-1] in closed, frozenset(closed - {names[-1]})))
    return tuple(modes)
