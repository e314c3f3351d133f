"""The contract of a constraint (38), and all constraints of a robot together (37)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import casadi as ca
from pydrake.math import RigidTransform

from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae import Parameter, Signal, UnilateralInput, places_of
from drake_dae.errors import ModelError
from drake_dae.robots.links import Application, Frames, Kinematics, Links, Reaction
from drake_dae.robots.surface import Surface, Vector


@dataclass(frozen=True, eq=False)
class Touch:
    """A contact of a point of a robot with an object that has a free side."""

    frame: str
    point: Vector  # In the frame, m.
    normal: ca.SX  # Toward the free side, in the world, shape (3, 1).
    clearance: Callable[[ca.SX], ca.SX]  # A point in the world -> its distance into the free side.
    velocity: Callable[[ca.SX], ca.SX] = lambda point: ca.SX(3, 1)  # Of the object at a point.
    is_exact: bool = True  # Whether the distance is exact also off the object.


class Constraint(ABC):
    """m constraint equations of a robot, and the m constraint forces lambda that enforce them.

    1. It is an expression of `Kinematics` (its position part of `Frames`) and of its `parameters`,
       smooth in the workspace. These are made once, have names that begin with "<name>.", and may
       move (see `RobotModel`) if it is holonomic.
    2. `residual` is phi(q), shape (m, 1), zero if the constraint holds. A nonholonomic one, which
       restricts velocities alone (r = 1), has none and defines `rate` itself.
    3. `rate`, shape (m, 1), is linear in velocities, and zero where the constraint holds: without
       motion of its parameters the derivative of `residual`. Where it holds, lambda . rate is the
       power of the forces without friction: lambda is a force in N if the rate is a velocity in
       m/s. Where `is_unilateral`, lambda >= 0 pushes to the free side.
    4. `reaction` is linear in lambda: the gradient of that power by the velocities, and forces
       proportional to lambda, as of friction. `drag` are forces independent of lambda.
    5. `applications` are all these forces, each on one frame and the opposite on another; none if
       the frames are not known. Pictures show the first. If the constraint holds and does not move,
       their power is zero where `is_ideal`, and not positive otherwise.
    6. `coordinates` are free coordinates along it, one row for each of `coordinate_signals`.
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
        """Names and units of phi, or of the rate of a nonholonomic constraint."""
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
        """phi(q), shape (m, 1), or (0, 1) if velocities alone are restricted."""
        return ca.SX(0, 1)

    def rate(self, kinematics: Kinematics) -> ca.SX:
        """phi'(q, v), or what restricts velocities alone, shape (m, 1)."""
        return kinematics.derivative(self.residual(kinematics))

    def reaction(self, kinematics: Kinematics, constraint_force: ca.SX) -> Reaction:
        """The reaction on the robot of the constraint forces, shape (m, 1)."""
        return kinematics.reaction(ca.dot(constraint_force, self.rate(kinematics)))

    def drag(self, kinematics: Kinematics) -> Reaction:
        """The forces on the robot independent of constraint forces."""
        return Reaction(ca.SX(kinematics.v.numel(), 1))

    @abstractmethod
    def applications(self, kinematics: Kinematics) -> tuple[Application, ...]:
        """The points and frames on which the constraint forces act."""

    @property
    def coordinate_signals(self) -> tuple[Signal, ...]:
        """Names and units of `coordinates`."""
        return ()

    def coordinates(self, frames: Frames) -> ca.SX:
        """The free coordinates along the constraint, shape (k, 1)."""
        return ca.SX(0, 1)

    @property
    def motors(self) -> tuple[Signal, ...]:
        """Names and units of the controls that act at it: the effort of a motor in its joint."""
        return ()

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


class ConstraintSet:
    """The constraints of a robot, stacked in the order of their `size` constraint forces."""

    def __init__(self, constraints: Sequence[Constraint]) -> None:
        self.constraints = constraints
        self.parameters = tuple(p for c in constraints for p in c.parameters)
        self.force_signals = tuple(s for c in constraints for s in c.force_signals)
        self.residual_signals = tuple(s for c in constraints for s in c.residual_signals)
        self.motors = tuple(s for c in constraints for s in c.motors)
        self.size = len(self.force_signals)

    def place(self, name: str) -> int:
        """The index of a constraint force in lambda; ModelError if there is none."""
        return places_of("constraint force", [name], self.force_signals)[0]

    def parts(self) -> Iterator[tuple[Constraint, slice]]:
        """Each constraint, and the slice of its constraint forces."""
        start = 0
        for constraint in self.constraints:
            stop = start + len(constraint.force_signals)
            yield constraint, slice(start, stop)
            start = stop

    def residual(self, frames: Frames) -> ca.SX:
        """phi(q) of the rows that restrict positions, shape (k, 1)."""
        return ca.vertcat(ca.SX(0, 1), *[c.residual(frames) for c in self.constraints])  # (38)

    def rate(self, kinematics: Kinematics) -> ca.SX:
        """phi'(q, v), and the rates of rows that restrict velocities alone, shape (m, 1)."""
        return ca.vertcat(ca.SX(0, 1), *[c.rate(kinematics) for c in self.constraints])

    def constraint_output(self, kinematics: Kinematics) -> ca.SX:
        """k of (2), shape (m, 1): phi, or the rates of those that restrict velocities alone."""
        rows = [ca.SX(0, 1)]
        for constraint in self.constraints:
            residual = constraint.residual(kinematics)
            rows.append(residual if residual.numel() else constraint.rate(kinematics))
        return kinematics.value(ca.vertcat(*rows))

    def reaction(self, kinematics: Kinematics, constraint_force: ca.SX) -> Reaction:
        """The reaction on the robot of the constraint forces, shape (m, 1)."""
        total = Reaction(ca.SX(kinematics.v.numel(), 1))
        for constraint, part in self.parts():
            total += constraint.reaction(kinematics, constraint_force[part])
        return total

    def force_matrix(self, links: Links) -> ca.SX:
        """G of M v' + H = G lambda + B tau, shape (nv, m): J^T without friction."""
        kinematics, force = links.kinematics(), ca.SX.sym("force", self.size)
        # (41)
        columns = self.reaction(kinematics, force).map(lambda part: ca.jacobian(part, force))
        return links.generalized_force(kinematics, columns)

    def implicit(self, links: Links, acceleration: ca.SX, force: ca.SX) -> tuple[ca.SX, ca.SX]:
        """M v' + H - G lambda, shape (nv, 1), and phi'', shape (m, 1), without M and J."""  # (38)
        kinematics = links.kinematics(acceleration)
        balance = links.inverse_dynamics(kinematics, self.reaction(kinematics, force))
        return balance, kinematics.value(kinematics.derivative(self.rate(kinematics)))

    def drag(self, links: Links) -> ca.SX:
        """The generalized force of constraints independent of lambda, shape (nv, 1)."""
        total, kinematics = ca.SX(links.v.numel(), 1), links.kinematics()
        for constraint in self.constraints:
            total += links.generalized_force(kinematics, constraint.drag(kinematics))
        return total

    def acting(self, kinematics: Kinematics) -> list[tuple[Constraint, slice, Application]]:
        """The constraints that act at a point, slices of their forces, and their first points."""
        return [
            (constraint, part, application)
            for constraint, part in self.parts()
            for application in constraint.applications(kinematics)[:1]
        ]

    def force_on(
        self, frame: str, name: str, kinematics: Kinematics, constraint_force: ca.SX
    ) -> tuple[ca.SX, ca.SX]:
        """The point and force in N of a constraint on a frame, both in the world, shapes (3, 1)."""
        parts = {constraint.name: (constraint, part) for constraint, part in self.parts()}
        if name not in parts:
            raise ModelError(unknown_name("constraint", name, parts))
        constraint, part = parts[name]
        acting = constraint.applications(kinematics)
        on_frame = [a for a in acting if frame in (a.frame_a, a.frame_b)]
        if len(on_frame) != 1:
            frames = ", ".join(f for a in acting for f in (a.frame_a, a.frame_b))
            raise ModelError(
                f"constraint '{name}' must act at one point of '{frame}'; it acts on {frames}"
            )
        sign = 1.0 if frame == on_frame[0].frame_b else -1.0
        return on_frame[0].point, sign * on_frame[0].force(constraint_force[part])

    def wrenches(
        self, kinematics: Kinematics, constraint_force: ca.SX
    ) -> tuple[ca.SX, tuple[Signal, ...]]:
        """Moment and force of each constraint on each of its frames, at its origin in the world."""
        rows, names = [ca.SX(0, 1)], []
        for constraint, part in self.parts():
            by_frame: dict[str, ca.SX] = {}
            for application in constraint.applications(kinematics):
                force = application.force(constraint_force[part])
                moment = ca.mtimes(application.moment_axes, constraint_force[part])
                for frame, sign in ((application.frame_b, 1.0), (application.frame_a, -1.0)):
                    lever = application.point - kinematics.position(frame)
                    wrench = ca.vertcat(moment + ca.cross(lever, force), force)
                    by_frame[frame] = by_frame.get(frame, ca.SX(6, 1)) + sign * wrench
            rows += by_frame.values()
            names += [f"{constraint.name}.{frame}" for frame in by_frame]
        parts = (("mx", "N m"), ("my", "N m"), ("mz", "N m"), ("fx", "N"), ("fy", "N"), ("fz", "N"))
        signals = tuple(Signal(f"{name}.{part}", unit) for name in names for part, unit in parts)
        return kinematics.value(ca.vertcat(*rows)), signals

    def contacts(self, links: Links) -> tuple[UnilateralInput, ...]:
        """The unilateral constraint forces, if friction acts on one of them."""
        kinematics, contacts = links.kinematics(), []
        for constraint in self.constraints:
            sliding = constraint.sliding(kinematics)
            sliding = None if sliding is None else kinematics.value(sliding)
            pairs = zip(constraint.force_signals, constraint.is_unilateral, strict=True)
            names = [signal.name for signal, pushes in pairs if pushes]
            contacts += [UnilateralInput(n, constraint.friction_parameter, sliding) for n in names]
        return tuple(contacts) if any(contact.friction for contact in contacts) else ()
