"""The public names, in the order of the paper; they are loaded when they are asked for.

All else is imported from its room, as `from drake_dae.robots import RollingBall`.
"""

from . import errors as errors
from .dae import (
    DaeSystem as DaeSystem,
    Signal as Signal,
    Parameter as Parameter,
    find_structure as find_structure,
    NormalForm as NormalForm,
    ZeroDynamics as ZeroDynamics,
    dynamic_extension as dynamic_extension,
    linearize as linearize,
    drop_constraints as drop_constraints,
    share_forces as share_forces,
    TrackingLaw as TrackingLaw,
    poles as poles,
)
from .references import (
    Reference as Reference,
    ConstantReference as ConstantReference,
    LineReference as LineReference,
    PolylineReference as PolylineReference,
    CircleReference as CircleReference,
    SinusoidReference as SinusoidReference,
    PointToPointReference as PointToPointReference,
    WaypointsReference as WaypointsReference,
    ExpressionReference as ExpressionReference,
    CsvReference as CsvReference,
)
from .robots import (
    RobotModel as RobotModel,
    LinkExpressions as LinkExpressions,
    Constraint as Constraint,
    PointOnSurface as PointOnSurface,
    FixedDistance as FixedDistance,
    CoincidentPoints as CoincidentPoints,
    WeldedFrames as WeldedFrames,
    JointCoupler as JointCoupler,
    AxisNormalToSurface as AxisNormalToSurface,
    RevoluteLoopJoint as RevoluteLoopJoint,
    PrismaticLoopJoint as PrismaticLoopJoint,
    RollingWheel as RollingWheel,
    Surface as Surface,
    Plane as Plane,
    Sphere as Sphere,
    Cylinder as Cylinder,
    Ellipsoid as Ellipsoid,
    Torus as Torus,
    ImplicitSurface as ImplicitSurface,
    MeasuredSurface as MeasuredSurface,
    Stage as Stage,
    FlexibleJoints as FlexibleJoints,
    DcMotors as DcMotors,
    ElectrohydraulicServos as ElectrohydraulicServos,
    JointPositions as JointPositions,
    PointCoordinates as PointCoordinates,
    AxisCoordinates as AxisCoordinates,
    SurfaceCoordinates as SurfaceCoordinates,
    TiltFromNormal as TiltFromNormal,
    ExpressionOutput as ExpressionOutput,
    ForceOutput as ForceOutput,
    ForceCombination as ForceCombination,
    Squeeze as Squeeze,
    JointFriction as JointFriction,
)
from .blocks import (
    Block as Block,
    TracedSystem as TracedSystem,
    compile_diagram as compile_diagram,
    from_symbolic as from_symbolic,
)
from .systems import (
    DaePlant as DaePlant,
    RobotPlant as RobotPlant,
    CompliantPlant as CompliantPlant,
    ContactPlant as ContactPlant,
    ContactMaterial as ContactMaterial,
    TrackingController as TrackingController,
    ReferenceGenerator as ReferenceGenerator,
    Sampling as Sampling,
    ControlLimits as ControlLimits,
    Encoders as Encoders,
    ForceSensor as ForceSensor,
    StateEstimator as StateEstimator,
    Task as Task,
    TaskController as TaskController,
    Phase as Phase,
    Move as Move,
    Approach as Approach,
    Press as Press,
    Dwell as Dwell,
    Release as Release,
    Retreat as Retreat,
)
from .diagrams import (
    make_closed_loop as make_closed_loop,
    ClosedLoop as ClosedLoop,
    Record as Record,
)
from .scene import start_meshcat as start_meshcat
from .analysis.analyze import analyze as analyze
from .analysis.contact_gains import contact_gains as contact_gains
from .running.simulate import simulate as simulate
from .running.rollout.rollout import rollout as rollout
from .running import (
    export_controller as export_controller,
    write_page as write_page,
)
from .pictures import (
    plot_runs as plot_runs,
    make_animation as make_animation,
)
from .scenario import (
    Scenario as Scenario,
    load_scenario as load_scenario,
    build_scenario as build_scenario,
    new_scenario as new_scenario,
    shipped_model as shipped_model,
)
from .studies.sweep import sweep as sweep

__version__: str
