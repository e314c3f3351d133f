"""What stands in a scenario for the types in annotations. A new member is one line here."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from casadi import SX
from numpy.typing import ArrayLike
from pydrake.systems.analysis import SimulatorConfig

from drake_dae import references, robots
from drake_dae.scenario import plants
from drake_dae.scenario.forms import values
from drake_dae.scenario.forms.forms import Family, Key, keys_of
from drake_dae.scenario.parts import parts, written
from drake_dae.systems.task import phases


def _family(*classes: type, plain: type | None = None) -> Family:
    return Family({f"!{cls.__name__.removesuffix('Form')}": cls for cls in classes}, plain)


_REFERENCES: dict[str, type] = {
    "!Constant": references.ConstantReference,
    "!Sinusoids": references.SinusoidReference,
    "!PointToPoint": references.PointToPointReference,
    "!Line": references.LineReference,
    "!Circle": references.CircleReference,
    "!Spiral": references.SpiralReference,
    "!Polyline": references.PolylineReference,
    "!Waypoints": references.WaypointsReference,
    "!Csv": references.CsvReference,
}

FAMILIES: dict[type, Family] = {
    robots.Surface: _family(
        robots.Plane,
        robots.Sphere,
        robots.Cylinder,
        robots.Ellipsoid,
        robots.Torus,
        robots.ImplicitSurface,
        robots.MeasuredSurface,
    ),
    robots.Constraint: _family(
        robots.PointOnSurface,
        written.WeldedFramesForm,
        robots.CoincidentPoints,
        robots.FixedDistance,
        robots.JointCoupler,
        robots.RevoluteLoopJoint,
        robots.PrismaticLoopJoint,
        robots.AxisNormalToSurface,
        robots.Blade,
        robots.RollingWheel,
        robots.RollingBall,
    ),
    robots.PositionOutput: _family(
        robots.PointCoordinates,
        robots.AxisCoordinates,
        written.SurfaceCoordinatesForm,
        written.TiltFromNormalForm,
        robots.JointPositions,
    ),
    robots.ForceOutput: _family(robots.Squeeze, robots.ForceCombination, plain=str),
    robots.Stage: _family(robots.FlexibleJoints, robots.DcMotors, robots.ElectrohydraulicServos),
    references.Reference: Family(_REFERENCES, float),
    robots.Load: _family(robots.KnownForce, robots.JointFriction),
    plants.ScenarioPlant: _family(
        plants.IdealConstraints, plants.MultibodyPlant, plants.CompliantContact, plants.OwnPlant
    ),
    parts.Gains: _family(parts.Poles, parts.Coefficients, parts.Matrices),
    phases.Phase: _family(
        phases.Approach, phases.Press, phases.Move, phases.Dwell, phases.Release, phases.Retreat
    ),
}

VALUES: dict[Any, Any] = {
    Callable[..., SX] | str: str,
    str | Path: Annotated[Any, values.FILE],
    str | Sequence[str]: Annotated[Any, values.NAMES],
    float | list[float]: Annotated[Any, values.NUMBER_OR_LIST],
    ArrayLike: Annotated[Any, values.NUMBERS],
    robots.Vector: Annotated[Any, values.TRIPLE],
    robots.Pair: Annotated[Any, values.PAIR],
}

_CONFIG = {
    "integration_scheme": ("runge_kutta5", "One of Drake's: runge_kutta5, runge_kutta3, radau3"),
    "max_step_size": (0.1, "The longest step, in s; with fixed steps the step."),
    "accuracy": (1e-6, "The relative error of a step that error control allows."),
    "use_error_control": (
        True,
        "Whether the steps have the length that the accuracy needs, or all max_step_size.",
    ),
    "start_time": (0.0, "When the run begins, in s."),
    "target_realtime_rate": (
        0.0,
        "How many seconds pass in the run per second of the clock; 0 is as fast as it goes.",
    ),
}

CONFIG = {name: default for name, (default, _) in _CONFIG.items()}
"""The defaults of a scenario's integrator."""

KEYS: dict[type, dict[str, Key]] = {
    SimulatorConfig: {n: Key(type(value), value, text) for n, (value, text) in _CONFIG.items()},
    # Points of paths are lists.
    **{
        cls: {
            name: replace(key, hint=Annotated[Any, values.ROW]) if key.hint == ArrayLike else key
            for name, key in keys_of(cls).items()
        }
        for cls in _REFERENCES.values()
    },
}
_start = KEYS[references.PointToPointReference]["start_time"]
KEYS[references.PointToPointReference]["start_time"] = replace(_start, default=0.0)
