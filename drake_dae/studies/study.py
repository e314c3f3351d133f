"""The results of a sweep: its runs' outcomes and figures, as a table, a plot, and in words."""

import csv
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from drake_dae.analysis import LimitKind, Part, SignalRange, Table, count_of, to_text
from drake_dae.arrays import FloatArray, unknown_name
from drake_dae.dae import Signal
from drake_dae.diagrams.record import Record
from drake_dae.errors import ModelError
from drake_dae.running.judgement import late_rms
from drake_dae.studies.variations import Variation

FILES = ("runs.csv", "runs.png")  # The files that `Study.save` writes.
MOST_REASONS = 5  # The most unfinished runs that are listed with their reasons.
MOST_AXES = 24  # The most figures in the plot.


class Outcome(StrEnum):
    """How a run of a sweep ended."""

    FINISHED = "finished"
    FAILED = "failed"  # Before its end; the figures are those up to the failure.
    REFUSED = "refused"  # It contradicts itself, violates an assumption, or has no start.
    CRASHED = "crashed"  # The process ended, or raised an unexpected error.
    TIMED_OUT = "timed out"

    @property
    def is_final(self) -> bool:
        """Whether another attempt would have the same outcome."""
        return self not in (Outcome.CRASHED, Outcome.TIMED_OUT)


@dataclass(frozen=True)
class RunResult:
    """How a run of a sweep ended and why, and its figures."""

    outcome: Outcome
    reason: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)


def figures_of(record: Record, ranges: Sequence[SignalRange]) -> dict[str, float]:
    """The figures of a run: name with unit, such as "largest error of tool.z [m]" -> number.

    For each output: the largest |z - r|, the last z - r, and the "late" error, the root mean square
    of z - r over the second half of the time. For each constraint force: its least and largest
    value. For each control: the largest |u|. Then the "margin" of each limited signal, its least
    distance from its limits, which is negative beyond them; the largest constraint residual before
    a projection, and the time at which the record ends. An empty record has none.
    """
    figures = dict[str, float]()

    def add(what: str, signal: Signal, value: float) -> None:
        figures[f"{what} {signal.name}" + (f" [{signal.unit}]" if signal.unit else "")] = value

    if not record.time.size:
        return figures
    errors = record.signals["tracking_error"]
    late = late_rms(record.time, errors.values) if errors.signals else ()
    for signal, column, rms in zip(errors.signals, errors.values.T, late, strict=True):
        add("largest error of", signal, float(np.max(np.abs(column))))
        add("final error of", signal, float(column[-1]))
        add("late error of", signal, float(rms))
    forces, controls = (record.signals[name] for name in ("constraint_force", "control"))
    for signal, column in zip(forces.signals, forces.values.T, strict=True):
        add("least", signal, float(np.min(column)))
        add("largest", signal, float(np.max(column)))
    for signal, column in zip(controls.signals, controls.values.T, strict=True):
        add("largest", signal, float(np.max(np.abs(column))))
    for r in ranges:
        # The margin of a force that may not pull is its least value.
        if isfinite(r.room) and r.kind is not LimitKind.FORCE:
            add("margin of", r.signal, r.room)
    figures["largest residual"] = float(np.abs(record["constraint_residual"]).max(initial=0.0))
    figures["end [s]"] = float(record.time[-1])
    return figures


@dataclass(frozen=True, eq=False)
class Study:
    """The results of a sweep: for each run, dotted key of the scenario -> value, and its result."""

    variations: tuple[Variation, ...]
    results: tuple[RunResult, ...]

    def __repr__(self) -> str:
        return f"Study({self._outcomes()})"

    def __str__(self) -> str:
        parts: list[Part] = [[self._outcomes()]]
        others = list[str]()
        for run, (changes, result) in enumerate(zip(self.variations, self.results, strict=True)):
            if result.outcome is not Outcome.FINISHED:
                name = ", ".join(f"{key}={_cell(value)}" for key, value in changes.items())
                others.append(f"run {run}, {name}: {result.outcome}: {result.reason}")
        more = [f"and {len(others) - MOST_REASONS} more"] * (len(others) > MOST_REASONS)
        parts += [[*others[:MOST_REASONS], *more]] if others else []
        rows = []
        for name, extent in self.extent().items():
            low, median, high = (f"{number:.4g}" for number in extent.values())
            values = self.values(name)
            at_low, at_high = str(np.nanargmin(values)), str(np.nanargmax(values))
            rows.append([name, low, at_low, median, high, at_high])
        head = ["figure", "least", "at run", "median", "largest", "at run"]
        return to_text([*parts, Table(head, rows)] if rows else parts)

    def _outcomes(self) -> str:
        counts = Counter(result.outcome for result in self.results)
        texts = [f"{counts[outcome]} {outcome}" for outcome in Outcome if counts[outcome]]
        return f"{count_of(len(self.results), 'run')}: {', '.join(texts)}"

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys that vary."""
        return tuple(dict.fromkeys(key for changes in self.variations for key in changes))

    @property
    def figures(self) -> tuple[str, ...]:
        """Names of all figures, with units."""
        return tuple(dict.fromkeys(name for result in self.results for name in result.figures))

    def values(self, figure: str) -> FloatArray:
        """A figure of every run, shape (number of runs,); nan for runs without this figure."""
        if figure not in self.figures:
            raise ModelError(unknown_name("figure", figure, self.figures))
        return np.array([result.figures.get(figure, np.nan) for result in self.results])

    def table(self) -> dict[str, list[Any]]:
        """The study as a table: name of a column -> one entry for each run, None if it has none.

        It does not depend on the machine or on interruptions.
        """
        return {
            "run": list(range(len(self.results))),
            **{key: [changes.get(key) for changes in self.variations] for key in self.keys},
            "outcome": [str(result.outcome) for result in self.results],
            "reason": [result.reason for result in self.results],
            **{name: [r.figures.get(name) for r in self.results] for name in self.figures},
        }

    def extent(self) -> dict[str, dict[str, float]]:
        """Name of a figure -> its least, median and largest value over the runs that have it."""
        found = dict[str, dict[str, float]]()
        for name in self.figures:
            values = self.values(name)
            three = np.nanmin(values), np.nanmedian(values), np.nanmax(values)
            found[name] = dict(zip(("least", "median", "largest"), map(float, three), strict=True))
        return found

    def plot(self) -> Figure:
        """Each figure that varies over the first key with numbers that vary, or over the runs.

        A red cross is a run that did not finish.
        """
        name, x = "run", np.arange(len(self.results), dtype=float)
        for key in reversed(self.keys):
            column = [_number(changes.get(key)) for changes in self.variations]
            if _varies(np.array(column)):
                name, x = key, np.array(column)
        drawn = [each for each in self.figures if _varies(self.values(each))][:MOST_AXES]
        unfinished = np.array([r.outcome is not Outcome.FINISHED for r in self.results])
        rows = -(-max(len(drawn), 1) // 3)
        figure = Figure(figsize=(12.0, 3.0 * rows), layout="constrained")
        for index, each in enumerate(drawn):
            axis, y = figure.add_subplot(rows, 3, index + 1), self.values(each)
            axis.plot(x, y, ".", color="C0")
            axis.plot(x[unfinished], y[unfinished], "x", color="C3")
            # Matplotlib would read mathematics in $.
            axis.set_title(each.replace("$", r"\$"), fontsize=9)
            axis.set_xlabel(name.replace("$", r"\$"), fontsize=8)
            axis.tick_params(labelsize=8)
        return figure

    def save(self, folder: str | Path) -> list[Path]:
        """Writes the table as `runs.csv` and the plot as `runs.png`; returns their paths."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        table, plot = (folder / name for name in FILES)
        columns = self.table()
        with open(table, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            writer.writerows(map(_cell, row) for row in zip(*columns.values(), strict=True))
        self.plot().savefig(plot, dpi=100)
        return [table, plot]


def _cell(entry: Any) -> Any:
    """Lists and mappings as JSON, and other values unchanged."""
    return json.dumps(entry) if isinstance(entry, (dict, list)) else entry


def _number(entry: Any) -> float:
    """A number, or that of a list of one; nan for other entries."""
    entry = entry[0] if isinstance(entry, list) and len(entry) == 1 else entry
    return float(entry) if isinstance(entry, (int, float)) else np.nan


def _varies(values: FloatArray) -> bool:
    """Whether the numbers of a column differ by more than round-off."""
    finite = values[np.isfinite(values)]
    return finite.size > 1 and bool(np.ptp(finite) > 1e-9 * np.max(np.abs(finite)))
