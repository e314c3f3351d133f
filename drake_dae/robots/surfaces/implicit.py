"""Surfaces F(p) = 0 of any smooth function F, as a formula or as a function of CasADi."""

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Self

import casadi as ca

from drake_dae.arguments import checked
from drake_dae.errors import ModelError
from drake_dae.robots.surfaces.surface import Surface, Vector, normalized, triple
from drake_dae.trace.expressions import result_of
from drake_dae.trace.formula import check_names, parse_formula

_TAKEN = (
    "position",
    "rpy",
    "force",
    "distance",
    "friction",
    "stiction_tolerance",
    "viscous_friction",
)
"""Names that constraints use for their own parameters and signals."""


@checked(ModelError)
@dataclass(frozen=True)
class ImplicitSurface(Surface):
    """Any smooth surface F(p) = 0: phi = F / |grad F|, the distance to first order.

    The gradient has length one on the surface.

    Attributes:
        function: F relative to `point` in the world's axes, positive on the free side, of any
            scale, with a nonzero gradient on the surface. A formula of x, y, z in m, pi and the
            parameters, as "z - a*sin(x)**2" (see `parse_formula`); or a function of a CasADi column
            p of shape (3, 1), and of a namespace of the parameters if there are any.
        point: The origin of p in the world, m, shape (3,).
        parameters: Name -> number in F, in the unit of F. They become parameters
            "<constraint>.<name>" of a constraint.

    Raises:
        ModelError: The formula cannot be read; the message has the place.
    """

    function: Callable[..., ca.SX] | str
    point: Vector = (0.0, 0.0, 0.0)
    parameters: Mapping[str, float] = field(default_factory=dict, hash=False)
    _shape: ca.SX = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "point", triple("point", self.point))
        object.__setattr__(self, "parameters", dict(self.parameters))
        object.__setattr__(self, "_shape", ca.SX(ca.DM(list(self.parameters.values()))))
        check_names(self.parameters, (*"xyz", *_TAKEN))
        if isinstance(self.function, str):
            value = self._function(ca.SX.sym("p", 3))
            if value.is_constant():
                raise ModelError(f"formula '{self.function}' has none of x, y and z: no surface")

    @property
    def position(self) -> Vector:
        return self.point

    @property
    def shape(self) -> Mapping[str, float]:
        return self.parameters

    def shaped(self, values: ca.SX) -> Self:
        changed = copy(self)
        object.__setattr__(changed, "_shape", values)
        return changed

    def distance(self, offset: ca.SX) -> ca.SX:
        return normalized(self._function, offset)

    def _function(self, p: ca.SX) -> ca.SX:
        """F at a point."""
        names = dict(zip(self.parameters, ca.vertsplit(self._shape), strict=True))
        if isinstance(self.function, str):
            return parse_formula(
                self.function, {**dict(zip("xyz", ca.vertsplit(p), strict=True)), **names}
            )
        more = [SimpleNamespace(**names)] if names else []
        return result_of("function", self.function, p, *more)
