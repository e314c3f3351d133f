"""Section 3 of the paper: links, constraints, surfaces, actuation and outputs of a robot."""

from drake_dae.robots.actuation import DcMotors, ElectrohydraulicServos, FlexibleJoints, Stage
from drake_dae.robots.actuation.stage import AttachedStage
from drake_dae.robots.constraint_wrenches import ConstraintWrenches
from drake_dae.robots.constraints import (
    Application,
    AxisNormalToSurface,
    Blade,
    CoincidentPoints,
    Constraint,
    FixedDistance,
    Joint,
    JointCoupler,
    PointOnSurface,
    PrismaticLoopJoint,
    RevoluteLoopJoint,
    RollingBall,
    RollingWheel,
    WeldedFrames,
)
from drake_dae.robots.constraints.constraint import Touch
from drake_dae.robots.constraints.friction import FrictionCone
from drake_dae.robots.force_outputs import ForceCombination, ForceOutput, NamedForce, Squeeze
from drake_dae.robots.joint_friction import JointFriction
from drake_dae.robots.known_forces import KnownForce, KnownWrench, Load
from drake_dae.robots.links.kinematics import Frames, Kinematics, Reaction
from drake_dae.robots.links.links import Links
from drake_dae.robots.links.multibody import MultibodyExpressions
from drake_dae.robots.links.textbook import LinkExpressions
from drake_dae.robots.model import RobotModel
from drake_dae.robots.outputs import (
    AxisCoordinates,
    ExpressionOutput,
    JointPositions,
    PointCoordinates,
    PositionOutput,
    SurfaceCoordinates,
    TiltFromNormal,
)
from drake_dae.robots.surfaces.implicit import ImplicitSurface
from drake_dae.robots.surfaces.measured import MeasuredSurface
from drake_dae.robots.surfaces.picture import PosedShape
from drake_dae.robots.surfaces.surface import Surface
from drake_dae.robots.surfaces.surfaces import Cylinder, Ellipsoid, Plane, Sphere, Torus

__all__ = [
    "Application",
    "AttachedStage",
    "AxisCoordinates",
    "AxisNormalToSurface",
    "Blade",
    "CoincidentPoints",
    "Constraint",
    "ConstraintWrenches",
    "Cylinder",
    "DcMotors",
    "ElectrohydraulicServos",
    "Ellipsoid",
    "ExpressionOutput",
    "FixedDistance",
    "FlexibleJoints",
    "ForceCombination",
    "ForceOutput",
    "Frames",
    "FrictionCone",
    "ImplicitSurface",
    "Joint",
    "JointCoupler",
    "JointFriction",
    "JointPositions",
    "Kinematics",
    "KnownForce",
    "KnownWrench",
    "LinkExpressions",
    "Links",
    "Load",
    "MeasuredSurface",
    "MultibodyExpressions",
    "NamedForce",
    "Plane",
    "PointCoordinates",
    "PointOnSurface",
    "PosedShape",
    "PositionOutput",
    "PrismaticLoopJoint",
    "Reaction",
    "RevoluteLoopJoint",
    "RobotModel",
    "RollingBall",
    "RollingWheel",
    "Sphere",
    "Squeeze",
    "Stage",
    "Surface",
    "SurfaceCoordinates",
    "TiltFromNormal",
    "Torus",
    "Touch",
    "WeldedFrames",
]
