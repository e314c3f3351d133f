"""The command `drake-dae`."""

import argparse
import gc
import json
import logging
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from contextlib import redirect_stdout
from importlib import import_module
from io import TextIOWrapper

import drake_dae
from drake_dae.commands.parser import Parser
from drake_dae.errors import (
    DrakeDaeError,
    NonMinimumPhaseWarning,
    ScenarioError,
    describe_os_error,
)
from drake_dae.running.interruption import Interruption, end_at_once, ending_signals

COMMANDS = {
    "list": ("texts", "list the shipped scenarios"),
    "print": ("texts", "print a shipped scenario, as the beginning of your own"),
    "schema": ("texts", "print the JSON Schema of a scenario, for editors"),
    "new": ("scenarios", "write a scenario for a robot of your own"),
    "analyze": ("scenarios", "examine a scenario without running it"),
    "simulate": ("runs", "run a scenario"),
    "sweep": ("sweep", "run a scenario many times with other values"),
    "plot": ("runs", "draw signals of runs over each other, or make a film of one"),
    "play": ("runs", "play the animation of a run in the browser"),
    "page": ("scenarios", "write a scenario as one HTML file in which it runs"),
    "export": ("scenarios", "write controller, plant and loop as C99 or WebAssembly"),
}
"""Command -> its module, which has the functions of `COMMANDS` by its name, and what it does."""

EXIT_CODES = (
    "exit code: 0; 1 for an error, also where a run ends early; 2 for wrong usage, for a problem "
    "that `analyze` found, and with --check for a run that missed its task or did not finish; 128 "
    "+ signal after Ctrl-C (130), SIGTERM (143) and SIGHUP (129): what is recorded is kept"
)

YOUNG = 50_000
"""The number of new objects before a garbage collection: most objects that a command builds are
needed until its end, and Python's default takes a sixth of the time of a short run."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line, by default that of this process, and returns the exit code."""
    if arguments is not None:
        return _main(arguments)
    gc.set_threshold(YOUNG)
    os.environ["MPLBACKEND"] = "agg"  # No command opens a window of Matplotlib's.
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115 (as long as the process)
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    try:
        return _main(sys.argv[1:])
    finally:
        gc.freeze()  # Not needed: the process ends.


def _main(arguments: Sequence[str]) -> int:
    options = argparse.Namespace()
    if isinstance(sys.stdout, TextIOWrapper):
        # Names may have letters that the terminal cannot show.
        sys.stdout.reconfigure(errors="backslashreplace")
    # Drake logs the port of each Meshcat, also of a Meshcat that only records.
    logging.getLogger("drake").setLevel(logging.WARNING)
    try:
        # A signal becomes an exception, so that unfinished files are removed.
        with warnings.catch_warnings(), ending_signals(end_at_once):
            warnings.showwarning = lambda message, *_: print(f"warning: {message}", file=sys.stderr)
            options = _parsed(arguments)
            if options.command == "analyze":  # Its report says so.
                warnings.simplefilter("ignore", NonMinimumPhaseWarning)
            is_json = getattr(options, "json", False)
            with redirect_stdout(sys.stderr if is_json else sys.stdout):
                result = options.run(options)
            code, data = result if isinstance(result, tuple) else (result, None)
            if is_json:
                print(json.dumps(data, indent=2))
            sys.stdout.flush()  # The interpreter's own last flush would end with 120.
            return int(code)
    except DrakeDaeError as error:
        # A scenario's error has a line for each problem; other texts, as of Drake, become one line.
        text = str(error)
        return _fail(text if isinstance(error, ScenarioError) else " ".join(text.split()), options)
    except BrokenPipeError:
        # The reader of the output, such as head, has closed it; Python would report that on exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        return _fail(describe_os_error(error), options)
    except KeyboardInterrupt as interrupt:
        print("interrupted", file=sys.stderr)
        return 128 + (interrupt.args[0] if interrupt.args else signal.SIGINT)


def _parsed(arguments: Sequence[str]) -> argparse.Namespace:
    """The options; only the module of the command is loaded.

    Signals wait meanwhile: Drake's modules would make an ImportError of their exception.
    """
    parser = Parser(
        prog="drake-dae",
        description="Robots in contact: position and force tracking on Drake's systems framework.",
        epilog=EXIT_CODES,
    )
    parser.add_argument("--version", action="version", version=drake_dae.__version__)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, (module, text) in COMMANDS.items():
        command: Parser = commands.add_parser(name, help=text)
        if name in arguments[:1]:
            with ending_signals(interruption := Interruption()):
                loaded = import_module(f"drake_dae.commands.{module}")
            if interruption.signal is not None:
                end_at_once(interruption.signal)
            add_options, run = loaded.COMMANDS[name]
            add_options(command)
            command.set_defaults(run=run)
            command.description = " ".join((run.__doc__ or "").split())
    return parser.parse_args(arguments)


def _fail(text: str, options: argparse.Namespace) -> int:
    """Prints an error line by line; returns the exit code."""
    print(*(f"error: {line}" for line in text.splitlines()), sep="\n", file=sys.stderr)
    if getattr(options, "json", False):
        print(json.dumps({"error": text}))
    return 1
