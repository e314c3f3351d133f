"""What a constraint says of itself.                                             (38)"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Container
from copy import copy
from dataclasses import dataclass
from typing import Self

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Parameter, Signal, moving
from drake_dae.errors import ModelError
from drake_dae.robots.links.kinematics import Frames, Kinematics, Reaction
from drake_dae.robots.surfaces.picture import Picture
from drake_dae.robots.surfaces.surface import Vector


@dataclass(frozen=True, eq=False)
class Application:
    """Where constraint forces act: F = force_axes @ lambda and M = moment_axes @ lambda.

    All vectors are in the world. Frame A exerts F and M on frame B at the point; B exerts the
    opposite on A at the same point.

    With `drag`, F has that force besides.

    Attributes:
        point: Where F acts, in m, shape (3, 1).
        force_axes: The force in N for a unit of each constraint force, shape (3, m).
        moment_axes: The moment in N m for a unit of each constraint force, shape (3, m).
        frame_b: Name of frame B, which feels F and M.
        frame_a: Name of frame A, which feels the opposite.
        drag: The part of F in N that acts without constraint forces, shape (3, 1); None if none.
    """

    point: ca.SX
    force_axes: ca.SX
    moment_axes: ca.SX
    frame_b: str
    frame_a: str = "world"
    drag: ca.SX | None = None

    def force(self, constraint_force: ca.SX) -> ca.SX:
        """F in N, shape (3, 1), for constraint forces of shape (m, 1)."""
        force = ca.mtimes(self.force_axes, constraint_force)
        return force if self.drag is None else force + self.drag


@dataclass(frozen=True, eq=False)
class Touch:
    """Where a point of a robot touches something that has a free side.

    Attributes:
        frame: Name of the frame of the point.
        point: The point in the frame, m, shape (3,).
        normal: The unit normal toward the free side there, in the world, shape (3, 1).
        clearance: A point in the world, shape (3, 1) -> how far it is on the free side, in m.
    """

    frame: str
    point: Vector
    normal: ca.SX
    clearance: Callable[[ca.SX], ca.SX]


@dataclass(frozen=True, eq=False)
class Joint:
    """What a joint has along its coordinate c.

    Attributes:
        force: (c, c') -> the force of its spring and damper, in N m (N), positive toward larger c.
        lower, upper: The limits of c, infinite where there are none.
        velocity_limit: The largest |c'|, infinite where there is none.
        motor: Name and unit of the control that adds to the force; None without a motor.
        effort_limit: The largest control, infinite where there is none.
    """

    force: Callable[[ca.SX, ca.SX], ca.SX]
    lower: float = -np.inf
    upper: float = np.inf
    velocity_limit: float = np.inf
    motor: Signal | None = None
    effort_limit: float = np.inf


@checked(ModelError)
class Constraint(ABC):
    """m equations that a robot keeps, and the m constraint forces lambda that make it keep them.

    1. A constraint is written in `Kinematics` (its position part in `Frames`) and the symbols of
       its own `parameters`; it is smooth wherever the robot may be, and has no state.
    2. `residual` is phi(q), shape (k, 1), zero where the constraint holds. Positions are kept by
       the first k of the m rows; the others restrict velocities alone (nonholonomic, r = 1).
    3. `rate` is linear in velocities, shape (m, 1), and stays zero; its first k rows are the
       derivative of `residual`. One with k < m gives a `rate` of its own. Where the constraint
       holds, lambda . rate is the power of the constraint forces without friction: lambda is a
       force in N where the rate is a velocity in m/s.
    4. `reaction` is linear in lambda: the gradient of that power with respect to the velocities.
       What lambda does besides, as friction, is added to it.
    5. Where `can_only_push` says that the constraint cannot pull, a positive lambda pushes.
    6. `applications` are the forces and moments of `reaction`, each on one frame, and the opposite
       on another: of these the plant's port `constraint_wrenches` is made. There are none where
       nobody knows at which frames they act, as between two angles in textbook equations. Pictures
       show the first.
    7. `coordinates` tell where the robot is along what the constraint leaves free, one row for
       each of `coordinate_signals`; there may be none.
    8. `picture` is what there is to see where the robot touches, if there is anything; `placement`
       tells where its parameters put it.
    9. Where the constraint holds and stands still, the power of its wrenches on both frames
       together is zero; it may be negative where `is_ideal` is false, as with friction.
    10. Its parameters may move (see `RobotModel`) if k = m; `rate` is then that part of the
        derivative which velocities make. What needs to know how fast they move, as friction does,
        takes `Parameter.rate`.
    11. `joint` tells what it has along its one coordinate, if it is a joint that closes a loop;
        `coordinate_rate` is linear in velocities, and the derivative of `coordinates` where the
        constraint holds. A force along the coordinate has the power of force times rate.
    12. `drag` is what it does without constraint forces, as viscous friction; `applications` hold
        it too.
    13. Where what lambda does besides grows with one of its parameters, a coefficient of friction,
        `friction_parameter` names that, and `sliding` is the velocity along which it rubs.
    14. `solid` is what its one force comes from where Drake's own contact is the plant: what stands
        in the world and pushes frame B of its first application at the point there.
    15. `touch` tells at which point it touches what has a free side, if it does; `residual` is then
        the clearance of that point.

    Attributes:
        name: Stands before the names of its forces, residuals and parameters.
        parameters: Its numbers that change without tracing again.
    """

    name: str
    parameters: tuple[Parameter, ...] = ()

    @property
    def is_ideal(self) -> bool:
        """Whether its forces take no power."""
        return True

    @property
    def friction_parameter(self) -> str | None:
        """The name of its coefficient of friction among its parameters; None without one."""
        return None

    def sliding(self, kinematics: Kinematics) -> ca.SX | None:
        """The velocity at which it slides, relative to what it rubs on, m/s, shape (3, 1).

        None where it does not rub, or in a way of its own, which impacts then know nothing of.
        """
        return None

    @property
    @abstractmethod
    def force_signals(self) -> tuple[Signal, ...]:
        """Names and units of lambda, one per equation."""

    @property
    @abstractmethod
    def residual_signals(self) -> tuple[Signal, ...]:
        """Names and units of phi, and then of the rows of the rate that are none of phi."""

    def residual(self, frames: Frames) -> ca.SX:
        """phi(q), shape (k, 1) with k <= m; k = 0 if velocities alone are restricted."""
        return ca.SX(0, 1)

    def rate(self, kinematics: Kinematics) -> ca.SX:
        """phi'(q, v), or what else must stay zero and is linear in velocities, shape (m, 1)."""
        return kinematics.derivative(self.residual(kinematics))

    def reaction(self, kinematics: Kinematics, constraint_force: ca.SX) -> Reaction:
        """The forces that the constraint forces, shape (m, 1), make on the robot."""
        return kinematics.reaction(ca.dot(constraint_force, self.rate(kinematics)))

    def drag(self, kinematics: Kinematics) -> Reaction | None:
        """The forces that it makes without constraint forces; None if there are none."""
        return None

    def moving(self, names: Container[str]) -> Self:
        """The same constraint, of whose parameters those with some names move."""
        if not any(parameter.name in names for parameter in self.parameters):
            return self
        found = copy(self)  # Its class may be frozen.
        object.__setattr__(found, "parameters", moving(self.parameters, names))
        return found

    @property
    def can_only_push(self) -> tuple[bool, ...]:
        """Whether each constraint force must not be negative."""
        return (False,) * len(self.force_signals)

    @abstractmethod
    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        """Where and on what the constraint forces act."""

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

    def coordinate_rate(self, kinematics: Kinematics) -> ca.SX:
        """The rates of the coordinates, shape (k, 1)."""
        return kinematics.derivative(self.coordinates(kinematics))

    @property
    def joint(self) -> Joint | None:
        """What it has along its one coordinate; None if it is no joint."""
        return None

    def touch(self, frames: Frames) -> Touch | None:
        """Where it touches what has a free side; None if there is no such side."""
        return None

    @property
    def remark(self) -> str:
        """What of what it touches is approximate, and how much; empty if nothing is."""
        return ""

    @property
    def extent(self) -> FloatArray | None:
        """The least and the largest coordinates for which it is meant, shape (2, k), or None."""
        return None

    def placement(self, values: FloatArray) -> RigidTransform:
        """Where what the robot touches stands in the world.

        Args:
            values: The values of its parameters, below each other.
        """
        return RigidTransform()

    def solid(self, values: FloatArray) -> Picture | None:
        """What Drake's own contact takes in its place; None where there is no such thing.

        Args:
            values: The values of its parameters, below each other.
        """
        return None

    def picture(self, values: FloatArray, point: FloatArray, size: float) -> Picture | None:
        """What is to be seen where the robot touches, or None.

        Args:
            values: The values of its parameters, below each other.
            point: Where its forces act now, in the world, m, shape (3,).
            size: How large a piece is of interest, m.
        """
        return None
