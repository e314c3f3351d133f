"""A move until contact, and waiting for a signal."""

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
    """The tool moves in a straight line at constant speed until it measures a force.

    It fails if it has moved its largest distance without that. Unlike an Approach it uses the force
    alone; the position of the surface in the law's model does not matter.

    Attributes:
        distance: The largest distance of the move, in m.
        speed: The speed, in m/s.
        force: The force that ends it, in N; the task's contact_force if left out.
        direction: Output -> component of the direction; for outputs in m, including the distance
            from the surface. Straight towards the surface if left out.
        over: The duration of the transition from the previous references, in s.
        within: The largest duration of the phase, in s.
        if_late: The successor if it has moved so far or lasts longer; on_failure if left out.
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
        remaining: float = ca.fmin(super().remaining(now), self.distance - now.travel)
        return remaining

    def lateness(self, now: Moment, contact_force: float) -> str:
        if self.has_waited(now):
            return super().lateness(now, contact_force)
        return f"{self.name} has moved {now.travel:.3g} m without {self.awaited(contact_force)}"

    def awaited(self, contact_force: float) -> str:
        return f"a force of {self.felt(contact_force):g} N"


@checked(ModelError)
@dataclass(frozen=True)
class Wait(Phase):
    """All outputs, including the force, come to rest until a signal is present.

    Attributes:
        for_signal: The name of the signal, which is present above 1/2. In Python it is the input
            port signal_<name> of the controller and of its loop, in a scenario one of
            task.signals. Empty for no signal.
        duration: The time in s after which it ends without the signal; None for never.
        over: The duration of the transition from the previous references, in s.
        within: The largest duration of the phase, in s.
        if_late: The successor if it lasts longer; on_failure if left out.
        if_lost: The successor if the contact is lost; on_failure if left out.
    """

    for_signal: str = ""
    duration: float | None = None
    within: float = field(default=60.0, kw_only=True)
    if_late: str | None = field(default=None, kw_only=True)
    if_lost: str | None = field(default=None, kw_only=True)
    holds_contact, for_latch = True, True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.duration is not None:
            positive("Wait: duration", self.duration)
        elif not self.for_signal:
            raise ModelError("Wait: give the signal that it waits for, for_signal, or a duration")

    @property
    def signal(self) -> str:
        return self.for_signal

    def needed(self, contact_force: float) -> Mapping[str, float]:
        return {} if self.signal or self.duration is None else {"time": self.duration}

    def margin(self, now: Moment, contact_force: float) -> float:
        signal: float = 0.5 - now.signal if self.signal else 1.0
        if self.duration is None:
            return signal
        margin: float = ca.fmin(signal, self.duration - now.time)
        return margin

    def awaited(self, contact_force: float) -> str:
        parts = [f"the signal {self.signal}"] if self.signal else []
        parts += [f"the end of {self.duration:g} s"] if self.duration is not None else []
        return " or ".join(parts)
