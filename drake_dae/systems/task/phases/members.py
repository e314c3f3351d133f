"""The phases of a task: touch, press, move, dwell, let go."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.errors import ModelError
from drake_dae.references import LineReference, PathLimits, Reference
from drake_dae.systems.task.phases.phase import Moment, Phase

_SPEED = 0.05
"""The default speed of an Approach, in m/s."""

_AWAY = 0.02
"""The distance in m from its start at which a Release has left the contact."""

_FALL, _LEAST = PathLimits(0.5, 1.0), -1e3
"""How fast the reference of a Release falls below zero, in N/s and N/s^2, and its least value."""


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
        over: The duration of the transition from the previous references, in s.
        within: The largest duration of the phase, in s.
        if_late: The successor if it lasts longer; on_failure if left out.
    """

    speed: float | None = None
    behind: float = 0.05
    within: float = field(default=60.0, kw_only=True)
    if_late: str | None = field(default=None, kw_only=True)
    begins_in_contact, ends_in_contact = False, True

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("Approach: speed", self.speed_of_approach)
        positive("Approach: behind", self.behind)
        for key in ("if_late", "on_failure"):
            if getattr(self, key) == "approach":
                raise ModelError(
                    f"Approach: {key}: 'approach' would go on as before; choose a phase by its "
                    "name, hold, leave, stop or fail"
                )

    @property
    def speed_of_approach(self) -> float:
        """The speed of the touch, in m/s."""
        return _SPEED if self.speed is None else self.speed

    def rates(self, contact_output: str) -> Mapping[str, float]:
        return {contact_output: -self.speed_of_approach}

    def remaining(self, now: Moment) -> float:
        remaining: float = ca.fmin(super().remaining(now), now.distance + self.behind)
        return remaining

    def lateness(self, now: Moment, contact_force: float) -> str:
        if self.has_waited(now):
            return super().lateness(now, contact_force)
        return (
            f"{self.name} is {-now.distance:.3g} m behind the surface of the model without "
            f"{self.awaits(contact_force)}"
        )

    def margin(self, now: Moment, contact_force: float) -> float:
        return contact_force - now.force

    def awaited(self, contact_force: float) -> str:
        return f"a force of {contact_force:g} N"


@checked(ModelError)
@dataclass(frozen=True)
class Press(Phase):
    """The force goes smoothly to a goal; of several points, the differences of forces to zero.

    Attributes:
        force: The goal, in N: a positive number, or a reference, whose time starts with the phase.
        tolerance: The largest error of the force at which the phase ends, in N.
        over: The duration of the transition from the previous references, in s.
        within: The largest duration of the phase, in s.
        if_late: The successor if it lasts longer; on_failure if left out.
        if_lost: The successor if the contact is lost; on_failure if left out.
    """

    force: float | Reference
    tolerance: float = 1.0
    within: float = field(default=60.0, kw_only=True)
    if_late: str | None = field(default=None, kw_only=True)
    if_lost: str | None = field(default=None, kw_only=True)
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

    def margin(self, now: Moment, contact_force: float) -> float:
        off = abs(now.force - now.wanted)
        margin: float = ca.fmax(self.over - now.time, off - self.tolerance)
        return margin

    def awaited(self, contact_force: float) -> str:
        return f"a force within {self.tolerance:g} N of its reference"


class _Lasting(Phase):
    """A phase that ends after its `duration`."""

    duration: float | None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.duration is not None:
            positive(f"{self.name}: duration", self.duration)
        elif not self.until:
            raise ModelError(f"{self.name}: give a duration, or conditions as until")

    def margin(self, now: Moment, contact_force: float) -> float:
        return (self.duration or 0.0) - now.time

    def remaining(self, now: Moment) -> float:
        return super().remaining(now) if self.until else inf

    def awaited(self, contact_force: float) -> str:
        return f"the end of {self.duration or 0.0:g} s"


@checked(ModelError)
@dataclass(frozen=True)
class Move(_Lasting):
    """Outputs follow references, in contact or not, as the phase before.

    With `until: [{of: force, above: 2.0}]` it feels for a surface, wherever that is.

    Attributes:
        references: Name -> reference, whose time starts with the phase, or a number; names as those
            of `references_by_name`. They may include the force or the distance.
        duration: The duration of the phase, in s; not needed with `until`, which then ends it
            alone.
        over: The duration of the transition from the previous references, in s.
        within: The largest duration of the phase, in s.
        if_late: The successor if it lasts longer; on_failure if left out.
        if_lost: The successor if the contact is lost; on_failure if left out.
    """

    references: Mapping[str, Reference | float]
    duration: float | None = None
    within: float = field(default=60.0, kw_only=True)
    if_late: str | None = field(default=None, kw_only=True)
    if_lost: str | None = field(default=None, kw_only=True)
    holds_contact = True

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return self.references


@checked(ModelError)
@dataclass(frozen=True)
class Dwell(_Lasting):
    """All outputs, including the force, come to rest for some time, or until a signal is present.

    Attributes:
        duration: The duration of the phase, in s; not needed with `until`, which then ends it
            alone.
        over: The duration of the transition from the previous references, in s.
        within: The largest duration of the phase, in s.
        if_late: The successor if it lasts longer; on_failure if left out.
        if_lost: The successor if the contact is lost; on_failure if left out.
    """

    duration: float | None = None
    within: float = field(default=60.0, kw_only=True)
    if_late: str | None = field(default=None, kw_only=True)
    if_lost: str | None = field(default=None, kw_only=True)
    holds_contact = True


@checked(ModelError)
@dataclass(frozen=True)
class Release(Phase):
    """The force goes smoothly to zero; the phase ends below the task's contact_force.

    If it has not ended after `over`, a model error holds the tool, such as an unknown weight or an
    integral that is held: then the reference goes on to fall, by 0.5 N/s, until the contact opens.

    The phase is also late if the tool is 20 mm away and a force is still measured, which is then
    the bias of a sensor.

    Attributes:
        over: The duration of the transition from the previous references, in s.
        within: The largest duration of the phase, in s.
        if_late: The successor if it lasts longer; on_failure if left out.
    """

    within: float = field(default=60.0, kw_only=True)
    if_late: str | None = field(default=None, kw_only=True)
    begins_in_contact, ends_in_contact = True, False

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return {contact_output: LineReference([0.0], [_LEAST], _FALL, self.over, order=6)}

    def margin(self, now: Moment, contact_force: float) -> float:
        return now.force - contact_force

    def remaining(self, now: Moment) -> float:
        remaining: float = ca.fmin(super().remaining(now), _AWAY - now.away)
        return remaining

    def lateness(self, now: Moment, contact_force: float) -> str:
        if self.has_waited(now):
            return super().lateness(now, contact_force)
        return (
            f"{self.name} has gone {now.away:.3g} m away, and a force of {now.force:.3g} N is "
            "still measured, as by a sensor with a bias; see tare_time"
        )

    def awaited(self, contact_force: float) -> str:
        return f"a force of no more than {contact_force:g} N"


@checked(ModelError)
@dataclass(frozen=True)
class Retreat(Phase):
    """The distance goes smoothly to a goal.

    Attributes:
        distance: The goal, in m.
        tolerance: The largest error of the distance at which the phase ends, in m.
        over: The duration of the transition from the previous references, in s.
        within: The largest duration of the phase, in s.
        if_late: The successor if it lasts longer; on_failure if left out.
    """

    distance: float
    tolerance: float = 1e-3
    within: float = field(default=60.0, kw_only=True)
    if_late: str | None = field(default=None, kw_only=True)
    begins_in_contact, ends_in_contact = False, False

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("Retreat: distance", self.distance)
        positive("Retreat: tolerance", self.tolerance)

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return {contact_output: self.distance}

    def margin(self, now: Moment, contact_force: float) -> float:
        off = abs(now.distance - self.distance)
        margin: float = ca.fmax(self.over - now.time, off - self.tolerance)
        return margin

    def awaited(self, contact_force: float) -> str:
        return f"a distance within {self.tolerance:g} m of {self.distance:g} m"
