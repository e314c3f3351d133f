"""The record on disk while a run goes on."""

import errno
import os

import numpy as np
import pytest
from runs import same_records, scenario

from drake_dae import Record, build_scenario, simulate
from drake_dae.errors import ModelError
from drake_dae.running import RecordWriter, record_writer


@pytest.fixture
def always(monkeypatch):
    """An append after each step, whatever it takes."""
    monkeypatch.setattr(record_writer, "PERIOD", 0.0)
    monkeypatch.setattr(record_writer, "_SHARE", np.inf)


@pytest.fixture(scope="module")
def chosen():
    return scenario("two_link_wall", "duration=0.5")


def run(chosen, path, then=lambda writer, loop, context: None):
    """Runs it, and does something after each step."""
    loop, context = build_scenario(chosen)
    with RecordWriter(path, loop.record) as writer:

        def look(current):
            writer.update(current)
            then(writer, loop, current)

        simulate(loop.diagram, context, chosen.duration, chosen.integrator, look=look)
        writer.finish(context)
    return loop.record(context)


def rows(record, stop):
    signals = {n: type(r)(r.values[:stop], r.signals) for n, r in record.signals.items()}
    return Record(record.time[:stop], signals)


def test_it_can_be_read_after_every_step(always, chosen, tmp_path):
    """All but the last row, which the end of a run replaces."""
    path, seen = tmp_path / "run.part", []

    def read(writer, loop, context):
        now = loop.record(context)
        if now.time.size > 1:
            same_records(Record.load(path), rows(now, -1))
            seen.append(now.time.size)

    record = run(chosen, path, read)
    same_records(Record.load(path), record)
    count = record.time.size
    assert seen == [*range(2, count + 1), count]


def test_wherever_the_file_ends(chosen, tmp_path):
    path = tmp_path / "run.part"
    record = run(chosen, path)
    data = path.read_bytes()
    start = data.index(b"\n") + 1
    width = (len(data) - start) // record.time.size
    for end in np.random.default_rng(0).integers(start, len(data), 20):
        path.write_bytes(data[:end])
        same_records(Record.load(path), rows(record, (end - start) // width))
        # Blocks that were given out but never synced before the machine lost its power.
        path.write_bytes(data[:end] + bytes(3 * width))
        kept = Record.load(path)
        np.testing.assert_array_equal(kept.time[:-1], record.time[: kept.time.size - 1])
        assert np.all(np.diff(kept.time) > 0.0)
    for end in (0, 1, start - 2):
        path.write_bytes(data[:end])
        with pytest.raises(ModelError, match=r"run.part"):
            Record.load(path)


@pytest.mark.parametrize("link", [False, True])
def test_another_file_is_never_written_to(always, link, chosen, tmp_path):
    path = tmp_path / "run.part"
    if link:
        path.symlink_to(tmp_path / "gone")
    else:
        path.write_text("mine")
    with (
        pytest.warns(UserWarning, match=r"run\.part"),
        pytest.raises(FileExistsError, match=r"run\.part"),
    ):
        run(chosen, path)
    assert not (tmp_path / "gone").exists()
    assert link or path.read_text() == "mine"


def test_a_disk_that_is_full_for_a_while(always, chosen, tmp_path, monkeypatch):
    """Half of a row goes through, then nothing for some steps: the run and the file go on."""
    path, calls, write = tmp_path / "run.part", [], os.pwrite

    def full_for_a_while(file, data, at):
        calls.append(at)
        if len(calls) == 5:
            return write(file, data[: len(data) // 2], at)
        if 5 < len(calls) < 9:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(file, data, at)

    monkeypatch.setattr(os, "pwrite", full_for_a_while)
    with pytest.warns(UserWarning, match=r"run\.part") as warned:
        record = run(chosen, path)
    assert len(warned) == 1
    assert len(calls) > 9
    same_records(Record.load(path), record)
