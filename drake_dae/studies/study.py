"""The results of a study, as a table and in words."""

import csv
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drake_dae.analysis.tables import Part, Table, count_of, to_text
from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.errors import ModelError
from drake_dae.pictures.inline import InlinePage
from drake_dae.scenario.files import save_scenario
from drake_dae.scenario.scenario import Scenario
from drake_dae.studies.results import Outcome, RunResult
from drake_dae.studies.run_names import rerun_commands, run_name
from drake_dae.studies.variations import Variation

FILES = ("runs.csv", "summary.txt", "study.html", "histograms.png", "map.png")
"""The names of the files that `Study.save` writes."""

MOST_REASONS = 5
"""The largest number of unfinished runs that are listed with their reasons."""


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class Study:
    """A study: its variations and their results.

    Attributes:
        variations: For each run, dotted key of the scenario -> value.
        results: The result of each run.
        scenario: The scenario of the study, from which `save` derives the commands that repeat a
            run; None if unknown.
        rollout: Whether the runs were rollouts.
    """

    variations: tuple[Variation, ...]
    results: tuple[RunResult, ...]
    scenario: Scenario | None = field(default=None, repr=False)
    rollout: bool = False

    def __post_init__(self) -> None:
        if len(self.variations) != len(self.results):
            raise ModelError(
                f"a study has a result for each variation, got {len(self.results)} for "
                f"{len(self.variations)}"
            )

    def __repr__(self) -> str:
        return f"Study({self._outcomes()})"

    def __str__(self) -> str:
        return to_text(self._parts())

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys that vary."""
        return tuple(dict.fromkeys(key for changes in self.variations for key in changes))

    @property
    def figures(self) -> tuple[str, ...]:
        """Names of all figures, with units."""
        return tuple(dict.fromkeys(name for result in self.results for name in result.figures))

    @checked(ModelError)
    def values(self, figure: str) -> FloatArray:
        """A figure of every run, shape (number of runs,); nan for runs without this figure.

        Raises:
            ModelError: There is no such figure.
        """
        if figure not in self.figures:
            raise ModelError(unknown_name("figure", figure, self.figures))
        return np.array([result.figures.get(figure, np.nan) for result in self.results])

    def table(self) -> dict[str, list[Any]]:
        """The study as a table: name of a column -> one entry for each run, None if it has none.

        The columns are the number of the run, the keys that vary, the outcome with its reason, the
        signals that exceed their limits, and the figures. The table does not depend on the machine
        or on interruptions.
        """
        return {
            "run": [result.run for result in self.results],
            **{key: [changes.get(key) for changes in self.variations] for key in self.keys},
            "outcome": [str(result.outcome) for result in self.results],
            "reason": [result.reason for result in self.results],
            "beyond limits": [" ".join(result.exceeded) for result in self.results],
            **{name: [r.figures.get(name) for r in self.results] for name in self.figures},
        }

    def extent(self) -> dict[str, dict[str, float]]:
        """Name of a figure -> its least, median and largest value over the runs that have it."""
        return {
            name: {
                "least": float(np.nanmin(values)),
                "median": float(np.nanmedian(values)),
                "largest": float(np.nanmax(values)),
            }
            for name in self.figures
            for values in [self.values(name)]
        }

    @checked(ModelError)
    def save(
        self,
        folder: str | Path,
        title: str = "",
        again: Sequence[str] = (),
        duration: float | None = None,
    ) -> list[Path]:
        """Writes `runs.csv`, `summary.txt`, `study.html`, and one plot for each available figure.

        `study.html` is a self-contained page with a sortable table, parallel coordinates, and a
        comparison of runs. If a folder "run<number>" exists beside the page, the page shows the
        plots and the animation of this run, and otherwise the command that creates the folder.
        Without `again` a study of a scenario writes it to `scenario.yaml` for these commands.

        Args:
            folder: The folder to write to; created if it does not exist.
            title: The title of the page; the name of the folder if empty.
            again: For each run a command that creates its folder, instead of the default one.
            duration: The duration of the runs, in s; None for that of the scenario, or 1 without a
                scenario.

        Returns:
            The paths of `runs.csv`, `summary.txt`, `study.html` and the plots.
        """
        from drake_dae.studies.study_plots import save_study_plots

        if again and len(again) != len(self.results):
            raise ModelError(f"{len(self.results)} runs need as many commands, got {len(again)}")
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        if self.scenario is not None and not again:
            base = folder / "scenario.yaml"
            save_scenario(self.scenario, base)
            made = ["drake-dae", "simulate", str(base), *(["--rollout"] if self.rollout else [])]
            again = rerun_commands(made, self.variations, folder)
            duration = self.scenario.duration if duration is None else duration
        table, summary, page = (folder / name for name in FILES[:3])
        columns = self.table()
        with open(table, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            writer.writerows(
                [_cell(entry) for entry in row] for row in zip(*columns.values(), strict=True)
            )
        summary.write_text(f"{self}\n", encoding="utf-8")
        title = title or folder.resolve().name
        seconds = 1.0 if duration is None else duration
        page.write_text(self._page(title, again, seconds), encoding="utf-8")
        plots = save_study_plots(columns, self.keys, self.figures, folder)
        return [table, summary, page, *plots]

    def _repr_html_(self) -> str:
        """The page of `save`, for a notebook."""
        return self._page(repr(self), (), 1.0)._repr_html_()

    def _page(self, title: str, again: Sequence[str], duration: float) -> InlinePage:
        from drake_dae.studies.study_page import PageText, study_page

        names = [run_name(changes) for changes in self.variations]
        text = PageText(title, self._outcomes(), names, again, duration)
        return InlinePage(study_page(self.table(), self.keys, self.figures, text))

    def _outcomes(self) -> str:
        """The number of runs, and of each outcome, in words."""
        counts = Counter(result.outcome for result in self.results)
        texts = [f"{counts[outcome]} {outcome}" for outcome in Outcome if counts[outcome]]
        return f"{count_of(len(self.results), 'run')}: {', '.join(texts)}"

    def _parts(self) -> list[Part]:
        parts: list[Part] = [[self._outcomes()]]
        others = [result for result in self.results if result.outcome is not Outcome.FINISHED]
        if others:
            lines = [
                f"run {r.run}, {run_name(self.variations[r.run])}, {r.outcome}: {r.reason}"
                for r in others[:MOST_REASONS]
            ]
            if len(others) > MOST_REASONS:
                lines.append(f"and {len(others) - MOST_REASONS} more, see runs.csv")
            parts.append(lines)
        beyond = Counter(name for result in self.results for name in result.exceeded)
        if beyond:
            counted = (f"{name} in {count_of(n, 'run')}" for name, n in beyond.most_common())
            parts.append([f"beyond their limits: {', '.join(counted)}"])
        if self.figures:
            head = ["figure", "least", "at run", "median", "largest", "at run"]
            parts.append(Table(head, [self._row(name) for name in self.figures]))
        return parts

    def _row(self, figure: str) -> list[str]:
        values = self.values(figure)
        least, largest = int(np.nanargmin(values)), int(np.nanargmax(values))
        return [
            figure,
            f"{values[least]:.4g}",
            f"{least}",
            f"{np.nanmedian(values):.4g}",
            f"{values[largest]:.4g}",
            f"{largest}",
        ]


def _cell(entry: Any) -> Any:
    """Returns lists and mappings as JSON, and other values unchanged."""
    return json.dumps(entry) if isinstance(entry, (dict, list)) else entry
