"""Force outputs z_2 = S(q) lambda: constraint forces, and combinations of them.     (40)"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.dae import Signal
from drake_dae.errors import ModelError
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.links.links import Kinematics, Links
from drake_dae.trace.expressions import length_of


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
    def expression(
        self, constraints: ConstraintSet, kinematics: Kinematics, constraint_force: ca.SX
    ) -> ca.SX:
        """The components, shape (k, 1), written in the robot's kinematics and lambda."""

    @abstractmethod
    def signals(self, constraints: ConstraintSet) -> tuple[Signal, ...]:
        """Names and units of the components."""


@checked(ModelError)
@dataclass(frozen=True)
class NamedForce(ForceOutput):
    """A single constraint force: a row of the identity. In lists, its name is enough.

    Attributes:
        name: The name of the constraint force.
    """

    name: str

    def expression(
        self, constraints: ConstraintSet, kinematics: Kinematics, constraint_force: ca.SX
    ) -> ca.SX:
        return constraint_force[constraints.place(self.name)]

    def signals(self, constraints: ConstraintSet) -> tuple[Signal, ...]:
        return (constraints.force_signals[constraints.place(self.name)],)


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

    def expression(
        self, constraints: ConstraintSet, kinematics: Kinematics, constraint_force: ca.SX
    ) -> ca.SX:
        parts = [w * constraint_force[constraints.place(n)] for n, w in self.weights.items()]
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
    `WeldedFrames` do, then lambda = S^T c is e_ij c / 2 at i and the opposite at j. Their sum is
    zero, and so is the sum of their moments, (p_i - p_j) x e_ij c / 2. So the row lies in the null
    space of the object's grasp map: it squeezes the object and does not move it. Three contacts in
    a triangle have three such outputs, which span their internal forces. Of the six between four
    contacts in one plane only five are independent: the remaining internal force is normal to that
    plane, up at two opposite contacts and down at the others.

    For unilateral contacts it does not guarantee that each normal force is positive: see the table
    of a run. For the force of a single contact give its name, or use a `ForceCombination`.

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

    def expression(
        self, constraints: ConstraintSet, kinematics: Kinematics, constraint_force: ca.SX
    ) -> ca.SX:
        (p_i, f_i), (p_j, f_j) = (
            constraints.force_on(self.frame, name, kinematics, constraint_force)
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
        return tuple(NamedForce(signal.name) for signal in constraints.force_signals)
    outputs = tuple(NamedForce(f) if isinstance(f, str) else f for f in forces)
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
