"""The phases of a task: touch, press, move, dwell, let go, back off."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from math import inf, isfinite
from typing import Any, ClassVar, Literal

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.errors import ModelError
from drake_dae.references import LineReference, PathLimits, Reference

Watched = Literal[
    "force", "time", "distance", "travel", "control", "signal", "force error", "distance error"
]

Outcome = Literal["success", "guard", "late", "lost"]
"""How a phase ends."""

FAILURES: tuple[Outcome, ...] = "guard", "late", "lost"

NEXT, DONE, APPROACH, HOLD, LEAVE = ENDS = "next", "done", "approach", "hold", "leave"
"""What may follow a phase besides the name of another one."""

UNITS = {"force": "N", "time": "s", "distance": "m", "travel": "m", "control": "", "signal": ""}
UNITS |= {"force error": "N", "distance error": "m"}
"""Watched quantity -> its unit; a control has its own."""

_SPEED, _AWAY = 0.05, 0.02
"""The default speed of an Approach, in m/s; the way in m after which a Release has left."""

_FALL, _LEAST = PathLimits(0.5, 1.0), -1e3
"""How fast the reference of a Release falls below zero, in N/s and N/s^2, and its least value."""


@checked(ModelError)
@dataclass(frozen=True)
class Condition:
    """A measured quantity above or below a limit:

    - force: the measured force of the contact, in N;
    - time: the time since the phase began, in s;
    - distance: the distance from the surface by the law's model, in m;
    - travel: the norm of the change of all outputs in m, and of the distance, since the phase
      began, in m; the way of the tool if these are its coordinates;
    - control: |u| of a control, or the largest of all, in its unit, N m for joints;
    - signal: the value of the input signal_<name>, in a scenario one of task.signals;
    - force error, in contact, and distance error, without: |error| once `over` has passed.

    Attributes:
        of: The watched quantity.
        above: It holds at or above this value.
        below: It holds at or below this value. Either this or `above` is given.
        name: The name of the signal or of the control; of the largest control if empty.
    """

    of: Watched
    above: float | None = None
    below: float | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if (self.above is None) == (self.below is None):
            raise ModelError(f"Condition of the {self.of}: give either above or below")
        if not isfinite(self.limit):
            raise ModelError(f"Condition of the {self.of}: {self.limit} is not finite")
        if (self.of == "signal") != bool(self.name) and self.of != "control":
            raise ModelError(
                f"Condition of the {self.of}: name: a signal needs one, and only a control has one "
                f"besides, got '{self.name}'"
            )

    @property
    def limit(self) -> float:
        return self.above if self.above is not None else self.below or 0.0

    def __str__(self) -> str:
        watched = f"{self.of} {self.name}".rstrip()
        side = "above" if self.above is not None else "below"
        return f"a {watched} {side} {self.limit:g} {UNITS[self.of]}".rstrip()


@dataclass(frozen=True)
class Moment:
    """The measurements that decide when a phase ends, as expressions: those of `Condition`."""

    time: Any
    force: Any
    distance: Any
    rate: Any  # of the distance, m/s
    wanted: Any  # the reference of the force, in contact, or of the distance
    away: Any = 0.0  # the increase of the distance since the phase began, m
    travel: Any = 0.0
    signal: Mapping[str, Any] = field(default_factory=dict)
    control: Mapping[str, Any] = field(default_factory=dict)  # "" is the largest |u|

    @property
    def force_error(self) -> Any:
        return abs(self.force - self.wanted)

    @property
    def distance_error(self) -> Any:
        return abs(self.distance - self.wanted)


@dataclass(frozen=True, kw_only=True)
class Phase:
    """A part of a task, with its own goals for the outputs, its own end, and what follows.

    1. `begins_in_contact` and `ends_in_contact` say whether the robot is in contact at the start
       and at the end; None means as at the end of the phase before it in the list. The law that
       fits is active from the start on.
    2. `goals` are references, whose time starts with the phase; each is an expression of time.
       Outputs with `rates` keep these rates, and all others come to rest within `over`.
    3. References do not jump: they start with the values and all derivatives of those before that
       the law uses, and reach the goals within `over`.
    4. A phase succeeds when one of the conditions in `until` holds, or without any, of its own,
       `ends`. A phase whose conditions in `until` are forces above a limit has touched then.
    5. It fails if one of its `guards` holds; if it lasts longer than `within`, or `remaining`
       becomes 0; and, with `holds_contact`, if the contact is lost.
    6. The successor is the name of a phase, or "next", the next one in the list; "done", the task
       is done, and the robot rests; "approach", back to the last phase that leads into contact;
       "hold", the robot rests in its present state with contact and force, and the task is given
       up if the phase failed; "leave", the force goes to zero first.
    7. `remaining` is an expression of a `Moment`: with ca.fmin, ca.fmax, ca.if_else.

    Attributes:
        over: The duration of the transition from the previous references, in s.
        name: Its name; by default that of its class, with a number if there are several.
        until: The conditions, one of which ends it with success; its own end if left out.
        guards: The conditions, one of which is a failure.
        within: The largest duration of the phase, in s.
        on_success, on_failure: The successors if it succeeds, or fails, as in rule 6.
        if_late, if_lost: Those if it is late, or the contact is lost; on_failure if left out.
        retries: How many times it may be entered again; as many as the task allows if left out.
        if_spent: The successor in its place once these are used up.
    """

    over: float = 0.5
    name: str = ""
    until: Sequence[Condition] = ()
    guards: Sequence[Condition] = ()
    within: float = 60.0
    on_success: str = NEXT
    on_failure: str = HOLD
    if_late: str | None = None
    if_lost: str | None = None
    retries: int | None = None
    if_spent: str = HOLD
    begins_in_contact: ClassVar[bool | None] = None
    ends_in_contact: ClassVar[bool | None] = None
    holds_contact: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", type(self).__name__)
        for key in ("until", "guards"):
            object.__setattr__(self, key, tuple(getattr(self, key)))
        for name in ("over", "within"):
            positive(f"{self.name}: {name}", getattr(self, name))
        if self.retries is not None and self.retries < 0:
            raise ModelError(f"{self.name}: retries must be 0 or more, got {self.retries}")

    def in_contact_after(self, before: bool) -> bool:
        """Whether the robot is in contact after its success; `before`: while the phase lasts."""
        forces = [each.of == "force" and each.above is not None for each in self.until]
        if forces and all(forces):
            return True
        return before if self.ends_in_contact is None else self.ends_in_contact

    def felt(self, contact_force: float) -> float:
        """The force at which it has touched, or with which it presses, in N."""
        forces = [each for each in self.until if each.of == "force" and each.above is not None]
        return min([force.limit for force in forces], default=contact_force)

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        """Output name -> its reference, whose time starts with the phase.

        `contact_output` is the name of the force, or of the distance if the robot is free.
        """
        return {}

    def rates(self, contact_output: str) -> Mapping[str, float]:
        """Name of an output without a goal -> its final rate, in its unit per s."""
        return {}

    def ends(self, contact_force: float) -> Sequence[Condition]:
        """Its own conditions, one of which ends it; forces below `contact_force` are none."""
        raise NotImplementedError

    def margin(self, now: Moment, condition: Condition) -> Any:
        """A number that is positive until a condition holds."""
        value: Any = getattr(now, condition.of.replace(" ", "_"))
        if condition.of in ("signal", "control"):
            value = value[condition.name]
        margin = condition.limit - value if condition.above is not None else value - condition.limit
        return ca.fmax(self.over - now.time, margin) if "error" in condition.of else margin

    def success(self, now: Moment, contact_force: float) -> Any:
        """A number that is positive until the phase succeeds."""
        conditions = self.until or self.ends(contact_force)
        return reduce(ca.fmin, [self.margin(now, condition) for condition in conditions])

    def remaining(self, now: Moment) -> Any:
        """A number that is positive until the phase is late."""
        return self.within - now.time

    def awaits(self, contact_force: float) -> str:
        """The conditions that end it, for messages."""
        return " or ".join(map(str, self.until or self.ends(contact_force)))

    def successor(self, outcome: Outcome) -> tuple[str, str]:
        """What follows after an outcome, and the attribute that says so."""
        keys = {"success": "on_success", "late": "if_late", "lost": "if_lost"}
        word = getattr(self, key := keys.get(outcome, "on_failure"))
        return (word, key) if word is not None else (self.on_failure, "on_failure")


@checked(ModelError)
@dataclass(frozen=True)
class Approach(Phase):
    """The distance falls at a constant speed until the robot touches.

    Attributes:
        speed: The speed of the touch, in m/s; less if it touches during the transition, such as
            after a start at rest nearer than speed * over / 2. None for 0.05 m/s, and for less
            where a scenario computes the gains for a compliant contact: so that it lasts.
        behind: The largest distance behind the surface of the model, in m; farther behind it is
            late.
    """

    speed: float | None = None
    behind: float = 0.05
    begins_in_contact, ends_in_contact = False, True

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("Approach: speed", self.speed_of_approach)
        positive("Approach: behind", self.behind)

    @property
    def speed_of_approach(self) -> float:
        """The speed of the touch, in m/s."""
        return _SPEED if self.speed is None else self.speed

    def rates(self, contact_output: str) -> Mapping[str, float]:
        return {contact_output: -self.speed_of_approach}

    def remaining(self, now: Moment) -> Any:
        return ca.fmin(super().remaining(now), now.distance + self.behind)

    def ends(self, contact_force: float) -> Sequence[Condition]:
        return [Condition("force", above=contact_force)]


@checked(ModelError)
@dataclass(frozen=True)
class Press(Phase):
    """The force goes smoothly to a goal.

    Attributes:
        force: The goal, in N: a positive number, or a reference, whose time starts with the phase.
        tolerance: The largest error of the force at which the phase ends, in N.
    """

    force: float | Reference
    tolerance: float = 1.0
    holds_contact = True
    begins_in_contact, ends_in_contact = True, True

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("Press: tolerance", self.tolerance)
        if not isinstance(self.force, Reference):
            positive("Press: force", self.force)

    def felt(self, contact_force: float) -> float:
        return contact_force if isinstance(self.force, Reference) else self.force

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return {contact_output: self.force}

    def ends(self, contact_force: float) -> Sequence[Condition]:
        return [Condition("force error", below=self.tolerance)]


class _Lasting(Phase):
    """A phase that ends after its `duration`, in s, or with `until`, which then ends it alone."""

    duration: float | None
    holds_contact = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.duration is not None:
            positive(f"{self.name}: duration", self.duration)
        elif not self.until:
            raise ModelError(f"{self.name}: give a duration, or conditions as until")

    def ends(self, contact_force: float) -> Sequence[Condition]:
        return [Condition("time", above=self.duration)]

    def remaining(self, now: Moment) -> Any:
        return super().remaining(now) if self.until else inf


@checked(ModelError)
@dataclass(frozen=True)
class Move(_Lasting):
    """Outputs follow references, in contact or not, as the phase before.

    With `until: [{of: force, above: 2.0}]` it feels for a surface, wherever that is.

    Attributes:
        references: Name -> reference, whose time starts with the phase, or a number; names as those
            of `references_by_name`. They may include the force or the distance.
        duration: The duration of the phase, in s; not needed with `until`, which ends it alone.
    """

    references: Mapping[str, Reference | float]
    duration: float | None = None

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return self.references


@checked(ModelError)
@dataclass(frozen=True)
class Dwell(_Lasting):
    """All outputs, including the force, come to rest for some time, or until a signal is present.

    Attributes:
        duration: The duration of the phase, in s; not needed with `until`, which ends it alone.
    """

    duration: float | None = None


@checked(ModelError)
@dataclass(frozen=True)
class Release(Phase):
    """The force goes smoothly to zero; the phase ends below the task's contact_force.

    If it has not ended after `over`, a model error holds the tool, such as an unknown weight or an
    integral that is held: then the reference goes on to fall, by 0.5 N/s, until the contact opens.

    The phase is also late if the tool is 20 mm away and a force is still measured, which is then
    the bias of a sensor; see `tare_time` of the task.
    """

    begins_in_contact, ends_in_contact = True, False

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return {contact_output: LineReference([0.0], [_LEAST], _FALL, self.over, order=6)}

    def ends(self, contact_force: float) -> Sequence[Condition]:
        return [Condition("force", below=contact_force)]

    def remaining(self, now: Moment) -> Any:
        return ca.fmin(super().remaining(now), _AWAY - now.away)


@checked(ModelError)
@dataclass(frozen=True)
class Retreat(Phase):
    """The distance goes smoothly to a goal.

    Attributes:
        distance: The goal, in m.
        tolerance: The largest error of the distance at which the phase ends, in m.
    """

    distance: float
    tolerance: float = 1e-3
    begins_in_contact, ends_in_contact = False, False

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("Retreat: distance", self.distance)
        positive("Retreat: tolerance", self.tolerance)

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return {contact_output: self.distance}

    def ends(self, contact_force: float) -> Sequence[Condition]:
        return [Condition("distance error", below=self.tolerance)]
