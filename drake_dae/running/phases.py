"""The phases of a task in a record."""

from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.record import Record


@dataclass(frozen=True)
class PhaseSpan:
    """A phase in a record.

    Attributes:
        name: Its name, "Press" for example.
        begin, end: Its start and end, in s.
    """

    name: str
    begin: float
    end: float


def phase_spans(record: Record) -> list[PhaseSpan]:
    """The phases of a record in order; none without a task."""
    if "phase" not in record.signals or not record.time.size:
        return []
    names = [
        signal.name.partition(" ")[2] or signal.name for signal in record.signals["phase"].signals
    ]
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
