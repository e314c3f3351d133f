"""Friction of a point on a surface: Coulomb and viscous friction."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import positive
from drake_dae.dae import Parameter
from drake_dae.errors import ModelError


@dataclass(frozen=True, eq=False)
class Friction:
    """The friction force on a point that slides on a surface: F_t = pull lambda + drag.

    Attributes:
        pull: -mu s, the force in N for a unit of the normal force, shape (3, 1).
        drag: -d v_t in N, shape (3, 1); None without viscous friction.
    """

    pull: ca.SX
    drag: ca.SX | None

    @classmethod
    def of(cls, name: str, parameters: Sequence[Parameter], sliding: ca.SX) -> "Friction":
        """The friction by the parameters that `friction_parameters` made.

        Args:
            name: The name of the constraint.
            parameters: Its parameters.
            sliding: v_t, the velocity of the point along the surface, m/s, shape (3, 1).
        """
        symbols = {p.name.removeprefix(f"{name}."): p.symbol for p in parameters}
        pull, drag = ca.SX(3, 1), None
        if "friction" in symbols:
            speed = ca.sqrt(ca.sumsqr(sliding) + symbols["stiction_tolerance"] ** 2)
            pull = -symbols["friction"] * (sliding / speed)
        if "viscous_friction" in symbols:
            drag = -symbols["viscous_friction"] * sliding
        return cls(pull, drag)


def friction_parameters(
    name: str,
    friction: float | None,
    stiction_tolerance: float,
    viscous_friction: float | None,
) -> list[Parameter]:
    """The parameters of the given kinds of friction.

    Args:
        name: The name of the constraint.
        friction: mu.
        stiction_tolerance: v_s in m/s.
        viscous_friction: d in N s/m.

    Raises:
        ModelError: A coefficient is negative, or the speed not positive.
    """
    tolerance = Parameter(
        f"{name}.stiction_tolerance", np.array([stiction_tolerance]), "m/s", positive=True
    )
    parameters = []
    if friction is not None:
        coefficient = Parameter(f"{name}.friction", np.array([friction]), nonnegative=True)
        parameters += [coefficient, tolerance]
    if viscous_friction is not None:
        value = np.array([viscous_friction])
        parameters.append(Parameter(f"{name}.viscous_friction", value, "N s/m", nonnegative=True))
    return parameters


@dataclass(frozen=True)
class FrictionCone:
    """The bound |tangential force| <= limit * normal force of a contact that must not slide.

    Attributes:
        normal: The name of the normal force, a constraint force that is positive in contact.
        tangents: The names of one or two tangential forces.
        limit: The largest ratio of the forces, positive: the coefficient of static friction.

    Raises:
        ModelError: The limit is not positive, or there are not one or two tangential forces.
    """

    normal: str
    tangents: Sequence[str]
    limit: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "tangents", tuple(self.tangents))
        positive("limit", self.limit)
        if not 1 <= len(self.tangents) <= 2:
            raise ModelError(
                f"a friction cone has one or two tangential forces, got {len(self.tangents)}"
            )
