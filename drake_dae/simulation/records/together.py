"""Runs that were computed together, with one record."""

from dataclasses import dataclass
from typing import Any, Self

from drake_dae.arrays import FloatArray
from drake_dae.errors import SimulationError
from drake_dae.simulation.records.record import Record, computed_record, recorded_values


def indexed_record(record: Record, index: Any, time: FloatArray | None = None) -> Record:
    """A computed record with some of the values of another one, and perhaps with other times.

    So `indexed_record(record, i)` is that of run i of several, and with the index None the record
    of a run becomes that of several runs, of which there is one.
    """
    signals = {
        name: recorded_values(recorded.values[index], recorded.signals)
        for name, recorded in record.signals.items()
    }
    return computed_record(record.time if time is None else time, signals)


@dataclass(frozen=True, eq=False)
class RunsTogether:
    """Runs of one loop that were computed together, with the same times up to the same end.

    Attributes:
        places: The indices of the runs among those that were asked for.
        record: The record of all, see `computed_record`.
        steps: The number of steps of each.
        failure: The reason of their early end; None if they reached their end.
    """

    places: list[int]
    record: Record
    steps: list[int]
    failure: SimulationError | None = None

    def chosen(self, indices: list[int], rows: int | None, failure: SimulationError | None) -> Self:
        """Some of the runs, with the first rows of their record and the reason of its end."""
        record = indexed_record(self.record, (indices, slice(rows)), self.record.time[:rows])
        places, steps = ([each[i] for i in indices] for each in (self.places, self.steps))
        return type(self)(places, record, steps, failure)
