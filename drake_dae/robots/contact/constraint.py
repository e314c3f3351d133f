"""What a constraint says of itself.                                             (38)"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import casadi as ca
from pydrake.math import RigidTransform

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.contact.picture import Picture
from drake_dae.robots.links.kinematics import Frames, Kinematics, Reaction


@dataclass(frozen=True, eq=False)
class Application:
    """Where constraint forces act: F = force_axes @ lambda and M = moment_axes @ lambda.

    All vectors are in the world. Whatever the robot touches gets the opposite.

    Attributes:
        point: Where F acts, in m, shape (3, 1).
        force_axes: The force in N for a unit of each constraint force, shape (3, m).
        moment_axes: The moment in N m for a unit of each constraint force, shape (3, m).
    """

    point: ca.SX
    force_axes: ca.SX
    moment_axes: ca.SX


@checked(ModelError)
class Constraint(ABC):
    """m equations that a robot keeps, and the m constraint forces lambda that make it keep them.

    1. A constraint is written in `Kinematics` (its position part in `Frames`) and the symbols of
       its own `parameters`; it is smooth wherever the robot may be, and has no state.
    2. `residual` is phi(q), zero where the constraint holds, one row for each of
       `residual_signals`. One that restricts velocities alone (nonholonomic) has no rows here, and
       gives a `rate` of its own.
    3. `rate` is linear in velocities, shape (m, 1), and the derivative of `residual` if there is
       one. Where the constraint holds, lambda . rate is the power of the constraint forces without
       friction: lambda is a force in N where the rate is a velocity in m/s.
    4. `reaction` is linear in lambda: the gradient of that power with respect to the velocities.
       What lambda does besides, as friction, is added to it.
    5. Where `can_only_push` says that the constraint cannot pull, a positive lambda pushes.
    6. `application` is the force and the moment of `reaction` where they act, for pictures; None
       where they act at no point, as between the angles of two joints.
    7. `coordinates` tell where the robot is along what the constraint leaves free, one row for
       each of `coordinate_signals`; there may be none.
    8. `picture` is what there is to see where the robot touches, if there is anything; `placement`
       tells where its parameters put it.
    9. Its parameters may move (see `RobotModel`) if it has a `residual`; `rate` is then that part
       of its derivative which velocities make.

    Attributes:
        name: Stands before the names of its forces, residuals and parameters.
        parameters: Its numbers that change without tracing again.
    """

    name: str
    parameters: tuple[Parameter, ...] = ()

    @property
    @abstractmethod
    def force_signals(self) -> tuple[Signal, ...]:
        """Names and units of lambda, one per equation."""

    @property
    @abstractmethod
    def residual_signals(self) -> tuple[Signal, ...]:
        """Names and units of phi, or of the rate if there is no phi."""

    def residual(self, frames: Frames) -> ca.SX:
        """phi(q), shape (m, 1); shape (0, 1) if velocities alone are restricted."""
        return ca.SX(0, 1)

    def rate(self, kinematics: Kinematics) -> ca.SX:
        """phi'(q, v), or what else must stay zero and is linear in velocities, shape (m, 1)."""
        return kinematics.derivative(self.residual(kinematics))

    def reaction(self, kinematics: Kinematics, constraint_force: ca.SX) -> Reaction:
        """The forces that the constraint forces, shape (m, 1), make on the robot."""
        return kinematics.reaction(ca.dot(constraint_force, self.rate(kinematics)))

    @property
    def can_only_push(self) -> tuple[bool, ...]:
        """Whether each constraint force must not be negative."""
        return (False,) * len(self.force_signals)

    @abstractmethod
    def application(self, kinematics: Kinematics) -> Application | None:
        """Where the constraint forces act, or None."""

    @property
    def coordinate_signals(self) -> tuple[Signal, ...]:
        """Names and units of `coordinates`."""
        return ()

    def coordinates(self, frames: Frames) -> ca.SX:
        """Coordinates along what the constraint leaves free, shape (k, 1).

        Raises:
            ModelError: The constraint has none.
        """
        raise ModelError(
            f"'{self.name}' has no coordinates along it; use PointCoordinates or an expression"
        )

    def placement(self, values: FloatArray) -> RigidTransform:
        """Where what the robot touches stands in the world.

        Args:
            values: The values of its parameters, below each other.
        """
        return RigidTransform()

    def picture(self, values: FloatArray, point: FloatArray, size: float) -> Picture | None:
        """What is to be seen where the robot touches, or None.

        Args:
            values: The values of its parameters, below each other.
            point: Where its forces act now, in the world, m, shape (3,).
            size: How large a piece is of interest, m.
        """
        return None
