"""The frames of a robot, their motion, and the forces that act on them."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, Self

import casadi as ca
from numpy.typing import ArrayLike

from drake_dae.arrays import unknown_name
from drake_dae.dae import Signal
from drake_dae.errors import ModelError

ORIGIN = (0.0, 0.0, 0.0)


class Frames(Protocol):
    """The poses of frames, as expressions. Frames are given by name; "world" is one.

    `Links` and `Kinematics` are both of this kind, so functions of positions accept either.
    """

    @property
    def q(self) -> ca.SX:
        """Generalized positions, symbols, shape (nq, 1)."""

    @property
    def position_signals(self) -> tuple[Signal, ...]:
        """Names and units of q."""

    def rotation(self, frame: Any) -> ca.SX:
        """R_WF, shape (3, 3): the orientation of a frame in the world."""

    def position(self, frame: Any, point: ArrayLike = ORIGIN) -> ca.SX:
        """p_W in m, shape (3, 1): the position of a point that is fixed in a frame."""


def position_index(frames: Frames, name: str) -> int:
    """The index of a name among the generalized positions.

    Raises:
        ModelError: There is none of that name.
    """
    names = [signal.name for signal in frames.position_signals]
    if name not in names:
        raise ModelError(unknown_name("joint position", name, names))
    return names.index(name)


@dataclass(frozen=True, eq=False)
class JointAxis:
    """The force and moment of a unit generalized force of a joint, in the world.

    Attributes:
        child, parent: Names of the bodies' frames: force and moment act on the child, the opposite
            on the parent.
        point: The point of application of the force, in m, shape (3, 1).
        force: In N per unit of generalized force, shape (3, 1); zero for a rotational joint.
        moment: In N m per unit of generalized force, shape (3, 1).
    """

    child: str
    parent: str
    point: ca.SX
    force: ca.SX
    moment: ca.SX


@dataclass(frozen=True, eq=False)
class Reaction:
    """Forces that act on a robot.

    Attributes:
        generalized: A generalized force, shape (nv, k).
        wrenches: Frame -> the force in N and the moment in N m on it, both in the world, the
            force at the frame's origin, shapes (3, k).

    A single reaction has k = 1 column; k columns are k reactions.
    """

    generalized: ca.SX
    wrenches: Mapping[Any, tuple[ca.SX, ca.SX]] = field(default_factory=dict)

    def __add__(self, other: Self) -> "Reaction":
        wrenches = dict(self.wrenches)
        for frame, (force, moment) in other.wrenches.items():
            total = wrenches.get(frame, (0, 0))
            wrenches[frame] = (total[0] + force, total[1] + moment)
        return Reaction(self.generalized + other.generalized, wrenches)

    def map(self, function: Callable[[ca.SX], ca.SX]) -> "Reaction":
        """The reaction with a function applied to every expression in it."""
        wrenches = {frame: (function(f), function(m)) for frame, (f, m) in self.wrenches.items()}
        return Reaction(function(self.generalized), wrenches)


class Kinematics(ABC):
    """The frames of a robot in motion, in which constraints are expressed.

    1. Its expressions contain q, v, the robot's parameters, and symbols of its own for poses and
       velocities of frames; `value` replaces these by their expressions.
    2. `position` and `rotation` are functions of positions, `velocity` and `angular_velocity` are
       linear in velocities, all of them in the world: R' = w x R, and `velocity(frame, point)` is
       the time derivative of `position(frame, point)`.
    3. `derivative(e)` is the time derivative along q' = N(q) v, v' = `acceleration`, of an
       expression e of positions and velocities.
    4. `reaction(power)` are the forces with a given power, linear in velocities: tau . v = power
       with the generalized force tau that `Links` computes from them.
    5. `joint_axis` of a position is the force and moment of its joint; None if the joint has
       several positions, or if it is not known.

    Attributes:
        q, v: Positions and velocities, shapes (nq, 1) and (nv, 1).
        position_signals: Names and units of q.
        acceleration: v', shape (nv, 1).
    """

    q: ca.SX
    position_signals: tuple[Signal, ...]
    v: ca.SX
    acceleration: ca.SX

    @abstractmethod
    def rotation(self, frame: Any) -> ca.SX:
        """R_WF, shape (3, 3): the orientation of a frame in the world."""

    @abstractmethod
    def position(self, frame: Any, point: ArrayLike = ORIGIN) -> ca.SX:
        """p_W in m, shape (3, 1): the position of a point that is fixed in a frame."""

    @abstractmethod
    def angular_velocity(self, frame: Any) -> ca.SX:
        """w in rad/s, shape (3, 1): the angular velocity of a frame, in the world."""

    @abstractmethod
    def velocity(self, frame: Any, point: ArrayLike = ORIGIN) -> ca.SX:
        """p_W' in m/s, shape (3, 1): the velocity of a point that is fixed in a frame."""

    @abstractmethod
    def derivative(self, expression: ca.SX) -> ca.SX:
        """The time derivative of an expression of positions and velocities, shape (k, 1)."""

    @abstractmethod
    def reaction(self, power: ca.SX) -> Reaction:
        """The forces on the links with a power in W that is linear in velocities."""

    @abstractmethod
    def value(self, expression: ca.SX) -> ca.SX:
        """The expression in terms of q, v, `acceleration` and parameters alone."""

    def joint_axis(self, position: str) -> JointAxis | None:
        """The force and moment of the joint of a position, by the position's name."""
        return None

    def push(
        self, frame: Any, force: ca.SX, point: ArrayLike = ORIGIN, moment: ca.SX | None = None
    ) -> Reaction:
        """The reaction of a force at a point of a frame and of a moment; both may depend on v.

        Args:
            frame: The frame.
            force: The force in the world, N, shape (3, 1).
            point: The point, fixed in the frame, in m, shape (3,).
            moment: The moment in the world, N m, shape (3, 1); none if None.
        """
        pushing = ca.SX.sym("force", 3)
        acting, values = pushing, force
        power = ca.dot(pushing, self.velocity(frame, point))
        if moment is not None:
            turning = ca.SX.sym("moment", 3)
            acting, values = ca.vertcat(pushing, turning), ca.vertcat(force, moment)
            power += ca.dot(turning, self.angular_velocity(frame))
        values = ca.densify(values)
        return self.reaction(power).map(lambda part: ca.substitute(part, acting, values))
