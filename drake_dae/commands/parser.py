"""What the commands of `drake-dae` share: kinds of options, printed commands, long waits."""

import argparse
import shlex
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

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
        while not done.wait(PATIENCE / 2.0):
            passed = time.perf_counter() - began
            if passed > PATIENCE:
                print(f"\r{what} ... {passed:.0f} s", end="", file=sys.stderr, flush=True)

    teller = threading.Thread(target=tell, daemon=True)
    if sys.stderr.isatty():
        teller.start()
    try:
        yield
    finally:
        done.set()
        if teller.is_alive() and time.perf_counter() - began > PATIENCE:
            teller.join()
            print(file=sys.stderr)
