"""The file of a sweep: what any interruption leaves of it is read, and of another sweep nothing."""

import resource

import pytest

from drake_dae.errors import ModelError
from drake_dae.studies.study import Outcome, RunResult
from drake_dae.studies.sweep import open_journal

HEAD = {"version": "1.0", "duration": "1.0", "variations": "[1, 2, 3]"}
RESULTS = {
    2: RunResult(Outcome.FINISHED, "", {"end [s]": 0.1 + 0.2}),
    0: RunResult(Outcome.FAILED, 'über "alles"\n', {"end [s]": 1e-300}),
    1: RunResult(Outcome.REFUSED, "out of reach"),
}


def test_it_reads_what_it_wrote(tmp_path):
    path = tmp_path / "deep" / "runs.db"
    with open_journal(path, HEAD) as journal:
        assert journal.results() == {}
        journal.add(RESULTS)
    with open_journal(path, HEAD) as journal:
        assert journal.results() == RESULTS
        journal.add({1: RunResult(Outcome.FINISHED)})
        assert journal.results() == {**RESULTS, 1: RunResult(Outcome.FINISHED)}
    assert [found.name for found in path.parent.iterdir()] == ["runs.db"]


@pytest.mark.parametrize(
    ("changes", "words"), [({"version": "2.0"}, r"version.*1.0.*2.0"), ({"gains": "1"}, "gains")]
)
def test_another_sweep_is_refused_with_what_differs(changes, words, tmp_path):
    path = tmp_path / "runs.db"
    with open_journal(path, HEAD) as journal:
        journal.add(RESULTS)
    with pytest.raises(ModelError, match=words), open_journal(path, {**HEAD, **changes}):
        pass
    with open_journal(path, HEAD) as journal:
        assert journal.results() == RESULTS


def test_other_files_are_left_alone(tmp_path):
    path = tmp_path / "runs.db"
    path.write_bytes(b"text\n" * 1000)
    with pytest.raises(ModelError, match=r"runs\.db"), open_journal(path, HEAD):
        pass
    assert path.read_bytes() == b"text\n" * 1000
    for other in (path / "runs.db", tmp_path / "a\0b", tmp_path):
        with pytest.raises(ModelError), open_journal(other, HEAD):
            pass


def test_a_full_disk_is_reported_and_the_sweep_continues(tmp_path):
    path = tmp_path / "runs.db"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with open_journal(path, HEAD) as journal:
        journal.add({2: RESULTS[2]})
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size, limits[1]))
    try:
        with pytest.raises(ModelError, match=r"runs\.db"), open_journal(path, HEAD) as journal:
            journal.add({0: RunResult(Outcome.FAILED, "x" * 100_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    with open_journal(path, HEAD) as journal:
        assert journal.results() == {2: RESULTS[2]}
        journal.add(RESULTS)
        assert journal.results() == RESULTS
