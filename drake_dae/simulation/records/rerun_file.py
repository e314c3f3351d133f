"""Records as files of the viewer rerun, by the optional package rerun-sdk."""

from pathlib import Path
from typing import Any

import numpy as np

from drake_dae.arguments import checked
from drake_dae.errors import ModelError
from drake_dae.simulation.records.optional import optional_module
from drake_dae.simulation.records.phases import phase_spans
from drake_dae.simulation.records.record import Record


@checked(ModelError)
def save_rerun(record: Record, path: str | Path) -> None:
    """Writes the signals of a record over its time into a file that `rerun FILE` shows.

    Each entry of a signal is a series "<signal>/<entry> [<unit>]" of scalars over the timeline
    "time", in s. Events of contacts and starts of phases are lines of a log, at "events" and
    "phases". A time below zero is a duration before the start of the timeline.

    Args:
        record: The record.
        path: The file, an .rrd.

    Raises:
        ModelError: rerun-sdk is not installed, or the file is no .rrd.
        OSError: The file cannot be written.
    """
    if Path(path).suffix != ".rrd":
        raise ModelError(f"a recording of rerun is an .rrd, got '{Path(path).name}'")
    rr = optional_module("rerun", "a recording", "rerun")
    stream: Any = rr.RecordingStream("drake_dae", make_default=False, make_thread_default=False)
    with open(path, "wb"):
        pass  # rerun reports a file that cannot be written in a thread of its own.
    stream.save(str(path))
    times = rr.TimeColumn("time", duration=np.asarray(record.time))
    for name, recorded in record.signals.items():
        for column, signal in enumerate(recorded.signals):
            entry = f"{signal.name} [{signal.unit}]" if signal.unit else signal.name
            values = np.ascontiguousarray(recorded.values[:, column])
            where = rr.new_entity_path([name, entry])
            columns = rr.Scalars.columns(scalars=values)
            stream.send_columns(where, [times], columns, strict=True)
    lines = [("events", event.time, str(event)) for event in record.events]
    lines += [("phases", span.begin, span.name) for span in phase_spans(record)]
    for where, time, text in lines:
        stream.set_time("time", duration=time)
        stream.log(where, rr.TextLog(text), strict=True)
    stream.disconnect()
