"""The contract of the phases of a task."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from math import inf
from typing import ClassVar, Literal, Self

from drake_dae.arrays import positive
from drake_dae.dae.references import Reference
from drake_dae.errors import ModelError
from drake_dae.systems.task.phases.guards import PhaseGuard

Outcome = Literal["success", "guard", "late", "lost"]
"""How a phase ends: by its success, one of its guards, lateness, or a lost contact."""

NEXT, DONE, APPROACH, HOLD, LEAVE, STOP, FAIL = ENDS = (
    "next",
    "done",
    "approach",
    "hold",
    "leave",
    "stop",
    "fail",
)
"""The successors besides the name of a phase."""

_NOTHING: str | None = None

_BY_PACE = {"over": -1, "speed": 1, "acceleration": 2}
"""Attribute of a phase -> the power of the pace by which it is multiplied."""


@dataclass(frozen=True)
class Moment:
    """The measurements that decide when a phase ends, as numbers or expressions of CasADi.

    Attributes:
        time: The time since the phase began, in s.
        force: The measured force of the contact, in N; of a face the sum over its points.
        distance: The distance from the surface by the law's model, in m; of a face the mean.
        rate: Its derivative, in m/s.
        wanted: The reference of the force (in contact), in N, or of the distance, in m.
        away: The increase of the distance since the phase began, in m.
        speed, travel, work, control, eccentricity: See `PhaseGuard`; work and control only if a
            guard watches them.
        signal: The signal that the phase waits for; 0 without one.
        torque: The magnitude of the control `Phase.measured_control`; 0 without one.
    """

    time: float
    force: float
    distance: float
    rate: float
    wanted: float
    away: float = 0.0
    speed: float = 0.0
    travel: float = 0.0
    work: float = 0.0
    control: float = 0.0
    eccentricity: float = 0.0
    signal: float = 0.0
    torque: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Phase(ABC):
    """A part of a task, with its own goals for the outputs and its own end.

    1. `begins_in_contact` and `ends_in_contact` say whether the robot is in contact at the start
       and at the end; None means as at the end of the phase before it in the list. The law that
       fits is active from the start on.
    2. `goals` are references, whose time starts with the phase; with `is_relative` they are added
       to the positions at which the outputs would come to rest. Outputs with `rates` keep these
       rates, and all others come to rest within `over`.
    3. References do not jump: they start with the values and all derivatives of those before that
       the law uses, and reach the goals within `over`.
    4. `margin` is positive until the phase succeeds. The phase fails if it lasts longer than
       `within`, or `remaining` becomes 0; if one of its guards trips; and, with `holds_contact`, if
       the contact is lost. With `ends_by_loss` it succeeds if the contact is lost.
    5. The successor is the name of a phase, or "next", the next one in the list; "done", the task
       is done, and the robot rests; "approach", back to the last phase that leads into contact, at
       most `retries` of the task times; "hold", the robot rests in its present state with contact
       and force; "leave", the force goes to zero, and the run ends; "stop", the robot rests, and
       the run ends; "fail", the run ends with an error.
    6. `for_contact` and `for_latch` say whether it is for a contact that pushes, and for a latch: a
       constraint that commands open and close, with forces of any sign. Of a latch, `Moment` has
       the largest force, distance and rate of its directions.
    7. With `finds_line` the paths of its contact points are straight, and `followed_lines` fits a
       line to them.
    8. With `enters_holes` the tool is in a hole at its end, and touches the sides of it.

    Attributes:
        over: The duration of the transition from the previous references, in s.
        name: The name of the phase; by default that of its class, with a number if there are
            several.
        guards: The limits at which it fails.
        on_success: The successor if it succeeds: the name of a phase, or next, done, approach,
            hold, leave, stop or fail.
        on_failure: The successor if it fails; by default fail, and hold after a lost contact.
        retries: The number of times that it may be entered again; needed for a phase to which
            others lead back.
        if_spent: The successor in its place once these are used up.
        contact: The name of the latch that it opens, closes or leads; that of the phase before in
            the list if empty. Empty in all phases of a task with one contact.
    """

    over: float = 0.5
    name: str = ""
    guards: Sequence[PhaseGuard] = ()
    on_success: str = NEXT
    on_failure: str | None = None
    retries: int | None = None
    if_spent: str = FAIL
    contact: str = ""
    begins_in_contact: ClassVar[bool | None] = None
    ends_in_contact: ClassVar[bool | None] = None
    holds_contact: ClassVar[bool] = False
    ends_by_loss: ClassVar[bool] = False
    is_relative: ClassVar[bool] = False
    for_contact: ClassVar[bool] = True
    for_latch: ClassVar[bool] = False
    finds_line: ClassVar[bool] = False
    enters_holes: ClassVar[bool] = False
    # Not fields here: only phases that wait, or hold a contact, have them as fields.
    within = inf
    if_late = if_lost = _NOTHING

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", type(self).__name__)
        object.__setattr__(self, "guards", tuple(self.guards))
        for name in ("over", "within"):
            value = getattr(self, name)
            if value != inf or name == "over":
                positive(f"{self.name}: {name}", value)
        if self.retries is not None and self.retries < 0:
            raise ModelError(f"{self.name}: retries must be 0 or more, got {self.retries}")

    def at_pace(self, pace: float) -> Self:
        """Returns the phase with its motion at a multiple of its speed.

        It passes through the same values: `over` is divided by the pace, a `speed` is multiplied by
        it, and an `acceleration` by its square. `within` does not change.

        Args:
            pace: The multiple, positive.
        """
        changed = [field.name for field in fields(self) if field.name in _BY_PACE]
        return replace(self, **{n: getattr(self, n) * pace ** _BY_PACE[n] for n in changed})

    @property
    def speed_of_approach(self) -> float:
        """The final rate at which the distance falls, in m/s."""
        return 0.0

    def felt(self, contact_force: float) -> float:
        """The force at which it has touched, or with which it presses, in N.

        Args:
            contact_force: As of `margin`.
        """
        return contact_force

    @property
    def signal(self) -> str:
        """The name of the signal that it waits for; empty for none."""
        return ""

    @property
    def measured_control(self) -> str:
        """The name of the control whose magnitude is `Moment.torque`; empty for none."""
        return ""

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        """Output name -> its reference, whose time starts with the phase.

        Args:
            contact_output: The name of the force, or of the distance if the robot is free. With a
                goal for the force of a face, its moments without goals go to zero; with a goal for
                this one of its distances, the others go to the same.
        """
        return {}

    def goals_of_latch(self, contact_output: str) -> Mapping[str, Reference | float]:
        """The goals of a phase that leads a latch; by default those of `goals`.

        Args:
            contact_output: The name of the latch's first force, or distance if it is open.
        """
        return self.goals(contact_output)

    def rates(self, contact_output: str) -> Mapping[str, float]:
        """Name of an output without a goal -> its final rate, in its unit per s.

        Args:
            contact_output: As of `goals`.
        """
        return {contact_output: -self.speed_of_approach} if self.speed_of_approach else {}

    def needed(self, contact_force: float) -> Mapping[str, float]:
        """Watched quantity of a guard -> the value that it reaches at least before success.

        Args:
            contact_force: As of `margin`.
        """
        return {}

    @abstractmethod
    def margin(self, now: Moment, contact_force: float) -> float:
        """A number that is positive until the phase succeeds; an expression if `now` has them.

        Args:
            now: The measurements.
            contact_force: Forces below this, in N, count as zero.
        """

    def remaining(self, now: Moment) -> float:
        """A number that is positive until the phase is late; an expression if `now` has them."""
        return self.within - now.time if self.within < inf else inf

    def has_waited(self, now: Moment) -> bool:
        """Whether it lasts as long as it may; the time of a guard is found a little early."""
        return now.time > self.within - 1e-6

    def lateness(self, now: Moment, contact_force: float) -> str:
        """The reason why it is late, for messages."""
        return f"{self.name} has waited {self.within:g} s for {self.awaited(contact_force)}"

    @abstractmethod
    def awaited(self, contact_force: float) -> str:
        """The condition that ends it, for messages: "a force of 0.5 N"."""

    def key_of(self, outcome: Outcome) -> str:
        """The name of the attribute with the successor after an outcome."""
        keys = {"success": "on_success", "late": "if_late", "lost": "if_lost"}
        key = keys.get(outcome, "on_failure")
        return key if getattr(self, key) is not None else "on_failure"

    def chosen(self, outcome: Outcome) -> str:
        """The successor after an outcome; see rule 5."""
        successor = getattr(self, self.key_of(outcome))
        if successor is None:
            return HOLD if outcome == "lost" else FAIL
        return str(successor)


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
