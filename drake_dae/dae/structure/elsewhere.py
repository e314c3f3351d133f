"""Entries that are zero for the default parameters and signals at rest, tested for other values."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.states.family import VISIBLE, Deciding, Family
from drake_dae.dae.states.samples import Samples
from drake_dae.dae.structure.assumptions import Violation
from drake_dae.errors import NegligibleWarning
from drake_dae.trace.round_off import Sized

Row = Callable[[FloatArray, FloatArray, float], Sized]
"""A row of numbers at a state for values of all parameters, and the threshold for zero."""

DOUBTFUL = 1e-13
"""An entry above this, relative to the others in its row or column, may be intended."""


class Elsewhere:
    """Constraints and outputs whose row is zero at the default parameters but not at others."""

    def __init__(self) -> None:
        self._violations: dict[int, Violation] = {}

    def look(self, index: int, violation: Violation, samples: Samples, row: Row) -> None:
        """Tests a row that is zero at the default parameters at other parameters, and records it.

        Warns:
            NegligibleWarning: An entry counts as zero but may be intended.
        """
        if index in self._violations:
            return
        system = samples.system

        @np.errstate(all="ignore")  # Values that are not finite decide nothing.
        def acts(state: FloatArray, parameters: FloatArray, negligible: float) -> bool:
            value, size = row(state, parameters, negligible)
            return bool(np.any(np.abs(value) > VISIBLE * size))

        family = Family(samples.manifold, samples.states)
        deciding = family.deciding(lambda x, p: acts(x, p, system.negligible))
        if deciding:
            self._violations[index] = replace(violation, deciding=deciding)
        defaults = system.parameter_values
        if system.negligible > DOUBTFUL and all(
            acts(state, defaults, DOUBTFUL) for state in samples.states
        ):
            warnings.warn(
                f"{system.name}: what acts on derivative {violation.order} of "
                f"'{violation.names[0]}' is less than {system.negligible:g} of the others, the "
                "system's `negligible`, and counts as zero. If it is meant, choose other units, or "
                "set a smaller number",
                NegligibleWarning,
                stacklevel=5,
            )

    def refuse(self, index: int) -> None:
        """Checks that the degree of a constraint or output is the same for other parameters."""
        if index in self._violations:
            raise self._violations[index].error()

    def deciding(self, indices: Sequence[int]) -> Deciding | None:
        """Returns the parameters for which an input acts on one of some constraints or outputs."""
        violations = (self._violations[i] for i in indices if i in self._violations)
        return next((violation.deciding for violation in violations), None)
