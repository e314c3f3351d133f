"""The cache of compiled code: a folder that only this user can write.

Its files are loaded into the process, so the folder is trusted only if nobody else can write it.
The name of a file ends in the digest of its bytes. Files are put in place by one `os.replace` and
never change, and damaged ones are detected. So processes share the folder without locks.
"""

import hashlib
import os
import re
import shutil
import stat
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from drake_dae.errors import MachineCodeError, MachineCodeWarning

SUFFIX = ".so"
"""The suffix of compiled code, also on macOS, where any suffix works."""

_OURS = re.compile(rf"[0-9a-f]{{32}}-[0-9a-f]{{32}}{re.escape(SUFFIX)}|new-\w+")


def cache_folder() -> Path:
    """Returns the path of the cache, also if it does not exist: DRAKE_DAE_CACHE if it is set.

    Otherwise drake_dae in the user's folder for caches: $XDG_CACHE_HOME, or ~/Library/Caches on
    macOS and ~/.cache elsewhere.
    """
    if os.environ.get("DRAKE_DAE_CACHE"):
        return Path(os.environ["DRAKE_DAE_CACHE"]).absolute()
    folder = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if folder.is_absolute():  # Its specification says to ignore other paths.
        return folder / "drake_dae"
    try:
        home = Path.home()
    except RuntimeError:
        raise MachineCodeError(
            "no folder for a cache: this user has no home; name one in DRAKE_DAE_CACHE"
        ) from None
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "drake_dae"


def open_cache(create: bool = False) -> Path | None:
    """Returns the folder of the cache if it can be trusted; None if it does not exist."""
    folder = cache_folder()
    with _explained(folder):
        if create:
            folder.parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileExistsError):
                folder.mkdir(0o700)
        try:
            status = folder.stat()
        except FileNotFoundError:
            if create:
                raise
            return None
    if not stat.S_ISDIR(status.st_mode):
        raise MachineCodeError(f"the cache {folder} is no folder; remove it")
    if status.st_uid != os.getuid():
        raise MachineCodeError(
            f"the cache {folder} belongs to another user (id {status.st_uid}), whose code is not "
            "loaded; name a folder of your own in DRAKE_DAE_CACHE"
        )
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise MachineCodeError(
            f"others can write the cache {folder} (mode {stat.S_IMODE(status.st_mode):04o}), so "
            f"its code is not loaded; chmod 700 {folder}"
        )
    return folder


def find(key: str) -> Path | None:
    """Returns the code that is stored under a key; None if there is none.

    Warns:
        MachineCodeWarning: The file is damaged, and was removed.
    """
    folder = open_cache()
    if folder is None:
        return None
    with _explained(folder):
        path = next(folder.glob(f"{key}-*{SUFFIX}"), None)
        if path is None or path.name == _name(key, path.read_bytes()):
            return path
        path.unlink()
    warnings.warn(f"{path} was damaged, and is removed", MachineCodeWarning, stacklevel=1)
    return None


@contextmanager
def workplace() -> Iterator[Path]:
    """Creates a temporary folder in the cache and removes it at the end."""
    folder = open_cache(create=True)
    with _explained(cache_folder()):
        temporary = tempfile.mkdtemp(prefix="new-", dir=folder)
        try:
            yield Path(temporary)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def store(key: str, file: Path) -> Path:
    """Moves a file from the `workplace` into the cache, under a key for `find`."""
    path = file.parents[1] / _name(key, file.read_bytes())
    file.chmod(0o700)
    os.replace(file, path)
    return path


def contents() -> list[Path]:
    """Returns the files of the cache, and the temporary folders of killed processes."""
    folder = open_cache()
    with _explained(cache_folder()):
        paths = sorted(folder.iterdir()) if folder is not None else []
    return [path for path in paths if _OURS.fullmatch(path.name)]


def clear() -> None:
    """Removes everything from the cache; running processes keep the code that they loaded."""
    for path in contents():
        with _explained(path):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)


def _name(key: str, code: bytes) -> str:
    return f"{key}-{hashlib.sha256(code).hexdigest()[:32]}{SUFFIX}"


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turns an OSError into a MachineCodeError."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise MachineCodeError(f"the cache {path} cannot be used: {reason}") from None
