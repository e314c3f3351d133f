"""The contract of the phases of a task."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from math import inf
from typing import ClassVar, Literal

import casadi as ca

from drake_dae.arrays import positive
from drake_dae.errors import ModelError
from drake_dae.references import Reference
from drake_dae.systems.task.phases.condition import Condition

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


@dataclass(frozen=True)
class Moment:
    """The measurements that decide when a phase ends, as numbers or expressions of CasADi.

    Attributes:
        time: The time since the phase began, in s.
        force: The measured force of the contact, in N; of several points their sum.
        distance: The distance from the surface by the law's model, in m; of several points their
            mean.
        rate: Its derivative, in m/s.
        wanted: The reference of the force (in contact), in N, or of the distance, in m.
        away: The increase of the distance since the phase began, in m.
        travel: See `Condition`.
        signals: Name -> value of each signal.
        controls: Name -> |u| of each control, and "" -> the largest; empty if no phase watches one.
    """

    time: float
    force: float
    distance: float
    rate: float
    wanted: float
    away: float = 0.0
    travel: float = 0.0
    signals: Mapping[str, float] = field(default_factory=dict)
    controls: Mapping[str, float] = field(default_factory=dict)

    def value(self, condition: Condition) -> float:
        """The value of the quantity that a condition watches."""
        if condition.of in ("signal", "control"):
            named: Mapping[str, float] = getattr(self, f"{condition.of}s")
            return named[condition.name]
        value: float = getattr(self, condition.of)
        return value

    def margin(self, condition: Condition) -> float:
        """A number that is positive until a condition holds."""
        value = self.value(condition)
        return condition.limit - value if condition.above is not None else value - condition.limit


@dataclass(frozen=True, kw_only=True)
class Phase(ABC):
    """A part of a task, with its own goals for the outputs and its own end.

    1. `begins_in_contact` and `ends_in_contact` say whether the robot is in contact at the start
       and at the end; None means as at the end of the phase before it in the list. The law that
       fits is active from the start on.
    2. `goals` are references, whose time starts with the phase. Outputs with `rates` keep these
       rates, and all others come to rest within `over`.
    3. References do not jump: they start with the values and all derivatives of those before that
       the law uses, and reach the goals within `over`.
    4. A phase succeeds when one of the conditions in `until` holds; without any, when its own
       `margin` is 0. A phase whose conditions in `until` are forces above a limit has touched then.
    5. It fails if one of its `guards` holds; if it lasts longer than `within`, or `remaining`
       becomes 0; and, with `holds_contact`, if the contact is lost.
    6. The successor is the name of a phase, or "next", the next one in the list; "done", the task
       is done, and the robot rests; "approach", back to the last phase that leads into contact, at
       most `retries` of the task times; "hold", the robot rests in its present state with contact
       and force; "leave", the force goes to zero, and the run ends; "stop", the robot rests, and
       the run ends; "fail", the run ends with an error.

    Attributes:
        over: The duration of the transition from the previous references, in s.
        name: The name of the phase; by default that of its class, with a number if there are
            several.
        until: The conditions, one of which ends it with success; its own end if left out.
        guards: The conditions, one of which is a failure.
        on_success: The successor if it succeeds: the name of a phase, or next, done, approach,
            hold, leave, stop or fail.
        on_failure: The successor if it fails; by default fail, and hold after a lost contact.
        retries: The number of times that it may be entered again; needed for a phase to which
            others lead back.
        if_spent: The successor in its place once these are used up.
    """

    over: float = 0.5
    name: str = ""
    until: Sequence[Condition] = ()
    guards: Sequence[Condition] = ()
    on_success: str = NEXT
    on_failure: str | None = None
    retries: int | None = None
    if_spent: str = FAIL
    begins_in_contact: ClassVar[bool | None] = None
    ends_in_contact: ClassVar[bool | None] = None
    holds_contact: ClassVar[bool] = False
    # Not fields here: only phases that wait, or hold a contact, have them as fields.
    within = inf
    if_late = if_lost = _NOTHING

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", type(self).__name__)
        for key in ("until", "guards"):
            object.__setattr__(self, key, tuple(getattr(self, key)))
        for name in ("over", "within"):
            value = getattr(self, name)
            if value != inf or name == "over":
                positive(f"{self.name}: {name}", value)
        if self.retries is not None and self.retries < 0:
            raise ModelError(f"{self.name}: retries must be 0 or more, got {self.retries}")

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """The conditions in `until` and `guards`."""
        return (*self.until, *self.guards)

    def in_contact_after(self, before: bool) -> bool:
        """Whether the robot is in contact after its success.

        Args:
            before: Whether it is in contact while the phase lasts.
        """
        forces = [each.of == "force" and each.above is not None for each in self.until]
        if forces and all(forces):
            return True
        return before if self.ends_in_contact is None else self.ends_in_contact

    def felt(self, contact_force: float) -> float:
        """The force at which it has touched, or with which it presses, in N.

        Args:
            contact_force: As of `margin`.
        """
        forces = [each.above for each in self.until if each.of == "force"]
        return min([force for force in forces if force is not None], default=contact_force)

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        """Output name -> its reference, whose time starts with the phase.

        Args:
            contact_output: The name of the force, or of the distance if the robot is free. With a
                goal for the force of several points, their other force outputs without goals go to
                zero; with a goal for this one of their distances, the others go to the same.
        """
        return {}

    def rates(self, contact_output: str) -> Mapping[str, float]:
        """Name of an output without a goal -> its final rate, in its unit per s.

        Args:
            contact_output: As of `goals`.
        """
        return {}

    @abstractmethod
    def margin(self, now: Moment, contact_force: float) -> float:
        """A number that is positive until its own end; an expression if `now` has them.

        Args:
            now: The measurements.
            contact_force: Forces below this, in N, count as zero.
        """

    def success(self, now: Moment, contact_force: float) -> float:
        """A number that is positive until the phase succeeds, by `until` or its own `margin`."""
        if not self.until:
            return self.margin(now, contact_force)
        return reduce(ca.fmin, [now.margin(condition) for condition in self.until])

    def remaining(self, now: Moment) -> float:
        """A number that is positive until the phase is late; an expression if `now` has them."""
        return self.within - now.time if self.within < inf else inf

    def has_waited(self, now: Moment) -> bool:
        """Whether it lasts as long as it may, apart from round-off."""
        return now.time > self.within - 1e-6

    def lateness(self, now: Moment, contact_force: float) -> str:
        """The reason why it is late, for messages."""
        return f"{self.name} has waited {self.within:g} s for {self.awaits(contact_force)}"

    @abstractmethod
    def awaited(self, contact_force: float) -> str:
        """Its own end, for messages: "a force of 0.5 N"."""

    def awaits(self, contact_force: float) -> str:
        """The condition that ends it, for messages: that of `until`, or its own."""
        return " or ".join(map(str, self.until)) or self.awaited(contact_force)

    def key_of(self, outcome: Outcome) -> str:
        """The name of the attribute with the successor after an outcome."""
        keys = {"success": "on_success", "late": "if_late", "lost": "if_lost"}
        key = keys.get(outcome, "on_failure")
        return key if getattr(self, key) is not None else "on_failure"

    def chosen(self, outcome: Outcome) -> str:
        """The successor after an outcome; see rule 6."""
        successor = getattr(self, self.key_of(outcome))
        if successor is None:
            return HOLD if outcome == "lost" else FAIL
        return str(successor)
