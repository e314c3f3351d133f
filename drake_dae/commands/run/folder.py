"""The folder for the files of a run."""

import errno
import fcntl
import os
import shutil
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from tempfile import mkdtemp

from drake_dae.arrays import brief
from drake_dae.errors import ModelError
from drake_dae.files import check_folder
from drake_dae.pictures.plots import PLOTS
from drake_dae.simulation.records.interruption import Interruption, end_at_once, ending_signals
from drake_dae.simulation.records.record import Record

SCENARIO = "scenario.yaml"
RECORD = "record.npz"
PART = "record.part"
"""The record during a run; it remains if the run is killed."""

ANIMATION = "animation.html"

FILES = (SCENARIO, "summary.txt", RECORD, *PLOTS, ANIMATION)
"""The files of a run in its folder."""

FILM = "film.gif"
"""The file of `drake-dae render`."""

MARK = "# Scenario as run by drake-dae"
"""The first line of the scenario in a run's folder: only such a folder is reused."""

_STAGE = ".unfinished-"


@contextmanager
def run_folder(folder: Path) -> Iterator[Path | None]:
    """Makes the folder of a run, and locks it against other runs for the duration of the block.

    The files of an earlier run are moved to a folder "<folder>-1", "<folder>-2", ...; other files
    remain. The scenario's file is created empty, and is the file that is locked. No file is
    written through a symbolic link.

    Yields:
        The folder to which the earlier run was moved; None if there was none.

    Warns:
        UserWarning: The file system has no locks.

    Raises:
        ModelError: The folder cannot be used; the message says why.
    """
    if "\0" in str(folder):
        raise ModelError(f"no path holds a null byte, got {brief(str(folder))}")
    try:
        check_folder(folder)
        lock, moved_to = _prepare(folder)
    except ModelError:
        raise
    except (OSError, ValueError) as error:  # The latter for text of another encoding.
        reason, path = getattr(error, "strerror", None) or error, getattr(error, "filename", None)
        where = f" ({path})" if path and Path(path) != folder else ""
        raise ModelError(f"cannot write to '{folder}': {reason}{where}") from None
    try:
        yield moved_to
    finally:
        os.close(lock)


def load_run(path: Path) -> Record:
    """Reads the record of a run.

    Args:
        path: The folder of the run, or the file of the record.

    Raises:
        ModelError: There is no record.
    """
    if not path.is_dir():
        return Record.load(path)
    for name in (RECORD, PART):
        if (path / name).is_file():
            return Record.load(path / name)
    raise ModelError(f"'{path}' is no folder of a run: it has no {RECORD}")


def runs_by_name(paths: Sequence[Path]) -> dict[str, Path]:
    """Name -> path of several runs; the whole path is the name where the last part is ambiguous.

    Raises:
        ModelError: A run is named twice.
    """
    if len(set(paths)) < len(paths):
        raise ModelError("a run is named twice; name each run once")
    names = Counter(path.name for path in paths)
    return {path.name if path.name and names[path.name] == 1 else str(path): path for path in paths}


def _prepare(folder: Path) -> tuple[int, Path | None]:
    """Locks a folder; returns the locked file, and the folder to which an earlier run was moved."""
    folder.mkdir(parents=True, exist_ok=True)
    _check(folder, None)
    lock = os.open(folder / SCENARIO, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    try:
        _lock(lock, folder)
        _check(folder, (folder / SCENARIO).read_text("utf-8"))
        moved_to = _move_beside(folder, _present(folder)[1:])
        for stale in folder.glob(f"{_STAGE}*"):
            if stale.is_dir() and not stale.is_symlink():
                shutil.rmtree(stale)
        os.truncate(lock, 0)
    except BaseException:
        os.close(lock)
        raise
    return lock, moved_to


def _move_beside(folder: Path, files: Sequence[Path]) -> Path | None:
    """Moves the files of an earlier run beside its folder, with a copy of its scenario."""
    if not files:
        return None
    for file in files:
        if file.is_dir() and not file.is_symlink():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(file))
    here = folder.absolute()
    target = new_folder(here.with_name(f"{here.name}-{number}") for number in count(1))
    # The copy first: it identifies a folder of a run.
    shutil.copyfile(folder / SCENARIO, target / SCENARIO)
    for file in files:
        file.rename(target / file.name)
    return folder.with_name(target.name) if folder.name else target


def new_folder(paths: Iterator[Path]) -> Path:
    """Makes and returns the first of some folders that does not exist."""
    while True:
        with suppress(FileExistsError):
            path = next(paths)
            path.mkdir()
            return path


def _present(folder: Path) -> list[Path]:
    return [folder / name for name in (*FILES, PART, FILM) if os.path.lexists(folder / name)]


def _check(folder: Path, text: str | None) -> None:
    """Checks that a folder has no other files; text is its scenario, None if it is not read yet."""
    present, scenario = _present(folder), folder / SCENARIO
    # Empty: new, or from a run that was killed at once.
    is_of_run = text is None or text.startswith(MARK) or (not text and len(present) == 1)
    if present and (present[0] != scenario or scenario.is_symlink() or not is_of_run):
        names = ", ".join(file.name for file in present)
        raise ModelError(
            f"'{folder}' holds {names}, not from an earlier run; choose another folder"
        )


def _lock(file: int, folder: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES):
            raise ModelError(
                f"another run writes to '{folder}'; wait for its end or choose another folder"
            ) from None
        warnings.warn(
            f"'{folder}' cannot be locked ({error.strerror}): start no other run into it",
            stacklevel=5,
        )


@contextmanager
def stage(folder: Path, *names: str) -> Iterator[Path]:
    """Makes a temporary folder for files, and moves these to the folder when they are complete.

    Args:
        folder: The folder.
        names: The files; all that were made if there are none.

    Raises:
        OSError: A file cannot be written; the error has the path of the first of the names if it
            has no other path.
    """
    temporary = None
    try:
        with _workplace(folder) as temporary:
            yield Path(temporary)
            for name in names or os.listdir(temporary):
                Path(temporary, name).replace(folder / name)
    except OSError as error:
        # Errors of NumPy, zipfile and Pillow have no path, or one in the removed temporary folder.
        if temporary is None or str(error.filename or temporary).startswith(temporary):
            error.filename, error.filename2 = str(folder.joinpath(*names[:1])), None
        raise


@contextmanager
def _workplace(folder: Path) -> Iterator[str]:
    """Makes a temporary folder inside another one, and removes it at the end, also after a signal.

    Signals are deferred while the folder is made and while it is removed.
    """
    temporary = None
    ending, last = Interruption(), Interruption()
    try:
        with ending_signals(ending):
            temporary = mkdtemp(prefix=_STAGE, dir=folder)
        if ending.signal is not None:
            end_at_once(ending.signal)
        yield temporary
    finally:
        if temporary is not None:
            with ending_signals(last):
                shutil.rmtree(temporary)
        if last.signal is not None:
            end_at_once(last.signal)
