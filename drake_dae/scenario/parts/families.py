"""What stands in a scenario for the types in annotations. A new member is one line here."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from casadi import SX
from numpy.typing import ArrayLike
from pydrake.systems.analysis import SimulatorConfig

from drake_dae import references
from drake_dae.robots import actuation, force_outputs, joint_friction, known_forces, outputs
from drake_dae.robots import constraints as contact
from drake_dae.robots.actuation.stage import Stage
from drake_dae.robots.constraints.constraint import Constraint
from drake_dae.robots.surfaces import implicit, measured, surface, surfaces
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
    surface.Surface: _family(
        surfaces.Plane,
        surfaces.Sphere,
        surfaces.Cylinder,
        surfaces.Ellipsoid,
        surfaces.Torus,
        implicit.ImplicitSurface,
        measured.MeasuredSurface,
    ),
    Constraint: _family(
        contact.PointOnSurface,
        written.WeldedFramesForm,
        contact.CoincidentPoints,
        contact.FixedDistance,
        contact.JointCoupler,
        contact.RevoluteLoopJoint,
        contact.PrismaticLoopJoint,
        contact.AxisNormalToSurface,
        contact.Blade,
        contact.RollingWheel,
        contact.RollingBall,
    ),
    outputs.PositionOutput: _family(
        outputs.PointCoordinates,
        outputs.AxisCoordinates,
        written.SurfaceCoordinatesForm,
        written.TiltFromNormalForm,
        outputs.JointPositions,
    ),
    force_outputs.ForceOutput: _family(
        force_outputs.Squeeze, force_outputs.ForceCombination, plain=str
    ),
    Stage: _family(actuation.FlexibleJoints, actuation.DcMotors, actuation.ElectrohydraulicServos),
    references.Reference: Family(_REFERENCES, float),
    known_forces.Load: _family(known_forces.KnownForce, joint_friction.JointFriction),
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
    surface.Vector: Annotated[Any, values.TRIPLE],
    surface.Pair: Annotated[Any, values.PAIR],
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
