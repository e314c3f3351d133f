"""What a robot touches or holds: constraints, and the surfaces that they are about."""

from drake_dae.robots.contact.alignment import AxisNormalToSurface
from drake_dae.robots.contact.constraint import Application, Constraint, Joint
from drake_dae.robots.contact.couplers import JointCoupler
from drake_dae.robots.contact.loop_joints import PrismaticLoopJoint, RevoluteLoopJoint
from drake_dae.robots.contact.points import CoincidentPoints, FixedDistance, PointOnSurface
from drake_dae.robots.contact.rolling import Blade, RollingBall, RollingWheel
from drake_dae.robots.contact.surface import Surface
from drake_dae.robots.contact.welds import WeldedFrames

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
