"""The file of a study: what any interruption leaves of it is read, and of another study nothing."""

import json
import resource

import pytest

from drake_dae.errors import ModelError
from drake_dae.studies.journal import open_journal, study_head
from drake_dae.studies.results import Outcome, RunResult

RESULTS = [
    RunResult(2, Outcome.FINISHED, "", {"end [s]": 0.1 + 0.2}, ("wall.force",), 1.5),
    RunResult(0, Outcome.FAILED, 'über "alles"\n', {"end [s]": 1e-300}, (), 0.1),
    RunResult(1, Outcome.NO_START, "out of reach"),
]


def head(**changes):
    scenario = {"duration": 1.0, "start": {"errors": {"tool.z": 0.1}}, "outputs": [{"axes": "z"}]}
    values = {"version": "1.0", "scenario": scenario, "variations": [{"a": 1}, {"a": 2}, {"a": 3}]}
    return study_head(**{**values, **changes})


def written(path):
    with open_journal(path, head()) as journal:
        assert journal.results == {}
        journal.append(RESULTS[:1])
        journal.append(RESULTS[1:])
    return path.read_bytes()


def test_it_reads_what_it_wrote(tmp_path):
    path = tmp_path / "deep" / "runs.jsonl"
    data = written(path)
    assert [json.loads(line)["run"] for line in data.splitlines()[1:]] == [2, 0, 1]
    with open_journal(path, head()) as journal:
        assert journal.results == {result.run: result for result in RESULTS}
    assert path.read_bytes() == data
    assert [found.name for found in path.parent.iterdir()] == ["runs.jsonl"]


@pytest.mark.slow
def test_cut_off_at_any_byte_it_has_the_whole_lines_and_goes_on(tmp_path):
    path = tmp_path / "runs.jsonl"
    data = written(path)
    first = data.index(b"\n") + 1
    for size in range(first, len(data) + 1):
        path.write_bytes(data[:size])
        whole = data[:size].count(b"\n") - 1
        with open_journal(path, head()) as journal:
            assert list(journal.results.values()) == RESULTS[:whole]
            journal.append(RESULTS[whole:])
        assert path.read_bytes() == data


def test_a_run_that_stands_twice_counts_as_it_did_first(tmp_path):
    """What a study has told once does not change."""
    path = tmp_path / "runs.jsonl"
    written(path)
    other = RunResult(2, Outcome.FAILED, "another machine", {}, (), 0.1)
    with open(path, "a", encoding="utf-8") as file:
        file.write(json.dumps(other.to_dict()) + "\n")
    with open_journal(path, head()) as journal:
        assert journal.results == {result.run: result for result in RESULTS}


def test_zeros_after_a_loss_of_power_are_removed(tmp_path):
    path = tmp_path / "runs.jsonl"
    data = written(path)
    for tail in (b"\0" * 300, b"\0" * 300 + b"\n"):
        path.write_bytes(data + tail)
        with open_journal(path, head()) as journal:
            assert len(journal.results) == 3
        assert path.read_bytes() == data


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"version": "2.0"}, r"drake_dae = '1\.0' there, '2\.0' here"),
        ({"variations": [{"a": 1}, {"a": 2}]}, "3 runs there, 2 here"),
        ({"variations": [{"a": 1}, {"a": 5}, {"a": 3}]}, "run 1 has a = 2 there, 5 here"),
        ({"variations": [{"b": 1}, {"a": 2}, {"a": 3}]}, "run 0 has a only there"),
        (
            {"scenario": {**head()["scenario"], "duration": 2.0}},
            r"duration = 1\.0 there, 2\.0 here",
        ),
        (
            {"scenario": {**head()["scenario"], "start": {"errors": {"tool.z": 0.2}}}},
            r"start\.errors\.tool\.z = 0\.1 there, 0\.2 here",
        ),
        (
            {"scenario": {**head()["scenario"], "outputs": [{"axes": "x"}]}},
            r"outputs\.0\.axes = 'z' there, 'x' here",
        ),
        ({"scenario": {**head()["scenario"], "gains": 1}}, "gains only here"),
    ],
)
def test_another_study_is_refused_with_what_differs(changes, words, tmp_path):
    path = tmp_path / "runs.jsonl"
    data = written(path)
    with (
        pytest.raises(ModelError, match=f"belongs to another study: .*{words}"),
        open_journal(path, head(**changes)),
    ):
        pass
    assert path.read_bytes() == data


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "no file of a study"),
        (b"text\n", "no file of a study"),
        (b"[1]\n", "no file of a study"),
        (b'{"a": 1}\n', "no file of a study"),
        (b"\x89PNG\r\n", "no file of a study"),
        (b'{"study": 99}\n', "has format 99"),
    ],
)
def test_other_files_are_left_alone(data, words, tmp_path):
    path = tmp_path / "runs.jsonl"
    path.write_bytes(data)
    with pytest.raises(ModelError, match=words), open_journal(path, head()):
        pass
    assert path.read_bytes() == data


def test_a_line_that_was_changed_is_reported(tmp_path):
    path = tmp_path / "runs.jsonl"
    data = written(path).replace(b'"outcome":"failed"', b'"outcome":"fine"')
    path.write_bytes(data)
    with pytest.raises(ModelError, match="was changed: line 3"), open_journal(path, head()):
        pass
    assert path.read_bytes() == data


@pytest.mark.parametrize(
    "change",
    [
        {"run": -1},
        {"run": 3},
        {"run": 99},
        {"run": "0"},
        {"run": True},
        {"run": 1.0},
        {"figures": {"end [s]": "1"}},
        {"figures": {"end [s]": True}},
        {"figures": []},
        {"seconds": -1.0},
        {"seconds": None},
        {"reason": 1},
        {"exceeded": [1]},
        {"more": 1},
    ],
)
@pytest.mark.parametrize("place", [1, 3])
def test_a_line_that_is_no_run_of_this_study_is_reported_and_stays(change, place, tmp_path):
    """In the middle and at the end, where only what is no whole line is taken for cut off."""
    path = tmp_path / "runs.jsonl"
    lines = written(path).splitlines()
    lines[place] = json.dumps(json.loads(lines[place]) | change).encode()
    data = b"\n".join([*lines, b""])
    path.write_bytes(data)
    refused = pytest.raises(ModelError, match=f"was changed: line {place + 1} is no run of this")
    with refused, open_journal(path, head()):
        pass
    assert path.read_bytes() == data


@pytest.mark.parametrize("deep", ["[" * 100_000, '{"a":' * 100_000])
def test_lines_that_are_deep_are_reported(deep, tmp_path):
    path = tmp_path / "runs.jsonl"
    data = written(path)
    path.write_bytes(data + deep.encode() + b"\n" + data.splitlines()[-1] + b"\n")
    with pytest.raises(ModelError, match="was changed: line 5"), open_journal(path, head()):
        pass
    path.write_text(f"{deep}\n")
    with pytest.raises(ModelError, match="no file"), open_journal(path, head()):
        pass


def test_a_run_whose_process_died_is_replaced_by_one_that_ended(tmp_path):
    path = tmp_path / "runs.jsonl"
    died = [RunResult(1, outcome, "died") for outcome in (Outcome.CRASHED, Outcome.TIMED_OUT)]
    with open_journal(path, head()) as journal:
        journal.append(died)
    with open_journal(path, head()) as journal:
        assert journal.results == {1: died[-1]}
        journal.append(RESULTS)
        journal.append(died)
    with open_journal(path, head()) as journal:
        assert journal.results == {result.run: result for result in RESULTS}


def test_only_one_process_writes(tmp_path):
    path = tmp_path / "runs.jsonl"
    with (
        open_journal(path, head()),
        pytest.raises(ModelError, match="another process"),
        open_journal(path, head()),
    ):
        pass


def test_where_it_cannot_write_it_says_so(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "runs.jsonl", tmp_path / "a\0b", tmp_path):
        with (
            pytest.raises(ModelError, match=r"cannot write to|is no file"),
            open_journal(path, head()),
        ):
            pass


def test_a_full_disk_is_reported_and_the_study_continues(tmp_path):
    path = tmp_path / "runs.jsonl"
    data = written(tmp_path / "whole.jsonl")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with open_journal(path, head()) as journal:
        journal.append(RESULTS[:1])
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 20, limits[1]))
        try:
            with pytest.raises(ModelError, match=f"cannot write to '{path}'.* continues"):
                journal.append(RESULTS[1:])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert list(journal.results) == [2]
    assert path.stat().st_size > data.index(b"\n") + 1
    with open_journal(path, head()) as journal:
        assert list(journal.results.values()) == RESULTS[:1]
        journal.append(RESULTS[1:])
    assert path.read_bytes() == data
