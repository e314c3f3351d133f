"""What is zero with the default parameters and signals at rest, looked at with other numbers."""

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
"""A row of numbers at a state, with values of all parameters, and what is negligible in it."""

DOUBTFUL = 1e-13
"""What is above this, relative to the others in its row or column, may be meant."""


class Elsewhere:
    """What is zero with the default parameters and not with other ones, by constraint or output."""

    def __init__(self) -> None:
        self._found: dict[int, Violation] = {}

    def look(self, index: int, violation: Violation, samples: Samples, row: Row) -> None:
        """Looks whether a row that is zero with the default parameters is zero with others, too.

        Args:
            index: Which constraint or output the row belongs to; the first that is not zero counts.
            violation: What it is if it is not.
            samples: The states at which it is zero.
            row: The row at a state, with values of all parameters.

        Warns:
            NegligibleWarning: It counts as zero, and may be meant.
        """
        if index in self._found:
            return
        system = samples.system

        @np.errstate(all="ignore")  # Not finite is no answer.
        def acts(state: FloatArray, parameters: FloatArray, negligible: float) -> bool:
            value, size = row(state, parameters, negligible)
            return bool(np.any(np.abs(value) > VISIBLE * size))

        family = Family(samples.manifold, samples.states)
        deciding = family.deciding(lambda x, p: acts(x, p, system.negligible))
        if deciding:
            self._found[index] = replace(violation, deciding=deciding)
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
        """Refuses a constraint or output whose degree is another one with other parameters.

        Raises:
            AssumptionError: It is; with the numbers that decide.
        """
        if index in self._found:
            raise self._found[index].error()

    def deciding(self, indices: Sequence[int]) -> Deciding | None:
        """The numbers that decide about some on which nothing acts with the default ones."""
        found = (self._found[i].deciding for i in indices if i in self._found)
        return next(found, None)
