"""What the commands of `drake-dae` share: options, checks of what they write, progress of waits."""

import argparse
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
from typing import Any

from drake_dae.errors import ModelError

PATIENCE = 2.0
"""The time in s after which a command tells on a terminal what it does."""


class Parser(argparse.ArgumentParser):
    """A parser with the kinds of options that several commands have."""

    def flag(self, name: str, text: str) -> None:
        """Adds an option without a value."""
        self.add_argument(name, action="store_true", help=text)

    def path(self, name: str, metavar: str, text: str, **more: Any) -> None:
        """Adds a file or a folder; "", as from an unset variable of the shell, is refused."""

        def made(given: str) -> Path:
            if not given or "\0" in given:
                raise argparse.ArgumentTypeError(f"a name is needed, got {given!r}")
            return Path(given)

        self.add_argument(name, type=made, metavar=metavar, help=text, **more)

    def repeatable(self, name: str, metavar: str, text: str, **more: Any) -> None:
        """Adds an option that may be repeated; its values are a list."""
        more = {"action": "append", "default": [], **more}
        self.add_argument(name, metavar=metavar, help=f"{text}; may be repeated", **more)

    def scenario(self, default: str) -> None:
        """Adds a scenario, and `--set` that changes it."""
        text = f"a shipped scenario or a YAML file (default: {default})"
        self.add_argument("scenario", nargs="?", default=default, help=text)
        text = 'change the scenario, for example "integrator.accuracy=1e-8"'
        self.repeatable("--set", "KEY=VALUE", text, dest="settings")

    def out(self, metavar: str, text: str) -> None:
        """Adds where to write, and whether files are replaced."""
        self.path("--out", metavar, text)
        self.flag("--force", "replace files that exist")

    def json(self, text: str) -> None:
        """Adds `--json`."""
        text = f'{text} as JSON, all else on stderr; for an error, its text under "error"'
        self.flag("--json", text)


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
    script = Path(sys.argv[0])
    if script.name != "drake-dae":
        return shlex.join([sys.executable, "-m", "drake_dae"])
    found = shutil.which(script.name)
    is_on_path = found is not None and script.exists() and Path(found).samefile(script)
    return script.name if is_on_path else shlex.quote(str(script.absolute()))


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

    if not sys.stderr.isatty():
        yield
        return
    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield
    finally:
        done.set()
        teller.join()
