"""Position outputs h_1(q), which with the constraints determine the configuration.   (39)"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.arrays import check_axes
from drake_dae.dae import Signal, as_expression
from drake_dae.errors import ModelError
from drake_dae.robots.constraints.constraint import Constraint
from drake_dae.robots.links.links import Links, position_index
from drake_dae.robots.surfaces.surface import Vector
from drake_dae.trace.expressions import result_of


class PositionOutput(ABC):
    """Some components of h_1(q).

    1. `expression` is a smooth function of q (and of parameters of the robot), one row for each of
       `signals`. It must not be a function of the constraints, since such outputs are always zero.
    2. Names are unique among all outputs of a robot.
    3. An unknown frame or joint raises ModelError, which lists the known ones.
    """

    @abstractmethod
    def expression(self, links: Links) -> ca.SX:
        """The components, shape (k, 1)."""

    @abstractmethod
    def signals(self, links: Links) -> tuple[Signal, ...]:
        """Names and units of the components."""


@checked(ModelError)
@dataclass(frozen=True)
class PointCoordinates(PositionOutput):
    """The world coordinates of a point that is fixed in a frame, in m.

    Attributes:
        frame: Name of the frame.
        axes: The axes, letters of "xyz", for example "yz".
        point: The point in the frame, m, shape (3,).
        name: The prefix of the output names, "<name>.y"; the frame's name if empty. Needed for two
            points of one frame.
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


@checked(ModelError)
@dataclass(frozen=True)
class AxisCoordinates(PositionOutput):
    """The world components of an axis of a frame: two of them control its direction.

    Attributes:
        frame: Name of the frame.
        axis: The axis of the frame, "x", "y" or "z".
        components: Its world components, letters of "xyz", for example "yz".
    """

    frame: str
    axis: str
    components: str

    def __post_init__(self) -> None:
        check_axes("components", self.components)
        _check_axis(self.axis)

    def expression(self, links: Links) -> ca.SX:
        column = links.rotation(self.frame)[:, "xyz".index(self.axis)]
        return column[["xyz".index(a) for a in self.components]]

    def signals(self, links: Links) -> tuple[Signal, ...]:
        return tuple(Signal(f"{self.frame}.{self.axis}_axis.{c}") for c in self.components)


@checked(ModelError)
@dataclass(frozen=True)
class SurfaceCoordinates(PositionOutput):
    """The coordinates along a constraint, as defined by the constraint.

    Attributes:
        contact: A constraint with coordinates, as a `PointOnSurface`.
    """

    contact: Constraint

    def __post_init__(self) -> None:
        if not self.contact.coordinate_signals:
            raise ModelError(
                f"constraint '{self.contact.name}' has no coordinates along it; use "
                "PointCoordinates or an expression"
            )

    def expression(self, links: Links) -> ca.SX:
        return self.contact.coordinates(links)

    def signals(self, links: Links) -> tuple[Signal, ...]:
        return self.contact.coordinate_signals


@checked(ModelError)
@dataclass(frozen=True)
class TiltFromNormal(PositionOutput):
    """The tilt of an axis of the frame in contact from the surface's normal there:

        h_1(q) = R_WF^T n(p_W(q)),    of which the rows across the axis,

    the unit normal n in the axes of the frame. Both rows are zero if the axis is parallel to the
    normal, and the sines of the angles otherwise. On a curved surface the axis follows the normal
    as the point moves.

    Attributes:
        contact: A contact constraint, such as a `PointOnSurface`.
        axis: The axis of its frame, "x", "y" or "z".
        components: The rows, a choice of the two other axes, "xy" for example; both if empty.
    """

    contact: Constraint
    axis: str
    components: str = ""

    def __post_init__(self) -> None:
        _check_axis(self.axis)
        others = "xyz".replace(self.axis, "")
        if self.components:
            check_axes("components", self.components)
        if self.axis in self.components:
            raise ModelError(
                f"components must be of {' and '.join(others)}, the axes normal to {self.axis}, "
                f"got '{self.components}'"
            )
        object.__setattr__(self, "components", self.components or others)

    def expression(self, links: Links) -> ca.SX:
        touch = self.contact.touch(links)
        if touch is None:
            raise ModelError(
                f"constraint '{self.contact.name}' is not a contact with a surface and has no "
                "normal; use AxisCoordinates"
            )
        normal = ca.mtimes(links.rotation(touch.frame).T, touch.normal)
        return normal[["xyz".index(a) for a in self.components]]

    def signals(self, links: Links) -> tuple[Signal, ...]:
        return tuple(Signal(f"{self.contact.name}.tilt_{c}") for c in self.components)


@checked(ModelError)
@dataclass(frozen=True)
class JointPositions(PositionOutput):
    """The generalized positions with given names.

    Attributes:
        joints: Names as in the links' `position_signals`.
    """

    joints: Sequence[str]

    def expression(self, links: Links) -> ca.SX:
        return links.q[[position_index(links, joint) for joint in self.joints]]

    def signals(self, links: Links) -> tuple[Signal, ...]:
        units = {signal.name: signal.unit for signal in links.position_signals}
        return tuple(Signal(joint, units[joint]) for joint in self.joints)


@checked(ModelError)
@dataclass(frozen=True)
class ExpressionOutput(PositionOutput):
    """Any smooth function of the robot's configuration.

    Attributes:
        function: Takes the links (`links.q`, `links.position("tool")`, ...), returns a CasADi
            column.
        outputs: Name and unit of each component.
    """

    function: Callable[[Links], ca.SX]
    outputs: Sequence[Signal]

    def expression(self, links: Links) -> ca.SX:
        given = result_of("function", self.function, links)
        value = ca.vec(as_expression("an ExpressionOutput", "its function", given))
        if value.numel() != len(self.outputs):
            raise ModelError(
                f"an output function returned {value.numel()} components, named were "
                f"{', '.join(signal.name for signal in self.outputs)}"
            )
        return value

    def signals(self, links: Links) -> tuple[Signal, ...]:
        return tuple(self.outputs)


def _check_axis(axis: str) -> None:
    if len(axis) != 1:
        raise ModelError(f"axis must be one of x, y, z, got '{axis}'")
    check_axes("axis", axis)
