"""A search along a path, in contact."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import ceil, cos, isfinite, sin
from typing import Literal

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.dae.references import (
    LineReference,
    PathLimits,
    PolylineReference,
    Reference,
    SpiralReference,
)
from drake_dae.errors import ModelError
from drake_dae.systems.task.phases.phase import Moment, Phase

_MOST_LINES = 1000


@checked(ModelError)
@dataclass(frozen=True)
class Search(Phase):
    """The tool slides over the surface from its position until it falls into a hole or off an edge.

    The force stays as it was. The phase succeeds when the distance by the law's model has fallen by
    `depth`, or the contact is lost for the task's `patience`; it fails when its path ends. A
    surface that is tilted relative to the model also changes the distance: the depth must be larger
    than the radius times the tilt.

    The law's model has neither holes nor edges, and a tool that keeps pressing in a hole may be
    pushed out of it. So the robot is free after a fall: an Insert, a Retreat or another phase
    without contact can follow, and the law without contact stops the tool.

    Attributes:
        outputs: The two outputs along the surface, in m: "tool.yz" for example.
        radius: The distance from the start at which the search ends, in m.
        depth: The fall of the distance that ends the search, in m.
        pattern: The path: "spiral", outward around the start; "line", straight along `heading`;
            "raster", lines of length 2 radius across `heading`, one after the other along it.
        heading: The direction of a line or a raster, as an angle from the first of `outputs` to the
            second one, in rad.
        pitch: The distance between neighbouring turns or lines, in m.
        speed: The largest speed, in m/s.
        acceleration: The largest acceleration, in m/s^2.
        over: The duration of the transition from the previous references, in s.
        within: The largest duration of the phase, in s.
        if_late: The successor if the path has ended; on_failure if left out.
    """

    outputs: str
    radius: float
    depth: float = 0.002
    pattern: Literal["spiral", "line", "raster"] = "spiral"
    heading: float = 0.0
    pitch: float = 0.002
    speed: float = 0.02
    acceleration: float = 0.5
    within: float = field(default=60.0, kw_only=True)
    if_late: str | None = field(default=None, kw_only=True)
    begins_in_contact, ends_in_contact, holds_contact = True, False, True
    is_relative, ends_by_loss = True, True

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("radius", "depth", "pitch", "speed", "acceleration"):
            positive(f"Search: {name}", getattr(self, name))
        if not isfinite(self.heading):
            raise ModelError(f"Search: heading must be finite, got {self.heading}")
        if self.pattern == "raster" and self.radius > _MOST_LINES * self.pitch:
            raise ModelError(
                f"Search: a raster has at most {_MOST_LINES} lines; the radius of "
                f"{self.radius:g} m is too large for a pitch of {self.pitch:g} m"
            )

    @cached_property
    def path(self) -> LineReference | SpiralReference | PolylineReference:
        """The path of the tool, relative to its start."""
        limits = PathLimits(self.speed, self.acceleration)
        if self.pattern == "spiral":
            return SpiralReference([0.0, 0.0], 0.0, self.radius, self.pitch, limits)
        ahead = np.array([cos(self.heading), sin(self.heading)])
        if self.pattern == "line":
            return LineReference([0.0, 0.0], self.radius * ahead, limits)
        count = ceil(self.radius / self.pitch) + 1
        ends = [(i * self.pitch, side * (-1) ** i) for i in range(count) for side in (-1, 1)]
        aside = self.radius * np.array([-ahead[1], ahead[0]])
        corners = [(0.0, 0.0), *(along * ahead + side * aside for along, side in ends)]
        return PolylineReference(np.array(corners).tolist(), limits, self.pitch / 4.0)

    @property
    def duration(self) -> float:
        """The duration of the whole search, in s."""
        path = self.path
        travels = path.spline if isinstance(path, PolylineReference) else path.travel
        return travels.duration + self.over

    def goals(self, contact_output: str) -> Mapping[str, Reference | float]:
        return {self.outputs: self.path}

    def margin(self, now: Moment, contact_force: float) -> float:
        return self.depth + now.away

    def remaining(self, now: Moment) -> float:
        remaining: float = ca.fmin(super().remaining(now), self.duration - now.time)
        return remaining

    def lateness(self, now: Moment, contact_force: float) -> str:
        if self.has_waited(now):
            return super().lateness(now, contact_force)
        return f"{self.name} has come to {self.radius:g} m without {self.awaited(contact_force)}"

    def awaited(self, contact_force: float) -> str:
        return f"a fall of {self.depth:g} m"
