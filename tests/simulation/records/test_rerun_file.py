"""Records as files of rerun, read back by its own reader."""

import sys

import numpy as np
import pytest

from drake_dae import Record, save_rerun
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.simulation.records.record import Recorded
from drake_dae.systems.plants.contact_events import ContactChange, ContactEvent


def record():
    times = np.linspace(0.0, 1.0, 11)
    values = np.column_stack([np.sin(times), 2.0 * times])
    names = (Signal("joint 1/a", "rad"), Signal("force"))
    phase = Recorded(np.ones((11, 1)), (Signal("0 Press"),))
    event = ContactEvent(0.25, ContactChange.CLOSING, ("tip",), ("tip",))
    signals = {"state": Recorded(values, names), "phase": phase}
    return Record(times, signals, events=(event,))


def test_every_signal_is_read_back_with_its_times(tmp_path):
    chunks = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk")
    save_rerun(record(), tmp_path / "run.rrd")
    found, logged = {}, {}
    for chunk in chunks.RrdReader(str(tmp_path / "run.rrd")).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.endswith("Scalars:scalars"):
                values = [value for cell in batch.column(name).to_pylist() for value in cell]
                times = [time.total_seconds() for time in batch.column("time").to_pylist()]
                found.setdefault(chunk.entity_path, []).extend(zip(times, values, strict=True))
            if name.endswith("TextLog:text"):
                logged.setdefault(chunk.entity_path, []).extend(batch.column(name).to_pylist())
    (joint,) = [path for path in found if "joint" in path]
    (force,) = [path for path in found if "force" in path]
    for path, column in ((joint, 0), (force, 1)):
        rows = np.array(sorted(found[path]))
        # The timeline counts nanoseconds.
        np.testing.assert_allclose(rows[:, 0], record().time, atol=1e-9)
        np.testing.assert_array_equal(rows[:, 1], record()["state"][:, column])
    assert "tip closes" in logged["/events"][0][0]
    assert logged["/phases"] == [["Press"]]


def test_what_cannot_be_written_is_refused(tmp_path, monkeypatch):
    with pytest.raises(ModelError, match=r"is an \.rrd, got 'run\.csv'"):
        save_rerun(record(), tmp_path / "run.csv")
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ModelError, match=r"pip install 'drake_dae\[rerun\]'"):
        save_rerun(record(), tmp_path / "run.rrd")
    assert not list(tmp_path.iterdir())
