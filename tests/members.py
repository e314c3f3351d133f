"""Members of the families of robots that the package does not know: one class each.

They show what it takes to add one, and keep the contracts as those of the package do.
"""

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from drake_dae import PointOnSurface
from drake_dae.dae.signals import Parameter, Signal
from drake_dae.robots.actuation.numbers import diagonal_parameter
from drake_dae.robots.actuation.stage import AttachedStage, Stage
from drake_dae.robots.contact.constraint import Application, Constraint
from drake_dae.robots.contact.surface import Surface


@dataclass(frozen=True)
class FixedDistance(Constraint):
    """A rod without mass between a point of frame A and a point of frame B.

    Positive is its thrust in N, by which it pushes the points apart.
    """

    frame_a: str
    point_a: tuple
    frame_b: str
    point_b: tuple
    length: float
    name: str = "rod"
    parameters: tuple[Parameter, ...] = field(init=False, repr=False)

    def __post_init__(self):
        own = Parameter(f"{self.name}.length", self.length, "m", positive=True)
        object.__setattr__(self, "parameters", (own,))

    @property
    def force_signals(self):
        return (Signal(f"{self.name}.thrust", "N"),)

    @property
    def residual_signals(self):
        return (Signal(f"{self.name}.stretch", "m"),)

    def _apart(self, frames):
        start = frames.position(self.frame_a, self.point_a)
        return frames.position(self.frame_b, self.point_b) - start

    def residual(self, frames):
        return ca.norm_2(self._apart(frames)) - self.parameters[0].symbol

    def application(self, kinematics):
        apart = self._apart(kinematics)
        point = kinematics.position(self.frame_b, self.point_b)
        return Application(point, apart / ca.norm_2(apart), ca.SX(3, 1))


@dataclass(frozen=True)
class RubbingPoint(PointOnSurface):
    """A point on a surface with Coulomb friction, made smooth by a small speed in m/s."""

    friction: float = 0.3
    speed: float = 0.05

    def _sliding(self, kinematics):
        """s = v_t / sqrt(|v_t|^2 + speed^2), shape (3, 1)."""
        normal = self.surface.unit_normal(self.offset(kinematics))
        velocity = kinematics.velocity(self.frame, self.point)
        across = velocity - normal * ca.dot(normal, velocity)
        return across / ca.sqrt(ca.sumsqr(across) + self.speed**2)

    def reaction(self, kinematics, constraint_force):
        rubbing = -self.friction * constraint_force * self._sliding(kinematics)
        pushed = super().reaction(kinematics, constraint_force)
        return pushed + kinematics.push(self.frame, rubbing, self.point)

    def application(self, kinematics):
        own = super().application(kinematics)
        rubbing = -self.friction * self._sliding(kinematics)
        return Application(own.point, own.force_axes + rubbing, own.moment_axes)


@dataclass(frozen=True)
class Skate(Constraint):
    """The origin of a frame does not move along the frame's y axis: no constraint on positions."""

    frame: str
    name: str = "skate"

    @property
    def force_signals(self):
        return (Signal(f"{self.name}.side_force", "N"),)

    @property
    def residual_signals(self):
        return (Signal(f"{self.name}.side_speed", "m/s"),)

    def rate(self, kinematics):
        return ca.dot(kinematics.rotation(self.frame)[:, 1], kinematics.velocity(self.frame))

    def application(self, kinematics):
        sideways = kinematics.rotation(self.frame)[:, 1]
        return Application(kinematics.position(self.frame), sideways, ca.SX(3, 1))


@dataclass(frozen=True)
class Coupler(Constraint):
    """Two joints turn together, q_i + ratio q_j = offset; its moment acts at no point."""

    first: int
    second: int
    ratio: float
    offset: float
    name: str = "coupler"

    @property
    def force_signals(self):
        return (Signal(f"{self.name}.moment", "N m"),)

    @property
    def residual_signals(self):
        return (Signal(f"{self.name}.slip", "rad"),)

    def residual(self, frames):
        return frames.q[self.first] + self.ratio * frames.q[self.second] - self.offset

    def application(self, kinematics):
        return None


@dataclass(frozen=True)
class Saddle(Surface):
    """z = bend (x^2 - y^2) above a point; the free side is above."""

    point: tuple
    bend: float

    @property
    def position(self):
        return self.point

    def distance(self, offset):
        x, y, z = ca.vertsplit(offset)
        slope = 2.0 * self.bend * ca.sqrt(x**2 + y**2)
        return (z - self.bend * (x**2 - y**2)) / ca.sqrt(1.0 + slope**2)


@dataclass(frozen=True, eq=False)
class TorqueLag(Stage):
    """Drives whose torque follows the control with a lag: T tau' = u - tau."""

    time_constant: float | np.ndarray

    def attach(self, links):
        count = len(links.actuator_signals)
        parameter, T = diagonal_parameter(
            "torque_lag.time_constant", self.time_constant, count, "s", positive=True
        )
        torque = ca.SX.sym("tau", count)
        return AttachedStage(
            state=torque,
            state_signals=tuple(Signal(f"{s.name}.torque", s.unit) for s in links.actuator_signals),
            mass=ca.diag(T),
            drift=lambda position, velocity: -torque,
            drive_matrix=ca.SX.eye(count),
            drive_signals=tuple(links.actuator_signals),
            force=lambda position, velocity: torque,
            parameters=(parameter,),
            ports={"lagged_torque": slice(0, count)},
        )


def subclasses(family, package="drake_dae"):
    """Every class of a family that the package has and that can be made."""
    found, waiting = set(), [family]
    while waiting:
        for cls in waiting.pop().__subclasses__():
            waiting.append(cls)
            if cls.__module__.startswith(package) and not cls.__abstractmethods__:
                found.add(cls)
    return found
