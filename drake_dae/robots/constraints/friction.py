"""Friction of a point on a surface: Coulomb friction, with or without bristles, and viscous."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import positive
from drake_dae.dae.system.signals import Parameter
from drake_dae.errors import ModelError
from drake_dae.robots.constraints.presliding import Bristles, Presliding


@dataclass(frozen=True, eq=False)
class Friction:
    """The friction force on a point that slides on a surface: F_t = pull lambda + drag.

    Attributes:
        pull: -mu s, the force in N for a unit of the normal force, shape (3, 1); with bristles s is
            their traction.
        drag: -d v_t in N, shape (3, 1); None without viscous friction.
    """

    pull: ca.SX
    drag: ca.SX | None

    @classmethod
    def of(
        cls,
        name: str,
        parameters: Sequence[Parameter],
        sliding: ca.SX,
        traction: ca.SX | None = None,
    ) -> "Friction":
        """The friction by the parameters that `friction_parameters` made.

        Args:
            name: The name of the constraint.
            parameters: Its parameters.
            sliding: v_t, the velocity of the point along the surface, m/s, shape (3, 1).
            traction: That of its bristles, shape (3, 1); None without.
        """
        symbols = {p.name.removeprefix(f"{name}."): p.symbol for p in parameters}
        pull, drag = ca.SX(3, 1), None
        if "friction" in symbols:
            if traction is None:
                speed = ca.sqrt(ca.sumsqr(sliding) + symbols["stiction_tolerance"] ** 2)
                traction = sliding / speed
            pull = -symbols["friction"] * traction
        if "viscous_friction" in symbols:
            drag = -symbols["viscous_friction"] * sliding
        return cls(pull, drag)


def friction_parameters(
    name: str,
    friction: float | None,
    stiction_tolerance: float,
    viscous_friction: float | None,
    presliding: Presliding | None,
) -> list[Parameter]:
    """The parameters of the given kinds of friction.

    Args:
        name: The name of the constraint.
        friction: mu.
        stiction_tolerance: v_s in m/s.
        viscous_friction: d in N s/m.
        presliding: The bristles, which take the place of v_s.

    Raises:
        ModelError: A coefficient is negative, the speed not positive, or bristles are without mu.
    """
    tolerance = Parameter(
        f"{name}.stiction_tolerance", np.array([stiction_tolerance]), "m/s", positive=True
    )
    parameters = []
    if friction is not None:
        coefficient = Parameter(f"{name}.friction", np.array([friction]), nonnegative=True)
        parameters += [coefficient, *(presliding.parameters(name) if presliding else [tolerance])]
    elif presliding is not None:
        raise ModelError(
            f"'{name}' has presliding and no friction: give the coefficient of friction too"
        )
    if viscous_friction is not None:
        value = np.array([viscous_friction])
        parameters.append(Parameter(f"{name}.viscous_friction", value, "N s/m", nonnegative=True))
    return parameters


def bristles_of(name: str, parameters: Sequence[Parameter]) -> Bristles:
    """The bristles of a point, in the axes of its surface, by its parameters."""
    symbols = {p.name.removeprefix(f"{name}."): p.symbol for p in parameters}
    keys = ("presliding_distance", "static_ratio", "stribeck_speed", "damping_time")
    return Bristles.of([f"{name}.bristle_{axis}" for axis in "xyz"], [symbols[key] for key in keys])


@checked(ModelError)
@dataclass(frozen=True)
class FrictionCone:
    """The limit |tangential force| <= friction * normal force of a contact that must not slide.

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
        positive("friction", self.friction)
        if not 1 <= len(self.tangents) <= 2:
            raise ModelError(
                f"a friction cone has one or two tangential forces, got {len(self.tangents)}"
            )
