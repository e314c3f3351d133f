"""A reference at another pace."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, positive
from drake_dae.dae.references.reference import Reference


@dataclass(frozen=True, eq=False)
class PacedReference(Reference):
    """The reference r(c t), which passes through the values of r(t) at c times the speed.

    Its derivatives are c^j r^(j)(c t).

    Attributes:
        reference: r.
        pace: c, positive.

    Raises:
        ReferenceSignalError: The pace is not a positive number.
    """

    reference: Reference
    pace: float

    def __post_init__(self) -> None:
        positive("pace", self.pace)

    @property
    def size(self) -> int:
        return self.reference.size

    @property
    def parameters(self) -> Mapping[str, Any]:  # type: ignore[override]
        return self.reference.parameters

    def with_parameters(self, values: Mapping[str, Any]) -> Reference:
        return PacedReference(self.reference.with_parameters(values), self.pace)

    def derivatives(self, degrees: Sequence[int]) -> Callable[[float], FloatArray]:
        function, factors = self.reference.derivatives(degrees), self._factors(degrees)
        return lambda time: factors * function(self.pace * time)

    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX | None:
        moment = ca.SX.sym("t")  # The expression is differentiated by its time, a symbol.
        value = self.reference.expression(degrees, moment)
        if value is None:
            return None
        return ca.substitute(value, moment, self.pace * time) * ca.DM(self._factors(degrees))

    def _factors(self, degrees: Sequence[int]) -> FloatArray:
        """c^0, c^1, ..., c^mu for each output, in the order of the values."""
        return np.concatenate([self.pace ** np.arange(degree + 1.0) for degree in degrees])
