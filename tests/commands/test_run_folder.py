"""The folder of a run: one run at a time, and only files of its own."""

import errno
import fcntl
import os
import signal
from pathlib import Path

import pytest

from drake_dae.commands.run.folder import FILES, MARK, PART, SCENARIO, run_folder, stage
from drake_dae.errors import ModelError
from drake_dae.simulation.records.interruption import end_at_once, ending_signals


@pytest.fixture
def earlier(tmp_path):
    (tmp_path / SCENARIO).write_text(f"{MARK} 0.1.0\n")
    return tmp_path


def test_two_runs_into_one_folder(tmp_path):
    with run_folder(tmp_path / "run"):
        (tmp_path / "run" / SCENARIO).write_text(f"{MARK}\nof the first")
        with (
            pytest.raises(ModelError, match="run"),
            run_folder(tmp_path / "run"),
        ):
            pass
        assert (tmp_path / "run" / SCENARIO).read_text() == f"{MARK}\nof the first"
    with run_folder(tmp_path / "run"):
        assert (tmp_path / "run" / SCENARIO).read_text() == ""


def test_what_a_killed_run_left_is_kept_but_for_what_is_in_pieces(earlier):
    (earlier / ".unfinished-abc").mkdir()
    (earlier / ".unfinished-abc" / "record.npz").write_text("")
    (earlier / PART).write_text("rows")
    (earlier / "notes.txt").write_text("mine")
    with run_folder(earlier) as kept:
        assert sorted(path.name for path in earlier.iterdir()) == ["notes.txt", SCENARIO]
    assert sorted(path.name for path in kept.iterdir()) == [PART, SCENARIO]
    assert (kept / PART).read_text() == "rows"


@pytest.mark.parametrize("files", [["record.npz"], [*FILES[1:], "film.gif"], [PART]])
def test_each_earlier_run_is_kept_whole_under_a_name_of_its_own(files, tmp_path):
    folder, found = tmp_path / "run", []
    for number in range(4):
        with run_folder(folder) as kept:
            found.append(kept)
            (folder / SCENARIO).write_text(f"{MARK}\n{number}")
            for name in files:
                (folder / name).write_text(f"{name} {number}")
    assert found == [None, *(tmp_path / f"run-{number}" for number in (1, 2, 3))]
    for number, kept in enumerate(found[1:]):
        assert (kept / SCENARIO).read_text() == f"{MARK}\n{number}"
        assert sorted(path.name for path in kept.iterdir()) == sorted([SCENARIO, *files])
        assert all((kept / name).read_text() == f"{name} {number}" for name in files)


def test_the_working_directory_may_be_the_folder(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for _ in range(2):
        with run_folder(Path(".")) as kept:
            Path(SCENARIO).write_text(MARK)
            Path("record.npz").write_text("")
    assert kept == tmp_path / "here-1"
    assert (kept / "record.npz").exists()


@pytest.mark.parametrize("name", [*FILES, PART])
def test_nothing_is_written_through_a_link(name, tmp_path):
    target = tmp_path / "target"
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / name).symlink_to(target)
    refused = pytest.raises(ModelError, match=name)
    with refused, run_folder(folder):
        pass
    assert not target.exists()
    assert (folder / name).is_symlink()


def test_an_empty_scenario_is_no_proof_of_an_earlier_run(tmp_path):
    (tmp_path / SCENARIO).touch()
    with run_folder(tmp_path):
        pass
    (tmp_path / "controls.png").write_text("mine")
    refused = pytest.raises(ModelError, match=r"controls\.png")
    with refused, run_folder(tmp_path):
        pass
    assert (tmp_path / "controls.png").read_text() == "mine"


def test_a_link_beside_an_earlier_run_is_removed_and_its_target_stays(earlier):
    (earlier / "notes.txt").write_text("mine")
    (earlier / "summary.txt").symlink_to(earlier / "notes.txt")
    with run_folder(earlier):
        assert not os.path.lexists(earlier / "summary.txt")
    assert (earlier / "notes.txt").read_text() == "mine"


def test_a_folder_in_the_place_of_a_file_is_named(earlier):
    (earlier / "record.npz").mkdir()
    with (
        pytest.raises(ModelError, match=r"record\.npz"),
        run_folder(earlier),
    ):
        pass
    assert (earlier / "record.npz").is_dir()
    assert not earlier.with_name(f"{earlier.name}-1").exists()


def test_a_file_system_without_locks(tmp_path, monkeypatch):
    def none(file, operation):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", none)
    with pytest.warns(UserWarning, match=str(tmp_path)), run_folder(tmp_path):
        pass


def test_files_appear_when_they_are_complete(tmp_path):
    with stage(tmp_path, "one", "two") as place:
        for name in ("one", "two"):
            (place / name).write_text(name)
            assert not (tmp_path / name).exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one", "two"]


@pytest.mark.parametrize("path", [None, "in its place", "elsewhere"])
def test_an_error_names_the_file(path, tmp_path):
    def fail(place):
        names = {None: (), "in its place": (str(place / "one"),), "elsewhere": ("/mesh.obj",)}
        raise OSError(errno.ENOSPC, "No space left on device", *names[path])

    with pytest.raises(OSError, match="No space left") as caught, stage(tmp_path, "one") as place:
        fail(place)
    assert caught.value.filename == ("/mesh.obj" if path == "elsewhere" else str(tmp_path / "one"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("call", ["mkdir", "rmdir"])
@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("error", [None, OSError(errno.ENOSPC, "No space left")])
def test_a_signal_while_the_place_is_made_or_removed(call, sent, error, tmp_path, monkeypatch):
    """It comes after the place is there, or before it is gone: nothing stays, and it is heard."""
    plain, came = getattr(os, call), []

    def interrupted(*arguments, **options):
        if call == "mkdir":
            plain(*arguments, **options)
        if not came:
            came.append(sent)
            signal.raise_signal(sent)
        if call == "rmdir":
            plain(*arguments, **options)

    monkeypatch.setattr(os, call, interrupted)

    def write():
        with ending_signals(end_at_once), stage(tmp_path, "one") as place:
            (place / "one").write_text("1")
            if error is not None:
                raise error

    with pytest.raises(KeyboardInterrupt) as ended:
        write()
    assert ended.value.args == (sent,)
    assert came == [sent]
    assert not list(tmp_path.glob(".*"))
