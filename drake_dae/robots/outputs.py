"""Outputs: h_1(q), which with the constraints determine q (39), and forces S(q) lambda (40)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.arrays import check_axes
from drake_dae.dae import Signal, as_expression, places_of
from drake_dae.errors import ModelError
from drake_dae.robots.constraint import Constraint, ConstraintSet
from drake_dae.robots.links import Kinematics, Links
from drake_dae.robots.surface import Letter, Vector
from drake_dae.trace.expressions import length_of, result_of


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
    axis: Letter
    components: str

    def __post_init__(self) -> None:
        check_axes("components", self.components)

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
    axis: Letter
    components: str = ""

    def __post_init__(self) -> None:
        others = "xyz".replace(self.axis, "")
        object.__setattr__(self, "components", self.components or others)
        check_axes("components", self.components, others)

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
        return links.q[places_of("joint position", self.joints, links.position_signals)]

    def signals(self, links: Links) -> tuple[Signal, ...]:
        places = places_of("joint position", self.joints, links.position_signals)
        return tuple(links.position_signals[place] for place in places)


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


class ForceOutput(ABC):
    """Some components of z_2 = S(q) lambda.

    1. `expression` is linear in the constraint forces lambda, shape (m, 1); its coefficients, rows
       of S, are smooth functions of q and of parameters of the robot. There is one row for each of
       `signals`.
    2. The rows of a robot are independent in all configurations; otherwise B(x) is singular.
    3. Names are unique among all outputs of a robot.
    4. An unknown constraint, force or frame raises ModelError, which lists the known ones.
    """

    @abstractmethod
    def expression(self, constraints: ConstraintSet, kinematics: Kinematics, force: ca.SX) -> ca.SX:
        """The components, shape (k, 1), written in the robot's kinematics and lambda."""

    @abstractmethod
    def signals(self, constraints: ConstraintSet) -> tuple[Signal, ...]:
        """Names and units of the components."""


@checked(ModelError)
@dataclass(frozen=True)
class ForceCombination(ForceOutput):
    """Constraint forces with constant weights: z = sum_j w_j lambda_j.

    Attributes:
        weights: Name of a constraint force -> its weight w_j; all of these have one unit.
        name: The name of the output.
    """

    weights: dict[str, float]
    name: str

    def __post_init__(self) -> None:
        if not any(self.weights.values()):
            raise ModelError(f"'{self.name}' needs at least one weight that is not zero")

    def expression(self, constraints: ConstraintSet, kinematics: Kinematics, force: ca.SX) -> ca.SX:
        parts = [w * force[constraints.place(n)] for n, w in self.weights.items()]
        return ca.sum1(ca.vertcat(*parts))

    def signals(self, constraints: ConstraintSet) -> tuple[Signal, ...]:
        forces = [constraints.force_signals[constraints.place(name)] for name in self.weights]
        units = dict.fromkeys(signal.unit for signal in forces)
        if len(units) > 1:
            raise ModelError(f"'{self.name}' adds forces with different units: {', '.join(units)}")
        return (Signal(self.name, *units),)


@checked(ModelError)
@dataclass(frozen=True)
class Squeeze(ForceOutput):
    """The internal force between two contacts i and j of an object, in N:

        z = e_ij . (f_i - f_j) / 2,   e_ij = (p_j - p_i) / |p_j - p_i|,

    with the forces f that the contacts exert on the object at the points p; positive where they
    press toward each other. If the contacts transmit forces along e_ij, as `CoincidentPoints` and
    `WeldedFrames` do, the row lies in the null space of the object's grasp map: it squeezes the
    object and does not move it. Three contacts in a triangle have three such outputs, which span
    their internal forces; of the six between four contacts in one plane five are independent.

    It does not guarantee that each normal force of unilateral contacts is positive.

    Attributes:
        frame: The name of the object's frame, on which both constraints act. It may be "world", for
            example for two feet on the ground.
        first, second: The names of the two constraints.
        name: The name of the output; "<first>.<second>.squeeze" if empty.
    """

    frame: str
    first: str
    second: str
    name: str = ""

    def __post_init__(self) -> None:
        if self.first == self.second:
            raise ModelError(f"a squeeze is between two constraints, both are '{self.first}'")

    def expression(self, constraints: ConstraintSet, kinematics: Kinematics, force: ca.SX) -> ca.SX:
        (p_i, f_i), (p_j, f_j) = (
            constraints.force_on(self.frame, name, kinematics, force)
            for name in (self.first, self.second)
        )
        apart = p_j - p_i
        return ca.dot(apart, f_i - f_j) / (2.0 * length_of(apart))

    def signals(self, constraints: ConstraintSet) -> tuple[Signal, ...]:
        return (Signal(self.name or f"{self.first}.{self.second}.squeeze", "N"),)


def as_force_outputs(
    forces: Sequence[str | ForceOutput] | None, constraints: ConstraintSet
) -> tuple[ForceOutput, ...]:
    """The force outputs of a list: a name is that force, None are all forces."""
    if forces is None:
        forces = [signal.name for signal in constraints.force_signals]
    outputs = tuple(ForceCombination({f: 1.0}, f) if isinstance(f, str) else f for f in forces)
    names = [signal.name for output in outputs for signal in output.signals(constraints)]
    twice = [name for name in dict.fromkeys(names) if names.count(name) > 1]
    if twice:
        raise ModelError(f"a force output is named twice: {', '.join(twice)}")
    return outputs


def force_rows(outputs: Sequence[ForceOutput], constraints: ConstraintSet, links: Links) -> ca.SX:
    """S(q) of z_2 = S lambda, shape (k, m); ModelError if an output is not linear in lambda."""
    kinematics, force = links.kinematics(), ca.SX.sym("force", constraints.size)
    blocks = [ca.SX(0, constraints.size)]
    for output in outputs:
        names = ", ".join(signal.name for signal in output.signals(constraints))
        value = kinematics.value(output.expression(constraints, kinematics, force))
        rows = ca.jacobian(value, force)
        rest = ca.substitute(value, force, ca.SX.zeros(constraints.size))
        if ca.depends_on(rows, force) or not rest.is_zero():
            raise ModelError(f"force output {names} is not linear in the constraint forces")
        blocks.append(rows)
    return ca.vertcat(*blocks)
