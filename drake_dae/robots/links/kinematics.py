"""Where the frames of a robot are, how they move, and the forces that act on them."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, Self

import casadi as ca
from numpy.typing import ArrayLike

from drake_dae.arrays import unknown_name
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError

ORIGIN = (0.0, 0.0, 0.0)


class Frames(Protocol):
    """Where frames are, as expressions. A frame goes by its name; "world" is one.

    `Links` and `Kinematics` are both of this kind, so that what depends on positions alone takes
    either.
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
        """p_W in m, shape (3, 1): where a point that is fixed in a frame is in the world."""


def position_index(frames: Frames, name: str) -> int:
    """Where a name stands among the generalized positions.

    Raises:
        ModelError: There is none of that name.
    """
    names = [signal.name for signal in frames.position_signals]
    if name not in names:
        raise ModelError(unknown_name("joint position", name, names))
    return names.index(name)


@dataclass(frozen=True, eq=False)
class JointAxis:
    """What a unit of the generalized force of a joint is, in the world.

    Attributes:
        child, parent: Names of the bodies' frames: the child feels the force and the moment, the
            parent the opposite.
        point: Where the force acts, in m, shape (3, 1).
        force: In N for a unit of the generalized force, shape (3, 1); zero of a joint that turns.
        moment: In N m for a unit of the generalized force, shape (3, 1).
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
            own = wrenches.get(frame, (0, 0))
            wrenches[frame] = (own[0] + force, own[1] + moment)
        return Reaction(self.generalized + other.generalized, wrenches)

    def map(self, function: Callable[[ca.SX], ca.SX]) -> "Reaction":
        """The reaction with a function applied to every expression in it."""
        wrenches = {frame: (function(f), function(m)) for frame, (f, m) in self.wrenches.items()}
        return Reaction(function(self.generalized), wrenches)


class Kinematics(ABC):
    """The frames of a robot in motion: what constraints are written in.

    1. Its expressions hold q, v, the robot's parameters, and symbols of its own that may stand for
       poses and velocities of frames; `value` replaces these by what they stand for.
    2. `position` and `rotation` are functions of positions, `velocity` and `angular_velocity` are
       linear in velocities, all of them in the world: R' = w x R, and `velocity(frame, point)` is
       the time derivative of `position(frame, point)`.
    3. `derivative(e)` is the time derivative along q' = N(q) v, v' = `acceleration`, of an
       expression e of positions and velocities.
    4. `reaction(power)` are the forces whose power that is: for a power that is linear in
       velocities, tau . v = power with the generalized force tau that `Links` makes of them.
    5. `joint_axis` of a position is how the joint pushes that it belongs to; None where the joint
       has several positions, or where nobody knows.

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
        """p_W in m, shape (3, 1): where a point that is fixed in a frame is in the world."""

    @abstractmethod
    def angular_velocity(self, frame: Any) -> ca.SX:
        """w in rad/s, shape (3, 1): how fast a frame turns, in the world."""

    @abstractmethod
    def velocity(self, frame: Any, point: ArrayLike = ORIGIN) -> ca.SX:
        """p_W' in m/s, shape (3, 1): how fast a point that is fixed in a frame moves."""

    @abstractmethod
    def derivative(self, expression: ca.SX) -> ca.SX:
        """The time derivative of an expression of positions and velocities, shape (k, 1)."""

    @abstractmethod
    def reaction(self, power: ca.SX) -> Reaction:
        """The forces whose power in W is an expression that is linear in velocities."""

    @abstractmethod
    def value(self, expression: ca.SX) -> ca.SX:
        """The expression in terms of q, v, `acceleration` and parameters alone."""

    def joint_axis(self, position: str) -> JointAxis | None:
        """How the joint of a position pushes, by the position's name."""
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
        acting, given = pushing, force
        power = ca.dot(pushing, self.velocity(frame, point))
        if moment is not None:
            turning = ca.SX.sym("moment", 3)
            acting, given = ca.vertcat(pushing, turning), ca.vertcat(force, moment)
            power += ca.dot(turning, self.angular_velocity(frame))
        given = ca.densify(given)
        return self.reaction(power).map(lambda part: ca.substitute(part, acting, given))
