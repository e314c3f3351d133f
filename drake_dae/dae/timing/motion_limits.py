"""Limits of drives, joints and contact forces along a motion."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Literal

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import ModelError

Kind = Literal["controls", "states", "rates", "forces"]

Range = tuple[float | None, float | None]
"""The lowest and the highest value of a signal; None without a limit."""

FACETS = 16
"""The number of planes in place of a friction cone with two tangential forces."""


@checked(ModelError)
@dataclass(frozen=True)
class FrictionCone:
    """The limit |tangential force| <= friction * normal force of a contact that must not slide.

    With two tangential forces it is the pyramid of 16 planes inside the cone, which is at most 2 %
    smaller.

    Attributes:
        normal: The name of the normal force, a constraint force that is positive in contact.
        tangents: The names of one or two tangential forces.
        friction: The coefficient of friction, positive.

    Raises:
        ModelError: The friction is not positive, or there are not one or two tangential forces.
    """

    normal: str
    tangents: Sequence[str]
    friction: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "tangents", tuple(self.tangents))
        if not self.friction > 0.0:
            raise ModelError(f"the friction of a cone must be positive, got {self.friction:g}")
        if not 1 <= len(self.tangents) <= 2:
            raise ModelError(
                f"a friction cone has one or two tangential forces, got {len(self.tangents)}"
            )

    def rows(self, forces: Sequence[str]) -> FloatArray:
        """Returns C with C lambda <= 0 inside the cone, shape (k, m).

        Raises:
            ModelError: A name is not that of a constraint force.
        """
        for name in (self.normal, *self.tangents):
            if name not in forces:
                raise ModelError(unknown_name("constraint force", name, forces))
        angles = np.arange(FACETS) * 2.0 * np.pi / FACETS
        directions = np.column_stack([np.cos(angles), np.sin(angles)])
        shrunk = self.friction * np.cos(np.pi / FACETS)
        if len(self.tangents) == 1:
            directions, shrunk = np.array([[1.0], [-1.0]]), self.friction
        rows = np.zeros((len(directions), len(forces)))
        for column, name in enumerate(self.tangents):
            rows[:, forces.index(name)] = directions[:, column]
        rows[:, forces.index(self.normal)] -= shrunk
        return rows


@checked(ModelError)
@dataclass(frozen=True)
class MotionLimits:
    """Limits on the signals of a system, by their names.

    Attributes:
        controls: Control -> its lowest and highest value, in its unit.
        states: State -> its lowest and highest value, such as the velocity of a joint.
        rates: State -> the lowest and highest value of its time derivative, such as the
            acceleration of a joint at the name of its velocity.
        forces: Constraint force -> its lowest and highest value in N or N m.
        cones: Friction cones of contacts that must not slide.
        close: The share of the limit of a state within which its rate is lowered while a motion
            runs, so that the limit is not passed; a motion that leaves this share of all limits is
            not changed. In (0, 1].

    Raises:
        ModelError: A lowest value is not below its highest, or `close` is out of its range.
    """

    controls: Mapping[str, Range] = field(default_factory=dict)
    states: Mapping[str, Range] = field(default_factory=dict)
    rates: Mapping[str, Range] = field(default_factory=dict)
    forces: Mapping[str, Range] = field(default_factory=dict)
    cones: Sequence[FrictionCone] = ()
    close: float = 0.01

    def __post_init__(self) -> None:
        if not 0.0 < self.close <= 1.0:
            raise ModelError(
                "close is a share of the limits of states, above 0 and at most 1, got "
                f"{self.close:g}"
            )
        for kind in ("controls", "states", "rates", "forces"):
            for name, (low, high) in getattr(self, kind).items():
                if low is not None and high is not None and not low < high:
                    raise ModelError(
                        f"{kind}: the lowest value of '{name}' must be below its highest, got "
                        f"{low:g} and {high:g}"
                    )

    def bounds(self, kind: Kind, signals: Sequence[Signal]) -> tuple[FloatArray, FloatArray]:
        """Returns the lowest and highest values of all signals of a kind; infinite without a limit.

        Args:
            kind: "controls", "states", "rates" or "forces".
            signals: The signals.

        Raises:
            ModelError: A name is not that of a signal.
        """
        names = [signal.name for signal in signals]
        low, high = np.full(len(names), -inf), np.full(len(names), inf)
        for name, (least, most) in getattr(self, kind).items():
            if name not in names:
                raise ModelError(f"{kind}: {unknown_name('signal', name, names)}")
            i = names.index(name)
            low[i] = -inf if least is None else least
            high[i] = inf if most is None else most
        return low, high

    def check(self, system: DaeSystem) -> None:
        """Checks that the system has all signals that have limits.

        Raises:
            ModelError: A name is not that of a signal.
        """
        self.bounds("controls", system.control_signals)
        self.bounds("states", system.state_signals)
        self.bounds("rates", system.state_signals)
        self.bounds("forces", system.constraint_input_signals)
        for cone in self.cones:
            cone.rows([signal.name for signal in system.constraint_input_signals])
