"""The contract of a constraint.                                                 (38)"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Container
from copy import copy
from dataclasses import dataclass, replace
from typing import Self

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyConstraintId

from drake_dae.arrays import FloatArray
from drake_dae.dae import Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.links.kinematics import Frames, Kinematics, Reaction
from drake_dae.robots.surfaces.picture import PosedShape
from drake_dae.robots.surfaces.surface import Vector


@dataclass(frozen=True, eq=False)
class Application:
    """The action of constraint forces: F = force_axes @ lambda and M = moment_axes @ lambda.

    All vectors are in the world. Frame A exerts F and M on frame B at the point; B exerts the
    opposite on A at the same point.

    With `drag`, F also contains that force.

    Attributes:
        point: The point of application of F, in m, shape (3, 1).
        force_axes: The force in N for a unit of each constraint force, shape (3, m).
        moment_axes: The moment in N m for a unit of each constraint force, shape (3, m).
        frame_b: Name of frame B, on which F and M act.
        frame_a: Name of frame A, on which the opposite acts.
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
    """A contact of a point of a robot with an object that has a free side.

    Attributes:
        frame: Name of the frame of the point.
        point: The point in the frame, m, shape (3,).
        normal: The unit normal toward the free side there, in the world, shape (3, 1).
        clearance: A point in the world, shape (3, 1) -> its distance into the free side, in m.
        velocity: A point in the world, shape (3, 1) -> the velocity of the object there, in m/s.
        is_exact: Whether the distance is exact also off the object; else it is to first order.
    """

    frame: str
    point: Vector
    normal: ca.SX
    clearance: Callable[[ca.SX], ca.SX]
    velocity: Callable[[ca.SX], ca.SX] = lambda point: ca.SX(3, 1)
    is_exact: bool = True


@dataclass(frozen=True, eq=False)
class Joint:
    """The spring, damper, limits and motor of a joint along its coordinate c.

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


class Constraint(ABC):
    """m constraint equations of a robot, and the m constraint forces lambda that enforce them.

    1. A constraint is an expression of `Kinematics` (its position part of `Frames`) and of the
       symbols of its own `parameters`. It is smooth in the whole workspace. Only its friction may
       have a state: rule 17.
    2. `residual` is phi(q), shape (k, 1), zero if the constraint holds. The first k of the m rows
       are holonomic; the others restrict velocities alone (nonholonomic, r = 1).
    3. `rate` is linear in velocities, shape (m, 1), and zero; its first k rows are the derivative
       of `residual`. A constraint with k < m defines `rate` itself. If the constraint holds, lambda
       . rate is the power of the constraint forces without friction: lambda is a force in N if the
       rate is a velocity in m/s.
    4. `reaction` is linear in lambda: the gradient of that power with respect to the velocities.
       Further forces proportional to lambda, such as friction, are added.
    5. `is_unilateral` marks unilateral rows: lambda >= 0 pushes the robot to the free side.
    6. `applications` are the forces and moments of `reaction`, each on one frame, and the opposite
       on another: the plant's port `constraint_wrenches` consists of these. There are none if the
       frames are not known, as for two angles in textbook equations. Pictures show the first.
    7. `coordinates` are the free coordinates along the constraint, one row for each of
       `coordinate_signals`; there may be none.
    8. `picture` is the visible object in contact, if any; `placement` is its pose for given
       parameters.
    9. If the constraint holds and does not move, the total power of its wrenches on both frames is
       zero; with `is_ideal` false, as with friction, it may be negative.
    10. Its parameters may move (see `RobotModel`) if k = m; `rate` is then the part of the
        derivative from velocities. Terms that depend on the rates of parameters, such as friction,
        use `Parameter.rate`.
    11. `joint` has the spring, damper, limits and motor along its coordinate, if it is a joint that
        closes a loop. `coordinate_rate` is linear in velocities, and the derivative of
        `coordinates` if the constraint holds. The power of a force along the coordinate is force
        times rate.
    12. `drag` are forces independent of lambda, such as viscous friction; `applications` contain
        them as well.
    13. `friction_parameter` is the name of its coefficient of friction, if it has one, and
        `sliding` is the sliding velocity.
    14. `solids` and `layer` are the geometry for Drake's own contact: objects in the world that act
        on frame B of its first application at the point there.
    15. `touch` describes the contact point, if there is a free side; `residual` is then the
        clearance of that point.
    16. `add_to` adds it to a MultibodyPlant, if Drake has such a constraint.

    Attributes:
        name: The prefix of the names of its forces, residuals and parameters.
        parameters: Its numbers, which can change without tracing again.
    """

    name: str
    parameters: tuple[Parameter, ...] = ()

    @property
    def is_ideal(self) -> bool:
        """Whether its forces do no work."""
        return True

    @property
    def friction_parameter(self) -> str | None:
        """The name of its coefficient of friction among its parameters; None without one."""
        return None

    def sliding(self, kinematics: Kinematics) -> ca.SX | None:
        """The sliding velocity relative to the other object, m/s, shape (3, 1).

        None without friction.
        """
        return None

    @property
    @abstractmethod
    def force_signals(self) -> tuple[Signal, ...]:
        """Names and units of lambda, one per equation."""

    @property
    @abstractmethod
    def residual_signals(self) -> tuple[Signal, ...]:
        """Names and units of phi, then of the nonholonomic rows of the rate."""

    def residual(self, frames: Frames) -> ca.SX:
        """phi(q), shape (k, 1) with k <= m; k = 0 if velocities alone are restricted."""
        return ca.SX(0, 1)

    def rate(self, kinematics: Kinematics) -> ca.SX:
        """phi'(q, v), and nonholonomic rows linear in velocities, shape (m, 1)."""
        return kinematics.derivative(self.residual(kinematics))

    def reaction(self, kinematics: Kinematics, constraint_force: ca.SX) -> Reaction:
        """The reaction on the robot of the constraint forces, shape (m, 1)."""
        return kinematics.reaction(ca.dot(constraint_force, self.rate(kinematics)))

    def drag(self, kinematics: Kinematics) -> Reaction | None:
        """The forces on the robot independent of constraint forces; None if there are none."""
        return None

    def moving(self, names: Container[str]) -> Self:
        """The same constraint; parameters of the given names are exogenous."""
        if not any(parameter.name in names for parameter in self.parameters):
            return self
        changed = copy(self)  # Its class may be frozen.
        parameters = [replace(p, exogenous=p.exogenous or p.name in names) for p in self.parameters]
        object.__setattr__(changed, "parameters", tuple(parameters))
        return changed

    @property
    def is_unilateral(self) -> tuple[bool, ...]:
        """Whether each constraint force is unilateral (not negative)."""
        return (False,) * len(self.force_signals)

    @abstractmethod
    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        """The points and frames on which the constraint forces act."""

    @property
    def coordinate_signals(self) -> tuple[Signal, ...]:
        """Names and units of `coordinates`."""
        return ()

    def coordinates(self, frames: Frames) -> ca.SX:
        """The free coordinates along the constraint, shape (k, 1).

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
        """The joint along its coordinate; None if it is not a joint."""
        return None

    def touch(self, frames: Frames) -> Touch | None:
        """The contact point; None without a free side."""
        return None

    @property
    def remark(self) -> str:
        """The approximations of its surface, as text; empty if there are none."""
        return ""

    @property
    def extent(self) -> FloatArray | None:
        """The range of coordinates in which it is defined, shape (2, k), or None."""
        return None

    def placement(self, values: FloatArray) -> RigidTransform:
        """The pose of the object in contact, in the world.

        Args:
            values: The values of its parameters in one vector.
        """
        return RigidTransform()

    def solids(self, values: FloatArray) -> tuple[PosedShape, ...]:
        """The geometry for Drake's own contact; () if there is none.

        Args:
            values: The values of its parameters in one vector.
        """
        return ()

    def add_to(self, plant: MultibodyPlant) -> MultibodyConstraintId:
        """Adds it to a plant that is not finalized, and returns Drake's id.

        Raises:
            ModelError: Drake has no such constraint.
        """
        raise ModelError(
            f"'{self.name}': Drake has no constraint for a {type(self).__name__}; use a "
            "WeldedFrames, a CoincidentPoints with three axes, or ideal constraints"
        )

    def layer(
        self, values: FloatArray, point: FloatArray, size: float, depth: float
    ) -> PosedShape | None:
        """A mesh below a piece of the surface, for hydroelastic contact; None without a surface.

        Args:
            values: The values of its parameters in one vector.
            point: The middle of the piece, in the world, m, shape (3,).
            size: The length of its sides if the surface is unbounded, m.
            depth: The thickness of the layer, m.

        Raises:
            ModelError: The surface does not have such a piece.
        """
        return None

    def picture(self, values: FloatArray, point: FloatArray, size: float) -> PosedShape | None:
        """The visible object in contact, or None.

        Args:
            values: The values of its parameters in one vector.
            point: The present point of application, in the world, m, shape (3,).
            size: The size of the piece to draw, m.
        """
        return None
