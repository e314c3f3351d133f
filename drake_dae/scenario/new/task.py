"""The task at a place: a surface, a circle on it, and a force."""

from dataclasses import dataclass
from math import ceil, isfinite, log10, pi
from typing import Literal

import numpy as np

from drake_dae.references import CircleReference, SinusoidReference
from drake_dae.robots.surfaces.surface import Surface, Vector
from drake_dae.robots.surfaces.surfaces import Cylinder, Plane, Sphere
from drake_dae.scenario.new.places import TipPlace

SurfaceKind = Literal["plane", "cylinder", "sphere"]

Path = CircleReference | SinusoidReference

SHORTEST = 5.0
"""The shortest period of a circle, in s."""

_RADIUS, _BEND, _FORCE = 0.08, 0.4, 20.0
"""The radii of the circle and of a curved surface, relative to the robot's size; and the largest
force, N."""


@dataclass(frozen=True, eq=False)
class NewTask:
    """A circle on a surface.

    Attributes:
        place: The place of the surface.
        name: The name of the surface.
        surface: The surface.
        center: The point of the surface in the middle, m, rounded.
        radius: The radius of the circle, seen along the normal, m.
        period: The duration of a turn, s.
        force: The force of the tip, N.
    """

    place: TipPlace
    name: str
    surface: Surface
    center: Vector
    radius: float
    period: float
    force: float

    def references(self, tip: str) -> dict[str, Path | float]:
        """The circle of a frame, or the line if only one direction is free, and the force."""
        ways, middle = self.place.ways, [self.center[way] for way in self.place.ways]
        path: Path
        if len(ways) > 1:
            path = CircleReference(middle, self.radius, period=self.period)
        else:
            path = SinusoidReference(middle[0], [self.radius], [round(2 * pi / self.period, 4)])
        along = "".join("xyz"[way] for way in ways)
        return {f"{tip}.{along}": path, f"{self.name}.force": self.force}

    @property
    def path(self) -> str:
        """The path of the tip."""
        return "circle" if len(self.place.ways) > 1 else "line"


def circle(place: TipPlace, kind: SurfaceKind, fraction: float) -> NewTask:
    """A circle at a place, with a fraction of the usual radius and force."""
    decimals = 2 if place.size > 0.3 else 3
    x, y, z = (round(float(value), decimals) + 0.0 for value in place.point)
    center = (x, y, z)
    radius = _round_number(fraction * _RADIUS * place.size)
    force = _round_number(fraction * min(_FORCE, place.force))
    period = SHORTEST
    if isfinite(place.speed):
        period = max(period, float(ceil(2 * pi * radius / place.speed)))
    bend = round(_BEND * place.size, decimals)
    middle = np.round(np.array(center) - bend * np.array(place.normal), decimals) + 0.0
    inner = (float(middle[0]), float(middle[1]), float(middle[2]))
    surface: Surface = Plane(center, place.normal)
    name = {1.0: "table", -1.0: "ceiling"}[place.sign] if place.axis == 2 else "wall"
    if kind == "sphere":
        name, surface = "ball", Sphere(inner, bend)
    elif kind == "cylinder":
        # A planar robot moves around the cylinder, others also along it.
        along = place.ways[-1] if len(place.ways) > 1 else 3 - place.axis - place.ways[0]
        i, j, k = np.eye(3)[along].tolist()
        name, surface = "pipe", Cylinder(inner, (i, j, k), bend)
    return NewTask(place, name, surface, center, radius, period, force)


def _round_number(value: float) -> float:
    """The largest of 1, 2, 3, 5, 8 times a power of ten that is not above a value."""
    power = 10.0 ** int(np.floor(log10(value)))
    return max(float(f"{k * power:.3g}") for k in (1, 2, 3, 5, 8) if k * power <= value * 1.001)
