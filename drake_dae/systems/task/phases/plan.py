"""The order of the phases of a task, and the check that every path through it ends."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from drake_dae.arrays import unknown_name
from drake_dae.errors import ModelError
from drake_dae.systems.task.phases.members import Release
from drake_dae.systems.task.phases.phase import (
    APPROACH,
    DONE,
    ENDS,
    FAIL,
    LEAVE,
    NEXT,
    STOP,
    Outcome,
    Phase,
)

OUTCOMES: tuple[Outcome, ...] = ("success", "guard", "late", "lost")

_RESERVED = (*ENDS, "held", "end")
"""Words that cannot be names of phases."""


@dataclass(frozen=True)
class Successor:
    """The successor of a phase.

    Attributes:
        chosen: The key word that led there: the name of a phase, "next", "stop" and so on.
        place: The index of the next phase; the number of phases if the task is done, None if the
            robot rests for another reason.
        remark: A remark for the record: "retry 1 of 2"; empty for none.
    """

    chosen: str
    place: int | None
    remark: str = ""


def named(phases: Sequence[Phase]) -> tuple[Phase, ...]:
    """The phases with distinct names: those with the name of their class are numbered.

    Raises:
        ModelError: Two phases have one name, or a name is a reserved word.
    """
    chosen = [phase.name for phase in phases if phase.name != type(phase).__name__]
    renamed = list[Phase]()
    for index, phase in enumerate(phases):
        where, name, number = f"phase {index + 1} of the task", phase.name, 1
        if name in _RESERVED or name != name.strip():
            raise ModelError(f"{where}: '{name}' is no name of a phase; give it another one")
        if chosen.count(name) > 1:
            raise ModelError(f"{where}: more than one phase has the name '{name}'")
        if name == type(phase).__name__:
            taken = {*chosen, *(other.name for other in renamed)}
            while name in taken:
                number += 1
                name = f"{phase.name} {number}"
        renamed.append(phase if phase.name == name else replace(phase, name=name))
    return tuple(renamed)


class PhasePlan:
    """The order of the phases of a task.

    Args:
        phases: The phases, with distinct names.
        retries: The number of times that a task may go back to an approach.

    Attributes:
        phases: The same, followed by the Release for "leave" if it may be needed.
        contacts: Whether each phase begins in contact; last whether the last one ends in contact.
        last: The number of phases that were given.
        retries: The argument.

    Raises:
        ModelError: A successor is not a phase; a phase begins in contact although the robot is
            free, or the other way round; no phase leads to a phase; or phases may follow each other
            without an end.
    """

    def __init__(self, phases: Sequence[Phase], retries: int) -> None:
        self._names = [phase.name for phase in phases]
        self.retries, self.last = retries, len(phases)
        self.phases: tuple[Phase, ...] = tuple(phases)
        self.contacts = _contacts_of(phases)
        if self._leaves():
            # A model error may be larger than the task's contact_force, and holds the tool.
            leave = Release(name=LEAVE, within=5.0, on_success=STOP, on_failure=STOP)
            self.phases = (*phases, leave)
            self.contacts = (*self.contacts[:-1], True, False)
        self._edges = {place: self._all_from(place) for place in range(self.last)}
        self._check_reached()
        self._check_ends()

    def where(self, place: int) -> str:
        """A phase, for messages."""
        name = self.phases[place].name
        return f"phase {place + 1} of the task, {name}"

    def last_approach(self, index: int) -> int | None:
        """The index of the last phase up to this one that leads into contact; None if none does."""
        for place in range(index, -1, -1):
            if self.ends_in_contact(place) and not self.contacts[place]:
                return place
        return None

    def successor(
        self, place: int, outcome: Outcome, entered: Sequence[int], chosen: Sequence[str]
    ) -> Successor:
        """The successor of a phase that has ended.

        Args:
            place: The index of the phase.
            outcome: How it ended.
            entered: The indices of all phases that began, in order.
            chosen: The key words that led to these.
        """
        word, remarks = self.phases[place].chosen(outcome), list[str]()
        counts = Counter(entered)
        ends_free = not self.contacts[place]
        if outcome == "success":
            ends_free = not self.ends_in_contact(place)
        for _ in range(self.last + 1):
            to = self.place_of(place, word)
            if to is None and word == LEAVE:
                to = None if ends_free else self.last
            if to is None or to >= self.last:
                return Successor(word, to, "; ".join(remarks))
            phase, most = self.phases[to], self.phases[to].retries
            count = counts[to]
            if most is None and word == APPROACH:
                count, most = 1 + sum(key == APPROACH for key in chosen), self.retries
            if most is None or count <= most:
                if count and most is not None:
                    remarks.append(f"retry {count} of {most}")
                return Successor(word, to, "; ".join(remarks))
            times = f"after {most} " + ("retry" if most == 1 else "retries")
            remarks.append(times if word == APPROACH else f"{phase.name} is not entered {times}")
            place, word = to, FAIL if word == APPROACH and phase.retries is None else phase.if_spent
        return Successor(FAIL, None, "; ".join(remarks))

    def ends_in_contact(self, place: int) -> bool:
        """Whether a phase that succeeds ends in contact."""
        return self.phases[place].in_contact_after(self.contacts[place])

    def _leaves(self) -> bool:
        """Whether a phase in contact may lead to "leave"."""
        for place, phase in enumerate(self.phases):
            words = [phase.chosen(outcome) for outcome in OUTCOMES[1:]]
            if self.contacts[place] and LEAVE in words:
                return True
            if self.ends_in_contact(place) and phase.on_success == LEAVE:
                return True
        return any(self.contacts) and any(phase.if_spent == LEAVE for phase in self.phases)

    def place_of(self, place: int, word: str) -> int | None:
        """The index of the phase that a key word of a phase leads to; None for none."""
        if word == NEXT:
            return place + 1 if place + 1 < self.last else len(self.phases)
        if word == DONE:
            return len(self.phases)
        if word == APPROACH:
            return self.last_approach(place)
        return self._names.index(word) if word in self._names else None

    # The checks.

    def _all_from(self, place: int) -> list[tuple[str, int]]:
        """The key words and phases that may follow a phase, each checked."""
        phase, edges = self.phases[place], list[tuple[str, int]]()
        if phase.retries is not None:
            self._check_word(place, "if_spent", phase.if_spent)
        outcomes: list[Outcome] = ["success", "guard", "late"]
        if phase.holds_contact and self.contacts[place]:
            outcomes.append("lost")
        for outcome in outcomes:
            at, key, word, tried = place, phase.key_of(outcome), phase.chosen(outcome), set[int]()
            self._check_word(place, key, word)
            while (to := self.place_of(at, word)) is not None and to < self.last:
                self._check_contact(place, key, outcome, to)
                edges.append((word, to))
                if to in tried or self.phases[to].retries is None:
                    break
                tried.add(to)
                at, key, word = to, "if_spent", self.phases[to].if_spent
                self._check_word(at, key, word)
        return edges

    def _check_word(self, place: int, key: str, word: str) -> None:
        if word == APPROACH and self.last_approach(place) is None:
            raise ModelError(
                f"{self.where(place)}: {key}: approach goes back to an Approach, and there is none "
                "before it"
            )
        if word not in (*ENDS, *self._names):
            known = unknown_name("phase", word, self._names)
            raise ModelError(f"{self.where(place)}: {key}: {known}; or take {', '.join(ENDS)}")

    def _check_contact(self, place: int, key: str, outcome: Outcome, to: int) -> None:
        """Refuses a phase that cannot follow another one with its outcome."""
        after, text = self.phases[to], ""
        is_next = to == place + 1 and outcome == "success" and key == "on_success"
        way = "" if is_next else f", after {self.phases[place].name} by {key}"
        begins, ends = self.contacts[to], self.ends_in_contact(to)
        in_contact = self.ends_in_contact(place) if outcome == "success" else self.contacts[place]
        if outcome == "lost" and begins and ends:
            text = "it begins in contact, but the contact is lost; choose another one by if_lost"
        elif begins and not in_contact:
            text = "it begins in contact, but the robot is free; an Approach must lead there"
        elif outcome == "success" and not begins and in_contact:
            text = "it begins with a free robot, but it is in contact; a Release must lead there"
        if text:
            raise ModelError(f"phase {to + 1} of the task, {after.name}{way}: {text}")

    def _check_reached(self) -> None:
        reached, unexplored = {0}, [0]
        while unexplored:
            after = {to for _, to in self._edges[unexplored.pop()]} - reached
            reached |= after
            unexplored += after
        for place in range(self.last):
            if place not in reached:
                raise ModelError(
                    f"{self.where(place)}: no phase leads to it; name it in an on_success or "
                    "on_failure, or leave it out"
                )

    def _check_ends(self) -> None:
        """Refuses loops of phases that are not counted.

        Phases with `retries` are counted, and so is each return by "approach". A phase whose
        retries are used up passes on to its `if_spent`.
        """

        def counts(word: str, to: int) -> bool:
            return word == APPROACH and self.phases[to].retries is None

        ways = {
            place: [to for word, to in edges if not counts(word, to)]
            for place, edges in self._edges.items()
        }
        for place, phase in enumerate(self.phases[: self.last]):
            if phase.retries is not None:
                word, spent = phase.if_spent, self.place_of(place, phase.if_spent)
                ways[place] = [] if spent is None or counts(word, spent) else [spent]
        done = set[int]()

        def follow(place: int, before: tuple[int, ...]) -> None:
            if place in before:
                names = [self.phases[i].name for i in before[before.index(place) :]]
                words = (
                    f"{', '.join(names[:-1])} and {names[-1]} lead back to {names[0]}"
                    if names[1:]
                    else f"{names[0]} leads back to itself"
                )
                raise ModelError(
                    f"the task may not end: {words}, any number of times; give {names[0]} a count "
                    "of retries"
                )
            if place in done:
                return
            for to in ways.get(place, ()):
                follow(to, (*before, place))
            done.add(place)

        for place in range(self.last):
            follow(place, ())


def _contacts_of(phases: Sequence[Phase]) -> tuple[bool, ...]:
    """Whether each phase begins in contact; last whether the last one ends in contact.

    At the start the robot is in contact if the first phase that says so begins in contact. One
    without a say that ends by a force begins without it.
    """
    known = (
        bool(phase.begins_in_contact)
        for phase in phases
        if phase.begins_in_contact is not None or phase.in_contact_after(False)
    )
    is_closed, contacts = next(known, False), []
    for phase in phases:
        if phase.begins_in_contact is not None:
            is_closed = phase.begins_in_contact
        contacts.append(is_closed)
        is_closed = phase.in_contact_after(is_closed)
    return (*contacts, is_closed)


def check_forces(phases: Sequence[Phase], contact_force: float) -> None:
    """Refuses phases that touch or press with a force that counts as none.

    Raises:
        ModelError: The force of a phase is below `contact_force`.
    """
    for index, phase in enumerate(phases):
        if (force := phase.felt(contact_force)) < contact_force:
            raise ModelError(
                f"phase {index + 1} of the task, {phase.name}: force: {force:g} N counts as no "
                f"force, since it is less than the contact_force of {contact_force:g} N; give "
                "more, or a smaller contact_force"
            )
