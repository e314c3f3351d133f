"""The phases of a task: what each wants, and what ends it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import ClassVar, Literal

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.dae.references import Reference
from drake_dae.errors import ModelError

Reaction = Literal["approach", "hold", "stop", "fail"]
"""What follows where a contact is lost or a phase does not end: "approach" goes back to the last
Approach and from there through all phases again; "hold" brings the robot to rest where it is, for
good; "stop" does so too, and ends the run; "fail" ends it with an error."""


_AWAY = 0.02
"""So far from where it began, in m, a Release has left the contact."""

_FAIL: Reaction = "fail"
_NOTHING: Reaction | None = None


@dataclass(frozen=True)
class Moment:
    """What the guards of a phase see: numbers, or expressions of CasADi.

    Attributes:
        time: Since the phase began, in s.
        force: The measured force of the contact, in N.
        distance: The distance from the surface by the law's model, in m.
        rate: Its derivative, in m/s.
        wanted: What the reference of the force is (in contact), in N, or of the distance, in m.
        away: How much the distance has grown since the phase began, in m.
    """

    time: float
    force: float
    distance: float
    rate: float
    wanted: float
    away: float = 0.0


@checked(ModelError)
@dataclass(frozen=True, kw_only=True)
class Phase(ABC):
    """A part of a task, with its own goals for the outputs and its own end.

    1. `begins_in_contact` and `ends_in_contact` say whether the robot touches then; None is as in
       the phase before. From its begin on the law acts that fits.
    2. `goals` are references in s after the phase began. All other outputs come to rest where they
       are, within `over`; the distance alone falls in the end with `speed_of_approach`.
    3. A phase takes over without a bump: its references are those of the phase before, with all
       derivatives that the law has, and lead to the goals within `over`.
    4. `margin` is positive until the phase is over. Where it is not over `within` that time, or
       `remaining` says that it will not be, `if_late` follows; where it is in contact and that is
       lost, `if_lost`, unless it is None.

    Attributes:
        over: How long the references before take to become those of this phase, in s.
    """

    over: float = 0.5
    begins_in_contact: ClassVar[bool | None] = None
    ends_in_contact: ClassVar[bool | None] = None
    # No fields here: phases that wait, and those that hold a contact, have them.
    within = inf
    if_late = _FAIL
    if_lost = _NOTHING

    def __post_init__(self) -> None:
        for name in ("over", "within"):
            value = getattr(self, name)
            if value != inf or name == "over":
                positive(f"{self.name}: {name}", value)

    @property
    def name(self) -> str:
        """What the record calls it."""
        return type(self).__name__

    @property
    def speed_of_approach(self) -> float:
        """How fast the distance falls at last, in m/s."""
        return 0.0

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        """Output name -> its reference in s after the phase began.

        Args:
            contact_output: The name of the force, or of the distance where the robot is free.
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


@checked(ModelError)
@dataclass(frozen=True)
class Approach(Phase):
    """The distance falls at a constant speed until the robot touches.

    Attributes:
        speed: With which it touches, in m/s; less where it touches before the references of this
            phase are reached, as where it starts from rest nearer than speed * over / 2.
        behind: The largest distance behind the surface of the model, in m, up to which it seeks
            the contact; farther behind it is late.
        over: How long the references before take to become those of this phase, in s.
        within: How long the phase may last, in s.
        if_late: What follows where it lasts longer: "hold", "stop" or "fail".
    """

    speed: float = 0.05
    behind: float = 0.05
    within: float = field(default=60.0, kw_only=True)
    if_late: Reaction = field(default="fail", kw_only=True)
    begins_in_contact, ends_in_contact = False, True

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("Approach: speed", self.speed)
        positive("Approach: behind", self.behind)
        if self.if_late == "approach":
            raise ModelError(
                "Approach: if_late: 'approach' would go on as before; hold, stop or fail is left"
            )

    @property
    def speed_of_approach(self) -> float:
        return self.speed

    def remaining(self, now: Moment) -> float:
        found: float = ca.fmin(super().remaining(now), now.distance + self.behind)
        return found

    def lateness(self, now: Moment, contact_force: float) -> str:
        if now.time >= self.within:
            return super().lateness(now, contact_force)
        return (
            f"Approach is {-now.distance:.3g} m behind the surface of the model without "
            f"{self.awaited(contact_force)}"
        )

    def margin(self, now: Moment, contact_force: float) -> float:
        return contact_force - now.force

    def awaited(self, contact_force: float) -> str:
        return f"a force of {contact_force:g} N"


@checked(ModelError)
@dataclass(frozen=True)
class Press(Phase):
    """The force goes from what it is to a goal, smoothly.

    Attributes:
        force: The goal, in N: a positive number, or a reference in s after the phase began.
        tolerance: How near to its reference the force must be for the phase to end, in N.
        over: How long the references before take to become those of this phase, in s.
        within: How long the phase may last, in s.
        if_late: What follows where it lasts longer: "approach", "hold", "stop" or "fail".
        if_lost: What follows where the contact is lost, likewise.
    """

    force: float | Reference
    tolerance: float = 1.0
    within: float = field(default=60.0, kw_only=True)
    if_late: Reaction = field(default="fail", kw_only=True)
    if_lost: Reaction = field(default="hold", kw_only=True)
    begins_in_contact, ends_in_contact = True, True

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("Press: tolerance", self.tolerance)
        if not isinstance(self.force, Reference):
            positive("Press: force", self.force)

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return {contact_output: self.force}

    def margin(self, now: Moment, contact_force: float) -> float:
        off = abs(now.force - now.wanted)
        found: float = ca.fmax(self.over - now.time, off - self.tolerance)
        return found

    def awaited(self, contact_force: float) -> str:
        return f"a force within {self.tolerance:g} N of its reference"


class _Lasting(Phase):
    """A phase that ends after its `duration`, a field of the phases of this kind."""

    duration: float

    def __post_init__(self) -> None:
        super().__post_init__()
        positive(f"{self.name}: duration", self.duration)

    def margin(self, now: Moment, contact_force: float) -> float:
        return self.duration - now.time

    def awaited(self, contact_force: float) -> str:
        return f"the end of {self.duration:g} s"


@checked(ModelError)
@dataclass(frozen=True)
class Move(_Lasting):
    """Outputs follow references for some time, in contact or not, as the phase before.

    Attributes:
        references: Name -> reference in s after the phase began, or a number; names as those of
            `references_by_name`. The force may be among them, or the distance.
        duration: How long the phase lasts, in s.
        over: How long the references before take to become those of this phase, in s.
        if_lost: What follows where the contact is lost: "approach", "hold", "stop" or "fail".
    """

    references: Mapping[str, Reference | float]
    duration: float
    if_lost: Reaction = field(default="hold", kw_only=True)

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return self.references


@checked(ModelError)
@dataclass(frozen=True)
class Dwell(_Lasting):
    """All outputs come to rest where they are, the force too, for some time.

    Attributes:
        duration: How long the phase lasts, in s.
        over: How long the references before take to become those of this phase, in s.
        if_lost: What follows where the contact is lost: "approach", "hold", "stop" or "fail".
    """

    duration: float
    if_lost: Reaction = field(default="hold", kw_only=True)


@checked(ModelError)
@dataclass(frozen=True)
class Release(Phase):
    """The force goes to zero, smoothly; the phase ends where it is none.

    It is late also where the tool has gone 20 mm away and a force is still measured, which is then
    the bias of a sensor.

    Attributes:
        over: How long the references before take to become those of this phase, in s.
        within: How long the phase may last, in s.
        if_late: What follows where it lasts longer: "approach", "hold", "stop" or "fail".
    """

    within: float = field(default=60.0, kw_only=True)
    if_late: Reaction = field(default="fail", kw_only=True)
    begins_in_contact, ends_in_contact = True, False

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return {contact_output: 0.0}

    def margin(self, now: Moment, contact_force: float) -> float:
        return now.force - contact_force

    def remaining(self, now: Moment) -> float:
        found: float = ca.fmin(super().remaining(now), _AWAY - now.away)
        return found

    def lateness(self, now: Moment, contact_force: float) -> str:
        if now.time >= self.within:
            return super().lateness(now, contact_force)
        return (
            f"Release has gone {now.away:.3g} m away, and a force of {now.force:.3g} N is still "
            "measured, as by a sensor with a bias; see tare_time"
        )

    def awaited(self, contact_force: float) -> str:
        return f"a force of no more than {contact_force:g} N"


@checked(ModelError)
@dataclass(frozen=True)
class Retreat(Phase):
    """The distance goes from what it is to a goal, smoothly.

    Attributes:
        distance: The goal, in m.
        tolerance: How near to it the robot must be for the phase to end, in m.
        over: How long the references before take to become those of this phase, in s.
        within: How long the phase may last, in s.
        if_late: What follows where it lasts longer: "approach", "hold", "stop" or "fail".
    """

    distance: float
    tolerance: float = 1e-3
    within: float = field(default=60.0, kw_only=True)
    if_late: Reaction = field(default="fail", kw_only=True)
    begins_in_contact, ends_in_contact = False, False

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("Retreat: distance", self.distance)
        positive("Retreat: tolerance", self.tolerance)

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return {contact_output: self.distance}

    def margin(self, now: Moment, contact_force: float) -> float:
        off = abs(now.distance - self.distance)
        found: float = ca.fmax(self.over - now.time, off - self.tolerance)
        return found

    def awaited(self, contact_force: float) -> str:
        return f"a distance within {self.tolerance:g} m of {self.distance:g} m"
