"""Driving a screw: turn and press."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import copysign, isfinite, pi

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.dae.references import LineReference, PathLimits, Reference
from drake_dae.errors import ModelError
from drake_dae.systems.task.phases.phase import Moment, Phase

_BEGUN = 0.25
"""The part of `turns` before which a torque is no tight screw."""


@checked(ModelError)
@dataclass(frozen=True)
class Screw(Phase):
    """The tool turns a screw and presses, until the screw is tight or has turned far enough.

    The force stays as it was, and an output turns along phi(t), from rest to rest. A screw with the
    pitch p advances by p phi / (2 pi), which is the fall of the distance since the phase began. The
    phase succeeds at the torque, or after all turns if no torque is given. It fails

    - if the advance falls behind p phi / (2 pi) by more than `lag`, as with a cross-threaded screw
      or a bit that slips;
    - at the torque before a quarter of the turns' advance, as with a screw that jams;
    - after all turns without the torque.

    The law's model may have the head as a `ScrewHead`, or as a plane at rest, which costs little at
    the low speeds of screws.

    Attributes:
        turn: The output that turns the tool, in rad: "joint7" for example.
        pitch: The advance per turn, in m.
        turns: The number of turns; negative if the output falls.
        control: The name of the control whose magnitude is the torque, such as that of the joint
            that turns; needed with a torque.
        torque: The torque at which the screw is tight, in N m; None for an end by the turns.
        speed: The largest speed of the output, in rad/s.
        acceleration: The largest acceleration of the output, in rad/s^2.
        lag: The largest lag of the advance, in m.
        over: The duration of the transition from the previous references, in s.
        within: The largest duration of the phase, in s.
        if_late: The successor if it fails in one of these ways or lasts longer; on_failure if left
            out.
        if_lost: The successor if the contact is lost for the `patience` of the task before the
            advance lags; on_failure if left out.
    """

    turn: str
    pitch: float
    turns: float
    control: str = ""
    torque: float | None = None
    speed: float = 3.0
    acceleration: float = 10.0
    lag: float = 5e-4
    within: float = field(default=60.0, kw_only=True)
    if_late: str | None = field(default=None, kw_only=True)
    if_lost: str | None = field(default=None, kw_only=True)
    begins_in_contact, ends_in_contact, holds_contact = True, True, True
    is_relative = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("pitch", "speed", "acceleration", "lag"):
            positive(f"Screw: {name}", getattr(self, name))
        if not isfinite(self.turns) or self.turns == 0.0:
            raise ModelError(f"Screw: turns must be finite and not 0, got {self.turns}")
        if self.torque is not None:
            positive("Screw: torque", self.torque)
            if not self.control:
                raise ModelError("Screw: a torque needs the name of its control, such as 'joint7'")

    @cached_property
    def path(self) -> LineReference:
        """The angle of the output relative to its start."""
        limits = PathLimits(self.speed, self.acceleration)
        return LineReference([0.0], [2.0 * pi * self.turns], limits)

    @property
    def duration(self) -> float:
        """The duration of all turns, in s."""
        return self.path.travel.duration + self.over

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return {self.turn: self.path}

    @cached_property
    def _turns(self) -> ca.Function:
        """The turns after a time in s, by the reference."""
        time = ca.SX.sym("t")
        turns = self.path.expression([0], time) / (2.0 * pi) * copysign(1.0, self.turns)
        return ca.Function("turns", [time], [turns])

    def _turned(self, time: float) -> float:
        """The turns after a time in s; an expression if the time is one."""
        turns = self._turns(time)
        return turns if isinstance(time, ca.SX) else float(turns)

    @property
    def measured_control(self) -> str:
        return self.control

    def margin(self, now: Moment, contact_force: float) -> float:
        if self.torque is None:
            return self.duration - now.time
        missing = self._least + now.away
        margin: float = ca.fmax(self.torque - now.torque, missing)
        return margin

    @property
    def _least(self) -> float:
        """The advance in m from which on a torque is a tight screw."""
        return _BEGUN * self.pitch * abs(self.turns)

    def remaining(self, now: Moment) -> float:
        behind = self.pitch * self._turned(now.time) + now.away
        remaining: float = ca.fmin(super().remaining(now), self.lag - behind)
        if self.torque is None:
            return remaining
        jams = ca.fmax(self.torque - now.torque, -now.away - self._least)
        remaining = ca.fmin(ca.fmin(remaining, jams), self.duration - now.time)
        return remaining

    def lateness(self, now: Moment, contact_force: float) -> str:
        turned, advance = self._turned(now.time), -now.away
        where = f"after {turned:.3g} turns and an advance of {advance:.3g} m"
        if self.pitch * turned - advance >= self.lag:
            return (
                f"{self.name} {where}: the thread of {self.pitch:g} m per turn would advance by "
                f"{self.pitch * turned:.3g} m; the screw is cross-threaded, or the bit slips"
            )
        if self.torque is not None and now.torque >= self.torque:
            return (
                f"{self.name} {where}: a torque of {now.torque:.3g} before an advance of "
                f"{self._least:.3g} m; the screw jams"
            )
        if self.torque is not None and now.time >= self.duration:
            return f"{self.name} {where}: the torque is {now.torque:.3g}, and the screw not tight"
        return super().lateness(now, contact_force)

    def awaited(self, contact_force: float) -> str:
        if self.torque is None:
            return f"{abs(self.turns):g} turns"
        return f"a torque of {self.torque:g}"
