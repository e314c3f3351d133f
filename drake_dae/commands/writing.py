"""What the commands share: complete files in a folder, pages that are opened, progress of waits."""

import os
import shlex
import shutil
import sys
import threading
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from drake_dae.errors import ModelError

PATIENCE = 2.0
"""The time in s after which a command tells on a terminal what it does."""


def check_folder(folder: Path) -> None:
    """Checks that a path is a folder, or can become one."""
    if os.path.lexists(folder) and not folder.is_dir():
        raise ModelError(f"'{folder}' is a file, and no folder; name a folder")


@contextmanager
def complete(folder: Path, name: str = "") -> Iterator[Path]:
    """A temporary folder, whose files are moved into a folder when they are complete.

    An OSError without another path names the file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    temporary = TemporaryDirectory(prefix=".unfinished-", dir=folder, ignore_cleanup_errors=True)
    try:
        with temporary as place:
            yield Path(place)
            for written in os.listdir(place):
                Path(place, written).replace(folder / written)
    except OSError as error:
        # Errors of NumPy, zipfile and Pillow have no path, or one in the removed temporary folder.
        if str(error.filename or temporary.name).startswith(temporary.name):
            error.filename, error.filename2 = str(folder / name), None
        raise


def open_page(page: Path) -> None:
    """Opens a file in the browser."""
    address = page.resolve().as_uri()
    try:
        opened = webbrowser.open(address)
    except webbrowser.Error:
        opened = False
    if not opened:
        raise ModelError(f"found no browser here; open {address} in one")
    print(f"opened {address}")


def program() -> str:
    """The words before a command that is printed for the user, so that it works as printed."""
    script, found = Path(sys.argv[0]), shutil.which("drake-dae")
    is_script = script.name == "drake-dae" and script.exists()
    if found is not None and is_script and script.samefile(found):
        return script.name
    return shlex.join([sys.executable, "-m", "drake_dae"])


@contextmanager
def waiting(what: str) -> Iterator[None]:
    """Tells on a terminal what takes longer than `PATIENCE`, with the seconds since its begin."""
    done, began = threading.Event(), time.perf_counter()

    def tell() -> None:
        if done.wait(PATIENCE):
            return
        while not done.wait(0.5):
            passed = time.perf_counter() - began
            print(f"\r{what} ... {passed:.0f} s", end="", file=sys.stderr, flush=True)
        print(file=sys.stderr)

    teller = threading.Thread(target=tell, daemon=True)
    if sys.stderr.isatty():
        teller.start()
    try:
        yield
    finally:
        done.set()
        if teller.ident is not None:
            teller.join()
