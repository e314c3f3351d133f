"""A search along a spiral, in contact."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.dae.references import PathLimits, Reference, SpiralReference
from drake_dae.errors import ModelError
from drake_dae.systems.task.phases.phase import Moment, Phase


@checked(ModelError)
@dataclass(frozen=True)
class Search(Phase):
    """The tool slides outward along a spiral around its position until it falls into something.

    The force stays as it was. The phase succeeds when the distance by the law's model has fallen by
    `depth`, as in a hole or beyond an edge with a ground below it; it fails when the spiral ends. A
    surface that is tilted relative to the model also changes the distance: the depth must be larger
    than the radius times the tilt.

    The law's model has no hole. A tool that keeps pressing in a steep one may be pushed out of it
    (in a dimple 4 mm deep and 3 mm wide after 0.5 s), so choose a Release, "leave" or "stop" as the
    successor.

    Attributes:
        outputs: The two outputs along the surface, in m: "tool.yz" for example.
        radius: The radius at which the search ends, in m.
        depth: The fall of the distance that ends the search, in m.
        pitch: The distance between neighbouring turns, in m.
        speed: The largest speed, in m/s.
        acceleration: The largest acceleration, in m/s^2.
        over: The duration of the transition from the previous references, in s.
        within: The largest duration of the phase, in s.
        if_late: The successor if the spiral has ended; on_failure if left out.
        if_lost: The successor if the contact is lost; on_failure if left out.
    """

    outputs: str
    radius: float
    depth: float = 0.002
    pitch: float = 0.002
    speed: float = 0.02
    acceleration: float = 0.5
    within: float = field(default=60.0, kw_only=True)
    if_late: str | None = field(default=None, kw_only=True)
    if_lost: str | None = field(default=None, kw_only=True)
    begins_in_contact, ends_in_contact, holds_contact = True, True, True
    is_relative = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("radius", "depth", "pitch", "speed", "acceleration"):
            positive(f"Search: {name}", getattr(self, name))

    @cached_property
    def spiral(self) -> SpiralReference:
        """The path of the tool, relative to its start."""
        limits = PathLimits(self.speed, self.acceleration)
        return SpiralReference([0.0, 0.0], 0.0, self.radius, self.pitch, limits)

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return {self.outputs: self.spiral}

    def margin(self, now: Moment, contact_force: float) -> float:
        return self.depth + now.away

    def remaining(self, now: Moment) -> float:
        end = self.spiral.travel.duration + self.over - now.time
        remaining: float = ca.fmin(super().remaining(now), end)
        return remaining

    def lateness(self, now: Moment, contact_force: float) -> str:
        if self.has_waited(now):
            return super().lateness(now, contact_force)
        return f"{self.name} has come to {self.radius:g} m without {self.awaited(contact_force)}"

    def awaited(self, contact_force: float) -> str:
        return f"a fall of {self.depth:g} m"
