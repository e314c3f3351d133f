"""Presliding: friction whose bristles bend before surfaces slide, the LuGre model."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.dae.system.signals import Parameter, Signal
from drake_dae.errors import ModelError

AT_REST = 1e-60
"""The rate in 1/s below which |v| / delta is rounded off, so that |v| has a derivative at rest."""


@checked(ModelError)
@dataclass(frozen=True)
class Presliding:
    """Dry friction with presliding, by bristles that bend before the surfaces slide (LuGre).

    With the sliding velocity v, the Coulomb force F_c, which is mu lambda at a contact, and the
    deflection z of the bristles as a multiple of the distance delta, the friction force is

        F = -F_c (z + T(v) z'),               z' = (v - |v| z / g(v)) / delta,
        g(v) = 1 + (rho - 1) exp(-(|v| / v_s)^2),    T(v) = T exp(-(T |v| / delta)^2).

    At rest friction is a spring with the stiffness F_c / delta: a force below rho F_c holds without
    creep. In steady sliding |F| = F_c g(v), from rho F_c at small speeds to F_c (Stribeck curve).
    For a constant F_c friction is passive with the stored energy F_c delta |z|^2 / 2, since T(v)
    |v| / delta < 0.43 is below 4 g(v). A constant T would not be passive.

    z is a state of the robot, at the end of x. Its time constant in sliding is delta / |v|: an
    integrator with fixed steps needs steps below twice that, and error control finds them itself.

    Canudas de Wit, Olsson, Astrom and Lischinsky, "A new model for control of systems with
    friction", 1995; Astrom and Canudas de Wit, "Revisiting the LuGre friction model", 2008, for the
    damping.

    Attributes:
        distance: delta in m (rad), positive: the deflection at which the linear spring would reach
            the Coulomb force.
        static_ratio: rho, static over dynamic friction, a pure number, at least 1.
        stribeck_speed: v_s in m/s (rad/s), positive.
        damping_time: T in s, positive.

    Raises:
        ModelError: A number is not in its range.
    """

    distance: float
    static_ratio: float = 1.0
    stribeck_speed: float = 1e-3
    damping_time: float = 3e-3

    def __post_init__(self) -> None:
        for name in ("distance", "stribeck_speed", "damping_time"):
            positive(f"the {name} of presliding", getattr(self, name))
        if not self.static_ratio >= 1.0:
            raise ModelError(
                "static friction is at least dynamic friction: the static_ratio of presliding must "
                f"be 1 or more, got {self.static_ratio}"
            )

    def parameters(self, name: str) -> list[Parameter]:
        """The numbers as parameters "<name>.presliding_distance", ... of a contact."""
        return [
            Parameter(f"{name}.{key}", np.array([value]), unit, positive=True)
            for key, value, unit in (
                ("presliding_distance", self.distance, "m"),
                ("static_ratio", self.static_ratio, ""),
                ("stribeck_speed", self.stribeck_speed, "m/s"),
                ("damping_time", self.damping_time, "s"),
            )
        ]


@dataclass(frozen=True, eq=False)
class FrictionState:
    """States that the friction of a contact or a joint adds to those of its robot.

    Attributes:
        state: The symbols, shape (k, 1).
        signals: Their names and units.
        rate: Their rates, shape (k, 1).
        open_rate: The rates while the contact is open, shape (k, 1).
    """

    state: ca.SX
    signals: tuple[Signal, ...]
    rate: ca.SX
    open_rate: ca.SX

    @property
    def owner(self) -> str:
        """The name of the first contact or joint."""
        return self.signals[0].name.partition(".bristle")[0]

    def after(self, period: float) -> ca.SX:
        """The states after a period in s of constant velocities, implicitly, shape (k, 1)."""
        decay = -ca.diag(ca.jacobian(self.rate, self.state))
        return self.state + period * self.rate / (1.0 + period * decay)

    @classmethod
    def of(cls, parts: Sequence["FrictionState"]) -> "FrictionState":
        """The states of several contacts or joints together."""
        none = ca.SX(0, 1)
        return cls(
            ca.vertcat(none, *(part.state for part in parts)),
            tuple(signal for part in parts for signal in part.signals),
            ca.vertcat(none, *(part.rate for part in parts)),
            ca.vertcat(none, *(part.open_rate for part in parts)),
        )


@dataclass(frozen=True, eq=False)
class Bristles:
    """The bristles of one contact or joint, with the equations of `Presliding`.

    Attributes:
        state: z, symbols, shape (k, 1).
        signals: The names of z.
        distance, static_ratio, stribeck_speed, damping_time: The numbers of `Presliding`.
    """

    state: ca.SX
    signals: tuple[Signal, ...]
    distance: ca.SX
    static_ratio: ca.SX
    stribeck_speed: ca.SX
    damping_time: ca.SX

    @classmethod
    def of(cls, names: Sequence[str], numbers: Sequence[ca.SX]) -> "Bristles":
        """New symbols for z with these names, and the four numbers of `Presliding`."""
        symbols = ca.vertcat(*(ca.SX.sym(name) for name in names))
        return cls(symbols, tuple(Signal(name, "") for name in names), *numbers)

    def _speed(self, sliding: ca.SX) -> ca.SX:
        return ca.sqrt(ca.sumsqr(sliding) + (AT_REST * self.distance) ** 2)

    def rate(self, sliding: ca.SX) -> ca.SX:
        """z' for a sliding velocity v, both of shape (k, 1)."""
        speed = self._speed(sliding)
        slow = ca.exp(-((speed / self.stribeck_speed) ** 2))
        steady = 1.0 + (self.static_ratio - 1.0) * slow
        return (sliding - speed / steady * self.state) / self.distance

    def bent(self, sliding: ca.SX, normal: ca.SX, rotation: ca.SX) -> tuple[ca.SX, FrictionState]:
        """The traction on a point of a surface in the world, shape (3, 1), and the state.

        Args:
            sliding, normal: The velocity along the surface and its normal, in the world.
            rotation: The orientation of the surface, in whose axes z is, shape (3, 3).
        """
        along = ca.mtimes(rotation.T, sliding)
        traction = ca.mtimes(rotation, self.traction(along))
        # Where a surface is curved, it turns under its bristles.
        return traction - normal * ca.dot(normal, traction), self.state_at(along)

    def state_at(self, sliding: ca.SX) -> FrictionState:
        """z with its rates; in an open contact it decays with the time constant T."""
        free = -self.state / self.damping_time
        return FrictionState(self.state, self.signals, self.rate(sliding), free)

    def traction(self, sliding: ca.SX) -> ca.SX:
        """z + T(v) z', the friction force relative to -F_c, shape (k, 1)."""
        fast = self.damping_time * self._speed(sliding) / self.distance
        return self.state + self.damping_time * ca.exp(-(fast**2)) * self.rate(sliding)
