"""The contract of a constraint.                                                 (38)"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import casadi as ca
from pydrake.math import RigidTransform

from drake_dae.arrays import FloatArray
from drake_dae.dae import Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.links.links import Application, Frames, Kinematics, Reaction
from drake_dae.robots.surfaces.surface import Surface, Vector


@dataclass(frozen=True, eq=False)
class Touch:
    """A contact of a point of a robot with an object that has a free side."""

    frame: str
    point: Vector  # In the frame, m.
    normal: ca.SX  # Toward the free side, in the world, shape (3, 1).
    clearance: Callable[[ca.SX], ca.SX]  # A point in the world -> its distance into the free side.
    velocity: Callable[[ca.SX], ca.SX] = lambda point: ca.SX(3, 1)  # Of the object at a point.
    is_exact: bool = True  # Whether the distance is exact also off the object.


@dataclass(frozen=True, eq=False)
class Joint:
    """The spring, damper, limits and motor of a joint along its coordinate c; inf for no limit."""

    force: Callable[[ca.SX, ca.SX], ca.SX]  # (c, c') -> that of spring and damper, toward larger c.
    lower: float  # Limits of c.
    upper: float
    velocity_limit: float  # The largest |c'|.
    motor: Signal | None  # The control that adds to the force, if it has one.
    effort_limit: float  # The largest control.


class Constraint(ABC):
    """m constraint equations of a robot, and the m constraint forces lambda that enforce them.

    1. It is an expression of `Kinematics` (its position part of `Frames`) and of its `parameters`,
       smooth in the workspace. These are made once, have names that begin with "<name>.", and may
       move (see `RobotModel`) if k = m; `rate` is then the part of the derivative from velocities.
    2. `residual` is phi(q), shape (k, 1), zero if the constraint holds. The first k of the m rows
       are holonomic; the others restrict velocities alone (nonholonomic, r = 1).
    3. `rate`, shape (m, 1), is linear in velocities, and zero where the constraint holds; its first
       k rows are the derivative of `residual`. A constraint with k < m defines it itself. Where it
       holds, lambda . rate is the power of the forces without friction: lambda is a force in N if
       the rate is a velocity in m/s. Where `is_unilateral`, lambda >= 0 pushes to the free side.
    4. `reaction` is linear in lambda: the gradient of that power by the velocities, and forces
       proportional to lambda, as of friction. `drag` are forces independent of lambda.
    5. `applications` are all these forces, each on one frame and the opposite on another; none if
       the frames are not known. Pictures show the first. If the constraint holds and does not move,
       their power is zero where `is_ideal`, and not positive otherwise.
    6. `coordinates` are free coordinates along it, one row for each of `coordinate_signals`, if
       any. A `joint` is that of a closed loop: its power is force times the rate of its coordinate.
    7. With friction, `friction_parameter` names the coefficient, and `sliding` is the velocity
       relative to the other object.
    8. `touch` is the contact point, if there is a free side; `residual` is its clearance.
       `surface_at` and `placement` are the surface for values of the parameters, and where it
       stands: for pictures, and for Drake's own contact.
    """

    name: str
    force_units: ClassVar[Mapping[str, str]] = {}
    residual_units: ClassVar[Mapping[str, str]] = {}

    def __post_init__(self) -> None:
        _ = self.parameters  # They check themselves.

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its numbers, which can change without tracing again."""
        return ()

    def symbol(self, key: str) -> ca.SX:
        """The symbol of the parameter "<name>.<key>"; 0 if there is none."""
        found = [p.symbol for p in self.parameters if p.name == f"{self.name}.{key}"]
        return found[0] if found else ca.SX(0)

    def moving(self, names: Container[str]) -> Self:
        """The same constraint; parameters of the given names are exogenous."""
        if not any(parameter.name in names for parameter in self.parameters):
            return self
        changed = copy(self)
        changed.__dict__["parameters"] = tuple(
            replace(p, exogenous=p.exogenous or p.name in names) for p in self.parameters
        )
        return changed

    @property
    def force_signals(self) -> tuple[Signal, ...]:
        """Names and units of lambda, one per equation."""
        return tuple(Signal(f"{self.name}.{key}", unit) for key, unit in self.force_units.items())

    @property
    def residual_signals(self) -> tuple[Signal, ...]:
        """Names and units of phi, then of the nonholonomic rows of the rate."""
        units = self.residual_units
        return tuple(Signal(f"{self.name}.{key}", unit) for key, unit in units.items())

    @property
    def is_unilateral(self) -> tuple[bool, ...]:
        """Whether each constraint force is unilateral (not negative)."""
        return (False,) * len(self.force_signals)

    @property
    def is_ideal(self) -> bool:
        """Whether its forces do no work."""
        return True

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

    @abstractmethod
    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        """The points and frames on which the constraint forces act."""

    @property
    def coordinate_signals(self) -> tuple[Signal, ...]:
        """Names and units of `coordinates`."""
        return ()

    def coordinates(self, frames: Frames) -> ca.SX:
        """The free coordinates along the constraint, shape (k, 1); ModelError without any."""
        raise ModelError(
            f"'{self.name}' has no coordinates along it; use PointCoordinates or an expression"
        )

    @property
    def joint(self) -> Joint | None:
        """The joint along its coordinate; None if it is not a joint."""
        return None

    @property
    def friction_parameter(self) -> str | None:
        """The name of its coefficient of friction among its parameters; None without one."""
        return None

    def sliding(self, kinematics: Kinematics) -> ca.SX | None:
        """The sliding velocity, m/s, shape (3, 1); None without friction."""
        return None

    def touch(self, frames: Frames) -> Touch | None:
        """The contact point; None without a free side."""
        return None

    def surface_at(self, values: FloatArray) -> Surface | None:
        """The surface that it touches, for the values of its parameters in one vector."""
        return None

    def placement(self, values: FloatArray) -> RigidTransform:
        """The pose of that surface in the world, for the values of its parameters."""
        return RigidTransform()
