"""The command `drake-dae`."""

import argparse
import gc
import json
import logging
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from io import TextIOWrapper

from drake_dae.commands.options import parse_options
from drake_dae.errors import (
    DrakeDaeError,
    NonMinimumPhaseWarning,
    ScenarioError,
    describe_os_error,
)
from drake_dae.scenario.shipped import description, shipped_scenarios
from drake_dae.simulation.records.interruption import Interruption, end_at_once, ending_signals

YOUNG = 50_000
"""The number of new objects before a garbage collection.

Most objects that a command builds are needed until its end. Python's default takes a sixth of the
time of a short run.
"""


_MODULES = {
    "schema": "texts",
    "print": "texts",
    "cache": "texts",
    "page": "play",
    "render": "plot",
    "analyze": "new",
}
"""Command -> its module, if the module has another name."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code.

    The code is 0; or 1 for an error, also if a run ends early; or 2 for a problem found by
    `analyze`, with `--check` for a run that missed its task, and for wrong usage; or 128 + signal
    after Ctrl-C (130), SIGTERM (143) or SIGHUP (129).

    Args:
        arguments: The arguments after the command's name; None for those of this process, which
            must do nothing else then.
    """
    if arguments is not None:
        return _main(arguments)
    gc.set_threshold(YOUNG)
    try:
        return _main(None)
    finally:
        gc.freeze()  # Not needed: the process ends.


def _main(arguments: Sequence[str] | None) -> int:
    options = parse_options(arguments)
    if isinstance(sys.stdout, TextIOWrapper):
        # Names may have letters that the terminal cannot show.
        sys.stdout.reconfigure(errors="backslashreplace")
    as_json = getattr(options, "json", False)
    try:
        if options.command == "list":
            return _flushed(_list(as_json))
        run_command = _loaded(options.command)
        # The report of `analyze` contains it.
        ignored = [NonMinimumPhaseWarning] if options.command == "analyze" else []
        if getattr(options, "compiled", None) is not None:
            options.settings.append(f"compiled={options.compiled}")
        # Drake logs the port of each Meshcat, also of a Meshcat that only records.
        logging.getLogger("drake").setLevel(logging.WARNING)
        # A signal becomes an exception, so that unfinished files are removed.
        with _warnings(*ignored), ending_signals(end_at_once):
            return _flushed(run_command(options))
    except DrakeDaeError as error:
        # A scenario's error has a line for each problem; other texts, as of Drake, become one line.
        is_listed = isinstance(error, ScenarioError)
        text = str(error) if is_listed else " ".join(str(error).split())
        return _fail(text, as_json)
    except BrokenPipeError:
        # The reader of the output, such as head, has closed it; Python would report that on exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        return _fail(describe_os_error(error), as_json)
    except KeyboardInterrupt as interrupt:
        print("interrupted", file=sys.stderr)
        return 128 + (interrupt.args[0] if interrupt.args else signal.SIGINT)


def _flushed(code: int) -> int:
    """The exit code, once all output is written: the interpreter's own last flush ends with 120."""
    sys.stdout.flush()
    return code


def _fail(text: str, as_json: bool) -> int:
    """Prints an error line by line; returns the exit code."""
    print(*(f"error: {line}" for line in text.splitlines()), sep="\n", file=sys.stderr)
    if as_json:
        print(json.dumps({"error": text}))
    return 1


def _loaded(command: str) -> Callable[[argparse.Namespace], int]:
    """Imports the function of a command.

    Signals are deferred meanwhile: Drake's modules would convert their exception to an ImportError.
    """
    with ending_signals(interruption := Interruption()):
        module = _MODULES.get(command, command)
        run_command: Callable[[argparse.Namespace], int] = import_module(
            f"drake_dae.commands.{module}"
        ).run_command
    if interruption.signal is not None:
        end_at_once(interruption.signal)
    return run_command


def _list(as_json: bool) -> int:
    paths = shipped_scenarios()
    if as_json:
        print(json.dumps({name: description(path) for name, path in paths.items()}, indent=2))
        return 0
    width = max(map(len, paths), default=0)
    for name, path in paths.items():
        print(f"{name.ljust(width)}  {description(path)}")
    return 0


@contextmanager
def _warnings(*ignored: type[Warning]) -> Iterator[None]:
    """Prints warnings like errors, without the line of code; ignores some categories."""
    with warnings.catch_warnings():
        for category in ignored:
            warnings.simplefilter("ignore", category)
        warnings.showwarning = lambda message, *_: print(f"warning: {message}", file=sys.stderr)
        yield
