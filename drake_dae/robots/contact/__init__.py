"""What a robot touches or holds: constraints, and the surfaces that they are about."""

from drake_dae.robots.contact.constraint import Application, Constraint
from drake_dae.robots.contact.points import CoincidentPoints, PointOnSurface
from drake_dae.robots.contact.surface import Surface
from drake_dae.robots.contact.welds import WeldedFrames

__all__ = [
    "Application",
    "CoincidentPoints",
    "Constraint",
    "PointOnSurface",
    "Surface",
    "WeldedFrames",
]
