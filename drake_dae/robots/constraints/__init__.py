"""Constraints of a robot: contacts, grasps, loops and couplings."""

from drake_dae.robots.constraints.alignment import AxisNormalToSurface
from drake_dae.robots.constraints.constraint import Application, Constraint, Joint
from drake_dae.robots.constraints.couplers import JointCoupler
from drake_dae.robots.constraints.loop_joints import PrismaticLoopJoint, RevoluteLoopJoint
from drake_dae.robots.constraints.points import FixedDistance, PointOnSurface
from drake_dae.robots.constraints.rolling import Blade, RollingBall, RollingWheel
from drake_dae.robots.constraints.welds import CoincidentPoints, WeldedFrames
from drake_dae.robots.surfaces.surface import Surface

__all__ = [
    "Application",
    "AxisNormalToSurface",
    "Blade",
    "CoincidentPoints",
    "Constraint",
    "FixedDistance",
    "Joint",
    "JointCoupler",
    "PointOnSurface",
    "PrismaticLoopJoint",
    "RevoluteLoopJoint",
    "RollingBall",
    "RollingWheel",
    "Surface",
    "WeldedFrames",
]
