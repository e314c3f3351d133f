"""The families from which a tag in a scenario chooses. A new member is one line here."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import pydantic
from casadi import SX
from numpy.typing import ArrayLike

from drake_dae import references
from drake_dae.robots import actuation, force_outputs, outputs
from drake_dae.robots import constraints as contact
from drake_dae.robots.surfaces import implicit, measured, surface, surfaces
from drake_dae.scenario import plants
from drake_dae.scenario.forms.forms import Choice, Form
from drake_dae.scenario.forms.values import FileName, Numbers, Pair, Row, Triple
from drake_dae.scenario.parts import parts as parts
from drake_dae.scenario.parts import written
from drake_dae.scenario.parts.task import ScenarioTask
from drake_dae.systems.control import sampling
from drake_dae.systems.task import phases

# Vectors and arrays are written as in `_WRITTEN`; numbers, text, booleans, Literals, dataclasses,
# tuples, and lists and dictionaries of these are written directly.

_WRITTEN = {surface.Vector: Triple, ArrayLike: Numbers, str | Path: FileName, surface.Pair: Pair}

Surface = Annotated[
    surfaces.Plane
    | surfaces.Sphere
    | surfaces.Cylinder
    | surfaces.Ellipsoid
    | surfaces.Torus
    | implicit.ImplicitSurface
    | measured.MeasuredSurface,
    Choice({**_WRITTEN, Callable[..., SX] | str: str}),
]
Constraint = Annotated[
    contact.PointOnSurface
    | written.WeldedFramesForm
    | contact.CoincidentPoints
    | contact.FixedDistance
    | contact.JointCoupler
    | contact.RevoluteLoopJoint
    | contact.PrismaticLoopJoint
    | contact.AxisNormalToSurface
    | contact.Blade
    | contact.RollingWheel
    | contact.RollingBall,
    Choice({**_WRITTEN, surface.Surface: Surface}),
]
Output = Annotated[
    outputs.PointCoordinates
    | outputs.AxisCoordinates
    | written.SurfaceCoordinatesForm
    | written.TiltFromNormalForm
    | outputs.JointPositions,
    Choice(_WRITTEN),
]
ForceOutput = Annotated[
    str | force_outputs.Squeeze | force_outputs.ForceCombination,
    Choice(_WRITTEN),
]
Stage = Annotated[
    actuation.FlexibleJoints | actuation.DcMotors | actuation.ElectrohydraulicServos,
    Choice(_WRITTEN),
]
_PathLimits = Annotated[references.PathLimits, Form()]
Reference = Annotated[
    Annotated[references.ConstantReference, Form(tag="!Constant")]
    | float
    | Annotated[references.SinusoidReference, Form(tag="!Sinusoids")]
    | Annotated[
        references.PointToPointReference, Form(tag="!PointToPoint", defaults={"start_time": 0.0})
    ]
    | Annotated[references.LineReference, Form(tag="!Line")]
    | Annotated[references.CircleReference, Form(tag="!Circle")]
    | Annotated[references.SpiralReference, Form(tag="!Spiral")]
    | Annotated[references.PolylineReference, Form(tag="!Polyline")]
    | Annotated[references.WaypointsReference, Form(tag="!Waypoints")]
    | Annotated[references.CsvReference, Form(tag="!Csv")],
    Choice({**_WRITTEN, ArrayLike: Row, references.PathLimits: _PathLimits}),
]
Plant = Annotated[
    plants.IdealConstraints | plants.MultibodyPlant | plants.CompliantContact | plants.OwnPlant,
    Choice(),
]
Sampling = Annotated[sampling.Sampling, Form()]
Sensors = Annotated[parts.Sensors, Form(_WRITTEN)]
Estimator = Annotated[parts.Estimator, Form()]
Law = Annotated[parts.Law, Form()]
Judgement = Annotated[parts.Judgement, Form()]
_Conditions = Annotated[
    tuple[Annotated[phases.Condition, Form()], ...], pydantic.Strict(False)
]  # In data a tuple is a list.
_BY_NAME: dict[Any, Any] = {Mapping[str, references.Reference | float]: dict[str, Reference]}
_PHASE_DATA = {
    float | references.Reference: Reference,
    Sequence[phases.Condition]: _Conditions,
    **_BY_NAME,
}
Phase = Annotated[
    phases.Approach | phases.Press | phases.Move | phases.Dwell | phases.Release | phases.Retreat,
    Choice(_PHASE_DATA),
]
Task = Annotated[ScenarioTask, Form({Sequence[phases.Phase]: list[Phase], **_BY_NAME})]
