"""The record of a run: every signal over time, with names and units."""

import csv
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from pydrake.systems.framework import Context
from pydrake.systems.primitives import VectorLogSink

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, listed, numbers
from drake_dae.dae import Signal
from drake_dae.errors import ModelError
from drake_dae.files import MOST_RECORDED, check_file, open_file


class Recorded(NamedTuple):
    """A vector signal over time, one row for each, with the name and unit of each column."""

    values: FloatArray
    signals: tuple[Signal, ...]


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class Record:
    """All signals of a run, at the ends of steps, at samples, or at the times of a rollout.

    NumPy reads its file: `numpy.load("record.npz")` has "time" in s, for each signal its values,
    shape (k, size), "<signal>.names" and "<signal>.units", and "about" as JSON: the versions of the
    software and, if the command made the run, the scenario with all seeds.

    Attributes:
        time: The times in s, shape (k,), strictly increasing.
        signals: Name of a signal -> its values.
        about: What repeats the run: the "versions", which `save` adds, and the "scenario" if known.
    """

    time: FloatArray
    signals: Mapping[str, Recorded]
    about: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", numbers("the times of a record", self.time))
        own = {
            name: Recorded(numbers(f"the values of '{name}' in a record", r.values), r.signals)
            for name, r in self.signals.items()
        }
        object.__setattr__(self, "signals", own)
        if self.time.ndim != 1 or np.any(np.diff(self.time) <= 0.0):
            raise ModelError("the times of a record must be strictly increasing numbers")
        for name, recorded in self.signals.items():
            shape, wanted = np.shape(recorded.values), (self.time.size, len(recorded.signals))
            if shape != wanted:
                raise ModelError(
                    f"'{name}' of a record has shape {shape}; with {wanted[0]} times and "
                    f"{wanted[1]} names it must have {wanted}"
                )

    def __getitem__(self, name: str) -> FloatArray:
        """The values of a signal, shape (k, size).

        Raises:
            ModelError: The record has no such signal.
        """
        if name not in self.signals:
            raise ModelError(f"no signal '{name}' in the record; it has {', '.join(self.signals)}")
        return self.signals[name].values

    def __contains__(self, name: object) -> bool:
        """Whether the record has a signal of this name."""
        return name in self.signals

    def __repr__(self) -> str:
        extent = " from {:g} to {:g} s".format(*self.time[[0, -1]]) if self.time.size else ""
        text = listed((f"{name} ({len(r.signals)})" for name, r in self.signals.items()), 20)
        return f"Record({self.time.size} times{extent}, signals={text})"

    @checked(ModelError)
    def after(self, time: float | None) -> Self:
        """The part of the record later than a time in s; the whole record for None."""
        if time is None:
            return self
        first = _first_after(self.time, time)
        cut = {name: Recorded(r.values[first:], r.signals) for name, r in self.signals.items()}
        return type(self)(self.time[first:], cut, self.about)

    @classmethod
    def from_log(
        cls,
        log: VectorLogSink,
        signals: Mapping[str, Sequence[Signal]],
        context: Context,
        after: float | None = None,
    ) -> Self:
        """Collects what a log of signals, stacked in this order, has later than a time in s.

        Raises:
            ModelError: The log has another number of entries than the signals.
        """
        samples, stops = log.FindLog(context), np.cumsum([0, *map(len, signals.values())])
        if (size := samples.get_input_size()) != stops[-1]:
            raise ModelError(f"the signals of a log have {stops[-1]} names, the log {size} entries")
        time = samples.sample_times()
        first = 0 if after is None else _first_after(time, after)
        rows, time = samples.data()[:, first:].T, time[first:]
        # The last step of a failed run may have values that are not numbers.
        good = np.logical_and.accumulate(np.isfinite(rows).all(axis=1))
        rows, time = rows[good], time[good]
        # The last sample of a time is the one after the projection.
        last = np.append(np.diff(time) > 0.0, True)[: time.size]
        columns = np.split(rows[last], stops[1:-1], axis=1)
        pairs = zip(signals.items(), columns, strict=True)
        found = {n: Recorded(v, tuple(each)) for (n, each), v in pairs}
        return cls(time[last], found)

    @checked(ModelError)
    def save(self, path: str | Path) -> None:
        """Writes the record as one `.npz` file."""
        arrays: dict[str, np.ndarray] = {"time": self.time}
        for name, recorded in self.signals.items():
            arrays[name] = recorded.values
            arrays[f"{name}.names"] = np.array([s.name for s in recorded.signals], dtype=str)
            arrays[f"{name}.units"] = np.array([s.unit for s in recorded.signals], dtype=str)
        arrays["about"] = np.array(json.dumps({"versions": versions(), **self.about}))
        np.savez_compressed(path, **arrays)  # type: ignore[arg-type]

    @checked(ModelError)
    def to_csv(self, path: str | Path) -> None:
        """Writes the record as text: a line of names with units, then one line for each time.

        The columns are "time [s]" and "<signal>.<name> [<unit>]"; numbers have all their digits.
        """
        with open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["time [s]", *map(".".join, self._labels())])
            writer.writerows(np.column_stack([self.time, self._stacked()]).tolist())

    def to_dataframe(self) -> Any:
        """The record as a pandas DataFrame, one row for each time, "time [s]".

        Its columns have two levels, the signal and the name with its unit: `frame["control"]` are
        all controls.

        Raises:
            ModelError: pandas is not installed.
        """
        try:
            pandas: Any = import_module("pandas")
        except ImportError:
            raise ModelError("to_dataframe needs pandas: pip install 'drake_dae[data]'") from None
        index = pandas.Index(self.time, name="time [s]")
        columns = pandas.MultiIndex.from_tuples(self._labels(), names=["signal", "name"])
        return pandas.DataFrame(self._stacked(), index=index, columns=columns)

    def _labels(self) -> list[tuple[str, str]]:
        """For each column the signal, and the name with its unit."""
        every = ((name, each) for name, r in self.signals.items() for each in r.signals)
        return [(n, f"{s.name} [{s.unit}]" if s.unit else s.name) for n, s in every]

    def _stacked(self) -> FloatArray:
        return np.hstack([np.zeros((self.time.size, 0)), *map(self.__getitem__, self.signals)])

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads a file of `save`.

        Raises:
            ModelError: The file holds something else.
        """
        check_file(path, ModelError, MOST_RECORDED)
        try:
            with open_file(path) as rows:
                file = np.load(rows, allow_pickle=False)
                signals = {}
                for name in (key for key in file.files if f"{key}.names" in file.files):
                    labels = zip(file[f"{name}.names"], file[f"{name}.units"], strict=True)
                    named = tuple(Signal(str(label), str(unit)) for label, unit in labels)
                    signals[name] = Recorded(file[name], named)
                about = json.loads(str(file["about"])) if "about" in file.files else {}
                return cls(file["time"], signals, about)
        except Exception as error:  # zip files, NumPy's headers and JSON raise many kinds.
            text = getattr(error, "strerror", None) or f"{error}; it may be cut off or damaged"
            raise ModelError(f"{path} is not a record of a run: {text}") from None


def computed_record(time: FloatArray, signals: Mapping[str, Recorded]) -> Record:
    """A record that the library itself has computed, made without checks and copies."""
    record = object.__new__(Record)
    vars(record).update(time=time, signals=signals, about={})
    return record


RecordAfter = Callable[[float | None], Record]
"""From a time in s, or None, to what a run has recorded later."""


def versions() -> dict[str, str]:
    """The versions of the library, its dependencies and Python, and the machine."""
    versions_of = {"python": platform.python_version(), "machine": platform.platform()}
    for name in ("drake_dae", "drake", "casadi", "numpy"):
        with suppress(PackageNotFoundError):  # Drake may be built from its source.
            versions_of[name] = version(name)
    return versions_of


def _first_after(times: FloatArray, time: float) -> int:
    return int(np.searchsorted(times, time, side="right"))


class PhaseSpan(NamedTuple):
    """A phase of a task in a record: its name, "Press" for example, its begin and end in s."""

    name: str
    begin: float
    end: float


def phase_spans(record: Record) -> list[PhaseSpan]:
    """The phases of a record in order; none without a task."""
    if "phase" not in record.signals or not record.time.size:
        return []
    signals = record.signals["phase"].signals
    names = [signal.name.partition(" ")[2] or signal.name for signal in signals]
    places = np.argmax(record["phase"], axis=1)
    # A sample at the time of a change has the values before it.
    last = np.flatnonzero(np.append(np.diff(places) != 0, True))
    begins = [record.time[0], *record.time[last[:-1]]]
    return [
        PhaseSpan(names[places[row]], float(begin), float(record.time[row]))
        for row, begin in zip(last, begins, strict=True)
    ]


def phases_at(record: Record, times: FloatArray) -> list[str]:
    """The name of the phase at each time in s; "" without a task."""
    spans = phase_spans(record)
    ends = [span.end for span in spans[:-1]]
    return [spans[i].name if spans else "" for i in np.searchsorted(ends, times)]
