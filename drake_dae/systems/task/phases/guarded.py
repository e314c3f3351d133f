"""A move until a force is felt, and waiting for a signal."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import hypot

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.errors import ModelError
from drake_dae.systems.task.phases.phase import Moment, Phase


@checked(ModelError)
@dataclass(frozen=True)
class GuardedMove(Phase):
    """The tool moves straight on at a constant speed until a force is felt.

    It fails where it has moved a distance without that. Unlike an Approach it decides by the force
    alone, and the place of the surface in the law's model does not matter.

    Attributes:
        distance: How far it may move, in m.
        speed: How fast, in m/s.
        force: The force that ends it, in N; the task's contact_force if left out.
        direction: Output -> component of the direction; outputs in m, the distance from the
            surface among them. Straight towards the surface if left out.
        over: How long the references before take to become those of this phase, in s.
        within: How long the phase may last, in s.
        if_late: What follows where it has moved so far, or so long; as on_failure if left out.
    """

    distance: float
    speed: float = 0.02
    force: float | None = None
    direction: Mapping[str, float] = field(default_factory=dict)
    within: float = field(default=60.0, kw_only=True)
    if_late: str | None = field(default=None, kw_only=True)
    begins_in_contact, ends_in_contact = False, True

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("GuardedMove: distance", self.distance)
        positive("GuardedMove: speed", self.speed)
        if self.force is not None:
            positive("GuardedMove: force", self.force)
        if self.direction and not self._length:
            raise ModelError("GuardedMove: direction: all of its components are 0")

    @property
    def _length(self) -> float:
        return hypot(*self.direction.values())

    @property
    def speed_of_approach(self) -> float:
        return self.speed

    def rates(self, contact_output: str) -> Mapping[str, float]:
        if not self.direction:
            return {contact_output: -self.speed}
        speed = self.speed / self._length
        return {name: speed * part for name, part in self.direction.items()}

    def felt(self, contact_force: float) -> float:
        return contact_force if self.force is None else self.force

    def needed(self, contact_force: float) -> Mapping[str, float]:
        return {"force": self.felt(contact_force)}

    def margin(self, now: Moment, contact_force: float) -> float:
        return self.felt(contact_force) - now.force

    def remaining(self, now: Moment) -> float:
        found: float = ca.fmin(super().remaining(now), self.distance - now.travel)
        return found

    def lateness(self, now: Moment, contact_force: float) -> str:
        if now.time >= self.within:
            return super().lateness(now, contact_force)
        return f"{self.name} has moved {now.travel:.3g} m without {self.awaited(contact_force)}"

    def awaited(self, contact_force: float) -> str:
        return f"a force of {self.felt(contact_force):g} N"


@checked(ModelError)
@dataclass(frozen=True)
class Wait(Phase):
    """All outputs come to rest where they are, the force too, until a signal comes.

    Attributes:
        for_signal: The name of the signal; it has come where it is above 1/2. In Python it is the
            input port signal_<name> of the controller and of its loop, in a scenario one of
            task.signals. Empty for no signal.
        duration: After this time it is over also without the signal, in s; None for never.
        over: How long the references before take to become those of this phase, in s.
        within: It fails after so long, in s.
        if_late: What follows where it lasts longer; as on_failure if left out.
        if_lost: What follows where the contact is lost; as on_failure if left out.
    """

    for_signal: str = ""
    duration: float | None = None
    within: float = field(default=60.0, kw_only=True)
    if_late: str | None = field(default=None, kw_only=True)
    if_lost: str | None = field(default=None, kw_only=True)
    holds_contact = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.duration is not None:
            positive("Wait: duration", self.duration)
        elif not self.for_signal:
            raise ModelError("Wait: give the signal for which it waits, for_signal, or a duration")

    @property
    def signal(self) -> str:
        return self.for_signal

    def needed(self, contact_force: float) -> Mapping[str, float]:
        return {} if self.signal or self.duration is None else {"time": self.duration}

    def margin(self, now: Moment, contact_force: float) -> float:
        signal: float = 0.5 - now.signal if self.signal else 1.0
        if self.duration is None:
            return signal
        found: float = ca.fmin(signal, self.duration - now.time)
        return found

    def awaited(self, contact_force: float) -> str:
        parts = [f"the signal {self.signal}"] if self.signal else []
        parts += [f"the end of {self.duration:g} s"] if self.duration is not None else []
        return " or ".join(parts)
