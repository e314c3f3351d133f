"""The outputs to which the references of a scenario refer."""

from collections.abc import Sequence

import numpy as np

from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.errors import ReferenceSignalError, ScenarioError
from drake_dae.references import Reference
from drake_dae.references.by_name import denoted
from drake_dae.scenario.completion.candidates import Candidates
from drake_dae.scenario.scenario import Scenario

_TIMES = 25
"""The number of times along the reference at which choices are compared."""


class ReferredRows:
    """The rows with references, and their values.

    Attributes:
        scenario, candidates: The arguments.
        given: The number of rows of the scenario's outputs.
        missing: The number of missing rows.
        rows: The rows of the scenario's outputs, then completing rows that references name.
    """

    def __init__(
        self,
        scenario: Scenario,
        candidates: Candidates,
        given: int,
        missing: int,
        forces: Sequence[str],
        along: Sequence[int],
    ) -> None:
        """Finds the rows that references name.

        Args:
            scenario: The scenario.
            candidates: Its rows.
            given: The number of rows of the scenario's outputs.
            missing: The number of missing rows.
            forces: The names of the force outputs.
            along: The rows along the surfaces, near the start.

        Raises:
            ScenarioError: A name has no row, or there are too many.
        """
        self.scenario, self.candidates = scenario, candidates
        self.given, self.missing = given, missing
        self._forces, self._along = forces, along
        self._meanings = {name: self._named(name) for name in scenario.references}
        named = dict.fromkeys(row for rows in self._meanings.values() for row in rows)
        beside = [row for row in named if row is not None and row >= given]
        if len(beside) > missing:
            names = ", ".join(candidates.signals[row].name for row in beside)
            text = f"{names} are {len(beside)} outputs, but only {missing} are missing"
            raise ScenarioError(("references", text))
        left = [candidates.signals[row].name for row in range(given) if row not in named]
        if left:
            raise ScenarioError(("references", f"missing: {', '.join(left)}"))
        self.rows = [*range(given), *beside]

    def _named(self, name: str) -> list[int | None]:
        """The rows of a key of the references; None for a force."""
        key, rows = f"references.{name}", list[int | None]()
        for part in map(str.strip, name.split(",")):
            rows += self._meant(part, key)
        reference = self.scenario.references[name]
        if isinstance(reference, Reference) and reference.size != len(rows):
            text = f"{reference.size} values for {len(rows)} outputs"
            raise ScenarioError((key, text))
        return rows

    def _meant(self, name: str, key: str) -> Sequence[int | None]:
        signals = [signal.name for signal in self.candidates.signals]
        outputs = [*signals[: self.given], *self._forces]
        degrees = [2] * self.given + [0] * len(self._forces)
        try:
            places = denoted(name, outputs, degrees)
        except ReferenceSignalError as error:
            if not self.missing:
                raise ScenarioError((key, str(error))) from None
        else:
            return [place if place < self.given else None for place in places]
        # Not yet an output: one of the rows that may complete the outputs.
        along = [signals[row] for row in self._along]
        others = [*along, *(signal for signal in signals[self.given :] if signal not in along)]
        of_point = [signal for signal in along if signal.rpartition(".")[0] == name]
        try:
            chosen = of_point or [others[k] for k in denoted(name, others, [2] * len(others))]
        except ReferenceSignalError:
            text = unknown_name("output", name, [*outputs, *others])
            raise ScenarioError((key, text)) from None
        return [signals.index(signal) for signal in chosen]

    def wanted(self, time: float) -> FloatArray:
        """The values of the referred rows at a time in s, shape (referred,)."""
        values: dict[int | None, float] = {}
        for name, rows in self._meanings.items():
            r = value_at(self.scenario.references[name], len(rows), time)
            values.update(zip(rows, r.tolist(), strict=True))
        return np.array([values[row] for row in self.rows])

    def times(self) -> FloatArray:
        """Times along the references, in s."""
        begin = self.scenario.integrator.start_time
        return np.linspace(begin, begin + self.scenario.duration, _TIMES)

    def at_start(self, rows: Sequence[int]) -> FloatArray:
        """The values of the referred rows at the start, with start.errors."""
        errors = self.scenario.start.errors
        wanted = self.wanted(self.scenario.integrator.start_time)
        signals = [self.candidates.signals[row] for row in rows]
        return wanted + np.array([errors.get(signal.name, 0.0) for signal in signals])


def value_at(reference: Reference | float, size: int, time: float) -> FloatArray:
    """r at a time in s, shape (size,)."""
    if not isinstance(reference, Reference):
        return np.full(size, float(reference))
    return np.asarray(reference.derivatives([0] * size)(time), dtype=float)
