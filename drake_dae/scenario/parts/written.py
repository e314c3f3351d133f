"""Forms whose data in a scenario differ from the fields of the library's classes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeVar, cast

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from drake_dae.arrays import unknown_name
from drake_dae.errors import ModelError
from drake_dae.robots import (
    Constraint,
    PositionOutput,
    SurfaceCoordinates,
    TiltFromNormal,
    WeldedFrames,
)
from drake_dae.scenario.robot_file.robot import Pose

T = TypeVar("T", Constraint, PositionOutput)


@dataclass(frozen=True)
class WeldedFramesForm:
    """Frame B has a fixed pose in frame A, given by angles.

    Attributes:
        frame_a: Name of frame A; it may be "world".
        frame_b: Name of frame B, on another body.
        pose: The pose of B in A; by default the frames coincide.
        name: The name of the constraint, the prefix of its forces and its parameter.
    """

    frame_a: str
    frame_b: str
    pose: Pose = field(default_factory=Pose)
    name: str = "weld"

    def make(self, constraints: Sequence[Constraint]) -> Constraint:
        """The constraint."""
        rotation = RollPitchYaw(np.deg2rad(self.pose.rpy_deg))
        pose = RigidTransform(rotation, self.pose.translation)
        return WeldedFrames(self.frame_a, self.frame_b, pose, self.name)


@dataclass(frozen=True)
class SurfaceCoordinatesForm:
    """The coordinates along a constraint.

    Attributes:
        constraint: The name of a constraint with coordinates, such as a PointOnSurface on a !Plane.
    """

    constraint: str

    def make(self, constraints: Sequence[Constraint]) -> PositionOutput:
        """The output."""
        return SurfaceCoordinates(_named(self.constraint, constraints))


@dataclass(frozen=True)
class TiltFromNormalForm:
    """The tilt of a tool's axis from the surface normal at its contact.

    Attributes:
        constraint: The name of a constraint with a free side, such as a PointOnSurface.
        axis: The axis of its frame, "x", "y" or "z".
        components: The rows, a choice of the two other axes, "xy" for example; both if empty.
    """

    constraint: str
    axis: str
    components: str = ""

    def make(self, constraints: Sequence[Constraint]) -> PositionOutput:
        """The output."""
        contact = _named(self.constraint, constraints)
        return TiltFromNormal(contact, self.axis, self.components)


WrittenConstraint = Constraint | WeldedFramesForm
WrittenOutput = PositionOutput | SurfaceCoordinatesForm | TiltFromNormalForm


def make(
    form: T | WeldedFramesForm | SurfaceCoordinatesForm | TiltFromNormalForm,
    constraints: Sequence[Constraint],
) -> T:
    """The library's object of a form that may name constraints; such an object as it is.

    Raises:
        ModelError: Something does not fit.
    """
    return cast(T, form.make(constraints) if hasattr(form, "make") else form)


def _named(name: str, constraints: Sequence[Constraint]) -> Constraint:
    named = {constraint.name: constraint for constraint in constraints}
    if name not in named:
        raise ModelError(unknown_name("constraint", name, named))
    return named[name]
