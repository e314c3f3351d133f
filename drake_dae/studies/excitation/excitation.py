"""The result of an excitation, as values and as text."""

import signal
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drake_dae.analysis.tables import count_of
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
    """A motion and a force that determine parameters of a plant, and what they promise.

    Attributes:
        scenario: The scenario with the values that were found, with all that was left out.
        choice: Dotted key -> value; empty if the scenario as it was is best.
        before: What the record of the scenario as it was says.
        after: What that of the found one says.
        criterion: "D" or "A".
        runs: How many runs were made.
        refused: What was wrong with a run -> with how many.
        problems: What is wrong with the scenario as it was, in words.
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
        """By what factor the criterion is smaller."""
        return self.before.size(self.criterion) / self.after.size(self.criterion)

    def text(self) -> str:
        """The result as lines of text."""
        rows: list[tuple[str, ...]] = [("parameter", "value", "95 % before", "95 % after", "unit")]
        for i, unknown in enumerate(self.after.unknowns):
            around = [_around(each.halves[i]) for each in (self.before, self.after)]
            rows.append((unknown.name, f"{self.after.values[i]:.6g}", *around, unknown.unit))
        lines = [*_table(rows), ""]
        if self.choice:
            width = max(map(len, self.choice))
            lines += [f"{key.ljust(width)}  {value:.6g}" for key, value in self.choice.items()]
            lines.append("")
        else:
            lines.append("No choice is better than the scenario as it is.")
        return "\n".join([*lines, *self.remarks()])

    def remarks(self) -> list[str]:
        """What is to be known about the choice."""
        found = [
            f"{meaning}: {self.before.size(kind):.3g} before, {self.after.size(kind):.3g} after"
            + (" (this one is made small)." if kind == self.criterion else ".")
            for kind, meaning in _MEANING.items()
        ]
        made = f"{count_of(self.runs, 'run')} made"
        counts = [f"{kind} ({count})" for kind, count in self.refused.items()]
        found.append(f"{made}; refused: {', '.join(counts)}." if counts else f"{made}.")
        found += [f"The scenario as it was is refused: {text}." for text in self.problems]
        found += [
            f"Not determined: {', '.join(names)}. Other keys must vary, or fewer be free."
            for names in self.after.undetermined
        ]
        if self.interrupted is not None:
            found.append("The search was interrupted; this is the best so far.")
        return found

    def to_dict(self) -> dict[str, Any]:
        """The result as plain values."""

        def promised(one: Promised) -> dict[str, Any]:
            return {
                "D": one.d_size,
                "A": one.a_size,
                "half_intervals": {
                    unknown.name: float(half) if np.isfinite(half) else None
                    for unknown, half in zip(one.unknowns, one.halves, strict=True)
                },
                "undetermined": [list(names) for names in one.undetermined],
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


def _table(rows: list[tuple[str, ...]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
