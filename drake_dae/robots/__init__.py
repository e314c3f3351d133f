"""Section 3 of the paper: links, constraints, surfaces, actuation and outputs of a robot."""

from drake_dae.robots.actuation import DcMotors, ElectrohydraulicServos, FlexibleJoints, Stage
from drake_dae.robots.actuation.chain import chain
from drake_dae.robots.actuation.stage import AttachedStage
from drake_dae.robots.constraint_wrenches import (
    ConstraintWrenches,
    Wrenches,
    contact_normals,
    own_values,
)
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
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.constraints.friction import FrictionCone
from drake_dae.robots.constraints.plant_constraints import Coupling, couplings_of, plant_constraints
from drake_dae.robots.control_choice import control_choice
from drake_dae.robots.force_outputs import (
    ForceCombination,
    ForceOutput,
    NamedForce,
    Squeeze,
    as_force_outputs,
    force_rows,
)
from drake_dae.robots.joint_friction import JointFriction
from drake_dae.robots.known_forces import KnownForce, KnownWrench, Load, ScaledForce
from drake_dae.robots.link_depths import LinkBehind, LinkDepths, links_behind
from drake_dae.robots.links.frames import frame_name, frame_named, joint_names, unique_names
from drake_dae.robots.links.kinematics import Frames, Kinematics, Reaction
from drake_dae.robots.links.links import Links, velocities_are_rates
from drake_dae.robots.links.multibody import MultibodyExpressions
from drake_dae.robots.links.textbook import LinkExpressions
from drake_dae.robots.loop_state import LoopState
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
from drake_dae.robots.surfaces.surface import (
    Pair,
    Surface,
    Vector,
    axes_along,
    rotation_of,
    tangents,
    triple,
)
from drake_dae.robots.surfaces.surfaces import Cylinder, Ellipsoid, Plane, Sphere, Torus

__all__ = [
    "Application",
    "AttachedStage",
    "AxisCoordinates",
    "AxisNormalToSurface",
    "Blade",
    "CoincidentPoints",
    "Constraint",
    "ConstraintSet",
    "ConstraintWrenches",
    "Coupling",
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
    "LinkBehind",
    "LinkDepths",
    "LinkExpressions",
    "Links",
    "Load",
    "LoopState",
    "MeasuredSurface",
    "MultibodyExpressions",
    "NamedForce",
    "Pair",
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
    "ScaledForce",
    "Sphere",
    "Squeeze",
    "Stage",
    "Surface",
    "SurfaceCoordinates",
    "TiltFromNormal",
    "Torus",
    "Touch",
    "Vector",
    "WeldedFrames",
    "Wrenches",
    "as_force_outputs",
    "axes_along",
    "chain",
    "contact_normals",
    "control_choice",
    "couplings_of",
    "force_rows",
    "frame_name",
    "frame_named",
    "joint_names",
    "links_behind",
    "own_values",
    "plant_constraints",
    "rotation_of",
    "tangents",
    "triple",
    "unique_names",
    "velocities_are_rates",
]
