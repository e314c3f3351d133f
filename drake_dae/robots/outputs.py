"""Position outputs h_1(q) that, with the constraints, fix where the robot is.       (39)"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Protocol

import casadi as ca

from drake_dae.arrays import check_axes
from drake_dae.dae.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.robots.contact.points import PointOnSurface
from drake_dae.robots.contact.surfaces import Vector
from drake_dae.robots.links.links import Links


class PositionOutput(Protocol):
    """Some components of h_1(q)."""

    def expression(self, links: Links) -> ca.SX:
        """The components, shape (k, 1)."""

    def signals(self, links: Links) -> tuple[Signal, ...]:
        """Their names and units."""


@dataclass(frozen=True)
class PointCoordinates:
    """World coordinates of a point that is fixed in a frame, m.

    Attributes:
        frame: Name of the frame.
        axes: Which of "xyz", for example "yz".
        point: The point in the frame, m, shape (3,).
        name: Of the outputs, "<name>.y"; the frame's if empty. Two points of one frame need it.
    """

    frame: str
    axes: str = "xyz"
    point: Vector = (0.0, 0.0, 0.0)
    name: str = ""

    def __post_init__(self) -> None:
        check_axes("axes", self.axes)

    def expression(self, links: Links) -> ca.SX:
        return links.position(self.frame, self.point)[["xyz".index(a) for a in self.axes]]

    def signals(self, links: Links) -> tuple[Signal, ...]:
        return tuple(Signal(f"{self.name or self.frame}.{axis}", "m") for axis in self.axes)


@dataclass(frozen=True)
class AxisCoordinates:
    """World components of an axis of a frame: two of them steer where the axis points.

    Attributes:
        frame: Name of the frame.
        axis: Which axis of the frame, "x", "y" or "z".
        components: Which world components of it, for example "yz".
    """

    frame: str
    axis: str
    components: str

    def __post_init__(self) -> None:
        check_axes("components", self.components)
        if len(self.axis) != 1:
            raise ModelError(f"axis must be one of x, y, z, got '{self.axis}'")
        check_axes("axis", self.axis)

    def expression(self, links: Links) -> ca.SX:
        column = links.rotation(self.frame)[:, "xyz".index(self.axis)]
        return column[["xyz".index(a) for a in self.components]]

    def signals(self, links: Links) -> tuple[Signal, ...]:
        return tuple(Signal(f"{self.frame}.{self.axis}_axis.{c}") for c in self.components)


@dataclass(frozen=True)
class SurfaceCoordinates:
    """Coordinates of the contact point along its surface; which, the surface tells.

    Attributes:
        contact: The constraint that keeps the point on the surface.
    """

    contact: PointOnSurface

    def __post_init__(self) -> None:
        if not isinstance(self.contact, PointOnSurface):
            raise ModelError(f"constraint '{self.contact.name}' has no coordinates along it")

    def expression(self, links: Links) -> ca.SX:
        return self.contact.surface.coordinates(self.contact.offset(links))

    def signals(self, links: Links) -> tuple[Signal, ...]:
        return tuple(
            Signal(f"{self.contact.name}.{name}", unit)
            for name, unit in self.contact.surface.coordinate_signals
        )


@dataclass(frozen=True)
class JointPositions:
    """Generalized positions by name.

    Attributes:
        joints: Names as in the links' `position_signals`.
    """

    joints: Sequence[str]

    def expression(self, links: Links) -> ca.SX:
        names = [signal.name for signal in links.position_signals]
        for joint in self.joints:
            if joint not in names:
                near = get_close_matches(joint, names, n=1)
                hint = f"did you mean '{near[0]}'? " if near else ""
                raise ModelError(f"no joint position '{joint}'; {hint}there are {', '.join(names)}")
        return links.q[[names.index(joint) for joint in self.joints]]

    def signals(self, links: Links) -> tuple[Signal, ...]:
        units = {signal.name: signal.unit for signal in links.position_signals}
        return tuple(Signal(joint, units[joint]) for joint in self.joints)


@dataclass(frozen=True)
class ExpressionOutput:
    """Any smooth function of the robot's configuration.

    Attributes:
        function: Of the links (`links.q`, `links.position("tool")`, ...), returns a CasADi
            column.
        outputs: Name and unit of each component.
    """

    function: Callable[[Links], ca.SX]
    outputs: Sequence[Signal]

    def expression(self, links: Links) -> ca.SX:
        value = ca.vec(ca.SX(self.function(links)))
        if value.numel() != len(self.outputs):
            raise ModelError(
                f"an output function returned {value.numel()} components, named were "
                f"{', '.join(signal.name for signal in self.outputs)}"
            )
        return value

    def signals(self, links: Links) -> tuple[Signal, ...]:
        return tuple(self.outputs)
