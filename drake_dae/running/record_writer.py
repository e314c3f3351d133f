"""The record of a run on disk during the run."""

import json
import os
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import brief
from drake_dae.diagrams.record import Record, versions
from drake_dae.errors import ModelError
from drake_dae.trace.expressions import result_of

PERIOD = 1.0
"""The time between two appends, in s."""

_SHARE = 0.02
"""The largest fraction of the run for appending: on a slow disk rows are appended less often."""


@checked(ModelError)
class RecordWriter:
    """Appends the record of a run to a file, about once a second, while the run goes on:

        with RecordWriter("run.part", loop.record) as writer:
            simulate(loop.diagram, context, 10.0, config, look=writer.update)

    `record` is a function of a context and a time in s (or None) that returns the record after this
    time; `about` is that of `Record`. `Record.load` reads the file up to the last append, however
    the process ends: a line of JSON with names and units, and rows of little-endian float64, the
    time in s and the signals. It never replaces another file. If an append fails, as on a full
    disk, a warning is printed once, and the next one is tried later; the run continues.
    """

    def __init__(
        self,
        path: str | Path,
        record: Callable[[Context, float | None], Record],
        about: Mapping[str, Any] | None = None,
    ) -> None:
        self.path, self.about, self._record = Path(path), dict(about or {}), record
        self._file: int | None = None
        self._time: float | None = None
        self._end, self._next, self._warned = 0, time.perf_counter() + PERIOD, False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def update(self, context: Context) -> None:
        """Appends the new part of the record, if an update is due, without its last row.

        At the end of a run the row after the projection replaces it.
        """
        if time.perf_counter() < self._next:
            return
        record = self._made(context)
        # The time to make a record depends on its length, and not on the disk.
        began = time.perf_counter()
        try:
            self._append(record, keep_last=True)
        except OSError as error:
            if not self._warned:
                reason = error.strerror or error
                warnings.warn(
                    f"{self.path}: {reason}; the run goes on, its record is in memory only",
                    stacklevel=2,
                )
                self._warned = True
        done = time.perf_counter()
        self._next = done + max(PERIOD, (done - began) / _SHARE)

    def finish(self, context: Context) -> None:
        """Appends the rest of the record; an OSError if it does not fit."""
        self._append(self._made(context), keep_last=False)

    def _made(self, context: Context) -> Record:
        """The new part of the record."""
        record = result_of("record", self._record, context, self._time)
        if not isinstance(record, Record):
            raise ModelError(f"record must return a Record, got {brief(record)}")
        return record

    def _append(self, record: Record, keep_last: bool) -> None:
        stop = record.time.size - keep_last
        if stop < 1:
            return
        columns = [record.time, *(recorded.values for recorded in record.signals.values())]
        data = np.column_stack(columns)[:stop].astype("<f8").tobytes()
        if self._file is None:
            self._file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        if self._end == 0:
            signals = {n: [[s.name, s.unit] for s in r.signals] for n, r in record.signals.items()}
            rows = "little-endian float64: time in s, then the signals in this order"
            about = {"versions": versions(), **self.about}
            head = {"about": about, "rows": rows, "signals": signals}
            data = json.dumps(head).encode() + b"\n" + data
        # At a fixed place: the remains of a failed append are overwritten.
        done = 0
        while done < len(data):
            done += os.pwrite(self._file, data[done:], self._end + done)
        os.fsync(self._file)
        self._end += done
        self._time = float(record.time[stop - 1])
