"""The result of an excitation, as values and as text."""

import signal
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drake_dae.analysis.tables import Table, count_of
from drake_dae.arguments import checked
from drake_dae.errors import ModelError
from drake_dae.scenario.scenario import Scenario
from drake_dae.studies.excitation.promised import Criterion, Promised

_MEANING: Mapping[Criterion, str] = {
    "D": "D, the geometric mean of relative deviations along the axes of their ellipsoid",
    "A": "A, the root mean square of relative deviations",
}


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class Excitation:
    """The best motion and force to determine parameters of a plant, with predicted uncertainty.

    Attributes:
        scenario: The scenario with the best values, with all defaults filled in.
        choice: Dotted key -> best value; empty if the unchanged scenario is best.
        before: The predicted uncertainty of the parameters with the unchanged scenario.
        after: The predicted uncertainty with the best values.
        criterion: "D" or "A".
        runs: The number of runs.
        refused: Kind of problem -> number of runs that were refused.
        problems: The problems of the unchanged scenario, in words.
        interrupted: The signal that ended the search early; None if there was none.
    """

    scenario: Scenario = field(repr=False)
    choice: Mapping[str, float]
    before: Promised
    after: Promised
    criterion: Criterion
    runs: int
    refused: Mapping[str, int]
    problems: tuple[str, ...] = ()
    interrupted: signal.Signals | None = None

    @property
    def gain(self) -> float:
        """The criterion before, divided by the criterion after."""
        return self.before.size(self.criterion) / self.after.size(self.criterion)

    def text(self) -> str:
        """The result as lines of text."""
        head = ("parameter", "value", "95 % before", "95 % after", "unit")
        rows = []
        for i, unknown in enumerate(self.after.unknowns):
            around = [_around(result.halves[i]) for result in (self.before, self.after)]
            rows.append((unknown.name, f"{self.after.values[i]:.6g}", *around, unknown.unit))
        lines = [*Table(head, rows, left=len(head)).lines(), ""]
        if self.choice:
            width = max(map(len, self.choice))
            lines += [f"{key.ljust(width)}  {value:.6g}" for key, value in self.choice.items()]
            lines.append("")
        else:
            lines.append("No choice is better than the scenario as it is.")
        return "\n".join([*lines, *self.remarks()])

    def remarks(self) -> list[str]:
        """Sentences on the criteria, the runs and undetermined parameters."""
        remarks = [
            f"{meaning}: {self.before.size(kind):.3g} before, {self.after.size(kind):.3g} after"
            + (" (this one is made small)." if kind == self.criterion else ".")
            for kind, meaning in _MEANING.items()
        ]
        made = f"{count_of(self.runs, 'run')} made"
        counts = [f"{kind} ({count})" for kind, count in self.refused.items()]
        remarks.append(f"{made}; refused: {', '.join(counts)}." if counts else f"{made}.")
        remarks += [f"The scenario as it was is refused: {text}." for text in self.problems]
        remarks += [
            f"Not determined: {', '.join(names)}. Other keys must vary, or fewer be free."
            for names in self.after.undetermined
        ]
        if self.interrupted is not None:
            remarks.append("The search was interrupted; this is the best so far.")
        return remarks

    def to_dict(self) -> dict[str, Any]:
        """The result as plain values."""

        def promised(result: Promised) -> dict[str, Any]:
            return {
                "D": result.d_size,
                "A": result.a_size,
                "half_intervals": {
                    unknown.name: float(half) if np.isfinite(half) else None
                    for unknown, half in zip(result.unknowns, result.halves, strict=True)
                },
                "undetermined": [list(names) for names in result.undetermined],
            }

        return {
            "criterion": self.criterion,
            "choice": dict(self.choice),
            "before": {**promised(self.before), "problems": list(self.problems)},
            "after": promised(self.after),
            "runs": self.runs,
            "refused": dict(self.refused),
            "interrupted": self.interrupted is not None,
        }


def _around(half: float) -> str:
    return f"+- {half:.2g}" if np.isfinite(half) else "not determined"
