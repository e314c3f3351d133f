"""A phase of a task: what all have in common."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import ClassVar, Literal

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.dae.references import Reference
from drake_dae.errors import ModelError
from drake_dae.systems.task.phases.guards import PhaseGuard

Outcome = Literal["success", "guard", "late", "lost"]
"""How a phase ends: as it should, by one of its guards, too late, or without its contact."""

NEXT, DONE, APPROACH, HOLD, LEAVE, STOP, FAIL = ENDS = (
    "next",
    "done",
    "approach",
    "hold",
    "leave",
    "stop",
    "fail",
)
"""What may follow besides a phase by its name."""

_NOTHING: str | None = None


@dataclass(frozen=True)
class Moment:
    """What ends a phase is decided by: numbers, or expressions of CasADi.

    Attributes:
        time: Since the phase began, in s.
        force: The measured force of the contact, in N.
        distance: The distance from the surface by the law's model, in m.
        rate: Its derivative, in m/s.
        wanted: What the reference of the force is (in contact), in N, or of the distance, in m.
        away: How much the distance has grown since the phase began, in m.
        speed, travel, work, control: See `PhaseGuard`; work and control only where guarded.
        signal: What the phase waits for; 0 without.
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
    signal: float = 0.0


@checked(ModelError)
@dataclass(frozen=True, kw_only=True)
class Phase(ABC):
    """A part of a task, with its own goals for the outputs and its own end.

    1. `begins_in_contact` and `ends_in_contact` say whether the robot touches then; None is as in
       the phase before it in the list. From its begin on the law acts that fits.
    2. `goals` are references in s after the phase began, and with `is_relative` from where the
       outputs would come to rest. All other outputs come to rest where they are, within `over`, but
       those with `rates`, which go on so fast.
    3. A phase takes over without a bump: its references are those of the phase before, with all
       derivatives that the law has, and lead to the goals within `over`.
    4. `margin` is positive until the phase is over, which is its success. It fails where it is not
       over `within` that time, or `remaining` says that it will not be; where one of its guards
       trips; and, with `holds_contact`, where it is in contact and that is lost.
    5. What follows is the name of a phase, or "next", the next one in the list; "done", the task is
       done, and the robot rests; "approach", from the last phase on that leads into contact, at
       most as often as the task has `retries`; "hold", the robot rests where it is, with contact
       and force, for good; "leave", the force goes to zero, and the run ends; "stop", the robot
       rests, and the run ends; "fail", the run ends with an error.

    Attributes:
        over: How long the references before take to become those of this phase, in s.
        name: What others call it; the name of the class if left out, with a number if there are
            more of these.
        guards: What may not be exceeded.
        on_success: What follows where it succeeds: the name of a phase, or next, done, approach,
            hold, leave, stop or fail.
        on_failure: What follows where it fails. Left out it is fail, and hold where a contact is
            lost.
        retries: How many times it may be entered again; a phase to which others lead back needs
            this number.
        if_spent: What follows in its place where it would be entered once more.
    """

    over: float = 0.5
    name: str = ""
    guards: Sequence[PhaseGuard] = ()
    on_success: str = NEXT
    on_failure: str | None = None
    retries: int | None = None
    if_spent: str = FAIL
    begins_in_contact: ClassVar[bool | None] = None
    ends_in_contact: ClassVar[bool | None] = None
    holds_contact: ClassVar[bool] = False
    is_relative: ClassVar[bool] = False
    # No fields here: phases that wait, and those that hold a contact, have them.
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

    @property
    def speed_of_approach(self) -> float:
        """How fast the distance falls at last, in m/s."""
        return 0.0

    def felt(self, contact_force: float) -> float:
        """The force with which it has touched, in N, where it comes with `speed_of_approach`.

        Args:
            contact_force: As of `margin`.
        """
        return contact_force

    @property
    def signal(self) -> str:
        """The name of the signal that it waits for; empty if for none."""
        return ""

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        """Output name -> its reference in s after the phase began.

        Args:
            contact_output: The name of the force, or of the distance where the robot is free.
        """
        return {}

    def rates(self, contact_output: str) -> Mapping[str, float]:
        """Output name -> how fast it goes at last, in its unit per s, of those without goals.

        Args:
            contact_output: As of `goals`.
        """
        return {contact_output: -self.speed_of_approach} if self.speed_of_approach else {}

    def needed(self, contact_force: float) -> Mapping[str, float]:
        """What a guard watches -> what that reaches at least before the phase is over.

        Args:
            contact_force: As of `margin`.
        """
        return {}

    @abstractmethod
    def margin(self, now: Moment, contact_force: float) -> float:
        """A number that is positive until the phase is over, or an expression, as `now` has.

        Args:
            now: What is measured.
            contact_force: A force that is less than this, in N, is none.
        """

    def remaining(self, now: Moment) -> float:
        """A number that is positive until the phase is late, or an expression, as `now` has."""
        return self.within - now.time if self.within < inf else inf

    def lateness(self, now: Moment, contact_force: float) -> str:
        """Why it is late, for messages."""
        return f"{self.name} has waited {self.within:g} s for {self.awaited(contact_force)}"

    @abstractmethod
    def awaited(self, contact_force: float) -> str:
        """What ends it, for messages: "a force of 0.5 N"."""

    def key_of(self, outcome: Outcome) -> str:
        """Which attribute says what follows an outcome."""
        own = {"success": "on_success", "late": "if_late", "lost": "if_lost"}.get(outcome, "")
        return own if own and getattr(self, own) is not None else "on_failure"

    def chosen(self, outcome: Outcome) -> str:
        """What follows an outcome, as rule 5 has it."""
        found = getattr(self, self.key_of(outcome))
        return found if found is not None else HOLD if outcome == "lost" else FAIL
