"""Files appear in a folder when they are complete, and an error names the file."""

import errno
import signal

import pytest

from drake_dae.commands.writing import complete
from drake_dae.running.interruption import end_at_once, ending_signals


def test_files_appear_when_they_are_complete(tmp_path):
    with complete(tmp_path / "new") as place:
        for name in ("one", "two"):
            (place / name).write_text(name)
            assert not (tmp_path / "new" / name).exists()
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["one", "two"]


@pytest.mark.parametrize("path", [None, "in its place", "elsewhere"])
def test_an_error_names_the_file(path, tmp_path):
    def fail(place):
        names = {None: (), "in its place": (str(place / "one"),), "elsewhere": ("/mesh.obj",)}
        raise OSError(errno.ENOSPC, "No space left on device", *names[path])

    with pytest.raises(OSError, match="No space left") as caught, complete(tmp_path, "one") as at:
        fail(at)
    assert caught.value.filename == ("/mesh.obj" if path == "elsewhere" else str(tmp_path / "one"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leaves_nothing_unfinished(sent, tmp_path):
    def write():
        with ending_signals(end_at_once), complete(tmp_path, "one") as place:
            (place / "one").write_text("1")
            signal.raise_signal(sent)

    with pytest.raises(KeyboardInterrupt) as ended:
        write()
    assert ended.value.args == (sent,)
    assert not list(tmp_path.iterdir())
