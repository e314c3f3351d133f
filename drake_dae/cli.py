"""The command `drake-dae`: its options, how it ends, and the commands that load no Drake."""

import argparse
import atexit
import gc
import json
import logging
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from contextlib import redirect_stdout
from functools import cache
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import drake_dae
from drake_dae.errors import DrakeDaeError, NonMinimumPhaseWarning, ScenarioError, describe_os_error
from drake_dae.running.interruption import Interruption, end_at_once, ending_signals
from drake_dae.scenario import shipped

EXIT_CODES = (
    "exit code: 0; 1 for an error, also where a run ends early; 2 for wrong usage, for a problem "
    "that `analyze` found, and with --check for a run that missed its task or did not finish; 128 "
    "+ signal after Ctrl-C (130), SIGTERM (143) and SIGHUP (129): what is recorded is kept"
)

YOUNG = 50_000
"""The number of new objects before a garbage collection: most objects that a command builds are
needed until its end, and Python's default takes a sixth of the time of a short run."""


class Parser(argparse.ArgumentParser):
    """A parser with the kinds of options that several commands have."""

    def flag(self, name: str, text: str) -> None:
        self.add_argument(name, action="store_true", help=text)

    def value(self, name: str, metavar: str, text: str, **more: Any) -> None:
        self.add_argument(name, metavar=metavar, help=text, **more)

    def path(self, name: str, metavar: str, text: str, **more: Any) -> None:
        def made(given: str) -> Path:
            if not given or "\0" in given:  # "" comes from an unset variable of the shell.
                raise argparse.ArgumentTypeError(f"a name is needed, got {given!r}")
            return Path(given)

        self.value(name, metavar, text, type=made, **more)

    def repeatable(self, name: str, metavar: str, text: str, **more: Any) -> None:
        self.value(name, metavar, f"{text}; may be repeated", action="append", **more)

    def shipped(self, text: str) -> None:
        text, default = f"{text} (default: {shipped.DEFAULT_SCENARIO})", shipped.DEFAULT_SCENARIO
        self.add_argument("scenario", nargs="?", default=default, help=text)

    def scenario(self) -> None:
        self.shipped("a shipped scenario or a YAML file")
        text = 'change the scenario, for example "integrator.accuracy=1e-8"'
        self.repeatable("--set", "KEY=VALUE", text, dest="settings", default=[])

    def out(self, metavar: str, text: str) -> None:
        self.path("--out", metavar, text)
        self.flag("--force", "replace files that exist")

    def json(self, text: str) -> None:
        text = f'{text} as JSON, all else on stderr; for an error, its text under "error"'
        self.flag("--json", text)


def make_parser() -> Parser:
    """The parser of all commands; `module` is the file that has the function of a command."""
    about = "Robots in contact: position and force tracking on Drake's systems framework."
    parser = Parser(prog="drake-dae", description=about, epilog=EXIT_CODES)
    parser.add_argument("--version", action="version", version=drake_dae.__version__)
    commands = parser.add_subparsers(dest="command", required=True)

    def add(name: str, module: str, text: str, more: str = "") -> Parser:
        about = f"{text[0].upper()}{text[1:]}. {more}"
        command: Parser = commands.add_parser(name, help=text, description=about)
        command.set_defaults(module=f"drake_dae.{module}")
        return command

    add("list", "cli", "list the shipped scenarios").json("print names and descriptions")

    shown = add("print", "cli", "print a shipped scenario, as the beginning of your own")
    shown.shipped("which one")
    shown.flag("--path", "print where its file is instead")

    add("schema", "cli", "print the JSON Schema of a scenario, by which editors complete keys")

    about = (
        "It locks grippers and wheels, places a surface in reach of the tip, and makes the tip "
        "circle and press there. A run checks it: exit code 0 if that is GOOD, and 2 otherwise."
    )
    text = "write a scenario for a robot of which only the file is known"
    new = add("new", "commands.scenarios", text, about)
    new.add_argument("robot", help="a URDF, SDFormat, MJCF or model-directives file")
    surfaces = ("plane", "cylinder", "sphere")
    new.add_argument("--surface", choices=surfaces, default="plane", help="(default: plane)")
    text = "the link or frame in contact, and the contact point in it in m (default: the end of "
    new.value("--tip", "LINK[:x,y,z]", f"{text}the longest chain)", default="")
    new.out("FILE", "the file (default: <robot>_<surface>.yaml)")

    about = (
        "Of the robot: relative degrees, index, Assumptions (1)-(5), zero dynamics. Of the "
        "reference: singularities, limits of forces and joints, contact forces, and reach."
    )
    analyze = add("analyze", "commands.scenarios", "examine a scenario without running it", about)
    analyze.scenario()
    analyze.json("print the report")
    analyze.epilog = "exit code: 0, or 2 if a problem was found (the lines PROBLEM)"

    about = "Its summary begins with GOOD, BAD or UNDECIDED, and why."
    simulate = add("simulate", "commands.runs", "run a scenario", about)
    simulate.scenario()
    simulate.out("FOLDER", "folder for the results (default: runs/<scenario>-<time>)")
    simulate.flag("--meshcat", "show the robot while it runs, in a browser")
    simulate.flag("--open", "open the animation in a browser at the end")
    simulate.flag("--rollout", "run the whole loop as one function, without Drake's Simulator")
    simulate.flag("--check", "exit code 2 for a run that missed its task")
    simulate.json("print the verdict and the files")

    about = (
        "It runs every combination of the values of some keys. The same command continues a study "
        "that was killed, and tries runs again that died or were too slow (exit code 1)."
    )
    text = "run a scenario many times with other values"
    sweep = add("sweep", "commands.scenarios", text, about)
    sweep.scenario()
    text = (
        'what varies, for example "start.errors.tool.z=0..0.05:6" (six even values), '
        '"law.gains.all=[[-4], [-8]]" (these), "plant.parameters.link1.mass=9.5..10.5" with '
        '--random, "plant.parameters.wall.position=[[0.69..0.71, 0, 0]]" likewise, or '
        '"sensors.force.seed=1..20:20"'
    )
    sweep.repeatable("--vary", "KEY=VALUES", text, required=True)
    either = sweep.add_mutually_exclusive_group()
    text = "number of runs with random values, even in their ranges, instead of a grid"
    either.add_argument("--random", type=int, metavar="COUNT", help=text)
    text = "the first values of all keys, then the second ones, instead of a grid"
    either.add_argument("--together", action="store_true", help=text)
    sweep.value("--seed", "SEED", "of random values (0)", type=int, default=0)
    sweep.flag("--rollout", "as `simulate --rollout` does: many times as fast")
    sweep.value("--workers", "COUNT", "how many processes (default: one per core)", type=int)
    text = "how many SECONDS a run may take by the clock until its process is ended (3600)"
    sweep.value("--time-limit", "SECONDS", text, type=float, default=3600.0)
    sweep.flag("--check", "exit code 2 if a run did not finish")
    sweep.json("print outcomes and figures")
    sweep.path("--out", "FOLDER", "folder for the results (default: runs/<scenario>-sweep)")

    about = "Errors are drawn as predicted beside those measured, all runs in one picture."
    text = "draw signals of runs over each other, or make a film of one"
    plot = add("plot", "commands.runs", text, about)
    plot.path("runs", "RUN", "a folder of a run, or a record.npz", nargs="+")
    text = "what to draw, as wall.force,control (default: all outputs)"
    plot.repeatable("--signals", "NAMES", text, default=[])
    plot.flag("--errors", "|z - r| of outputs, over the predicted one")
    plot.flag("--all", "all plots of each run, into its folder, as write.plots=true does")
    text = "the robot as it moves, with the paths and the forces of its contacts"
    plot.flag("--film", f"{text}: a .gif, or a .png for four moments side by side")
    plot.out("FILE", "a .png, .pdf or .svg (default: plot.png), or the film (film.gif)")

    play = add("play", "commands.runs", "play the animation of a run in the browser")
    play.path("folder", "RUN", "the folder of a run")

    about = "It needs neither server nor network. To make it takes zig: pip install ziglang."
    text = "write a scenario as one HTML file in which it runs"
    page = add("page", "commands.scenarios", text, about)
    page.scenario()
    page.out("FILE", "the page (default: <scenario>.html)")
    page.flag("--open", "open the page in a browser")

    about = "`make` in the folder compiles programs that compare with runs of Drake's Simulator."
    text = "write controller, plant and loop as C99 without dependencies"
    export = add("export", "commands.scenarios", text, about)
    export.scenario()
    export.out("FOLDER", "folder for the files (default: <scenario>_c99)")
    return parser


def list_command(options: argparse.Namespace) -> tuple[int, dict[str, str]]:
    """Lists names and descriptions."""
    found = {name: shipped.description(path) for name, path in shipped.shipped_scenarios().items()}
    width = max(map(len, found), default=0)
    print(*(f"{name.ljust(width)}  {text}" for name, text in found.items()), sep="\n")
    return 0, found


def print_command(options: argparse.Namespace) -> int:
    """Prints the file of a scenario, or where it is."""
    from drake_dae.files import read_text

    path = shipped.find_scenario(options.scenario)
    try:
        print(f"{path}\n" if options.path else read_text(path), end="")
    except UnicodeDecodeError:
        raise ScenarioError((str(path), "the file is not UTF-8 text; save it as such")) from None
    return 0


def schema_command(options: argparse.Namespace) -> int:
    """Prints the JSON Schema."""
    from drake_dae.scenario.scenario import scenario_schema

    print(json.dumps(scenario_schema(), indent=1))
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line, by default that of this process, and returns the exit code."""
    if arguments is None:
        gc.set_threshold(YOUNG)
        atexit.register(gc.freeze)  # The process ends, and nothing need be collected.
        os.environ["MPLBACKEND"] = "agg"  # No command opens a window of Matplotlib's.
        sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115 (as long as the process)
        sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    if isinstance(sys.stdout, TextIOWrapper):
        # Names may have letters that the terminal cannot show.
        sys.stdout.reconfigure(errors="backslashreplace")
    # Drake logs the port of each Meshcat, also of a Meshcat that only records.
    logging.getLogger("drake").setLevel(logging.WARNING)
    is_json = False
    try:
        # A signal becomes an exception, so that unfinished files are removed.
        with warnings.catch_warnings(), ending_signals(end_at_once):
            # Each text once: a robot is read again with the loads that an estimator looks for.
            tell = cache(lambda text: print(f"warning: {text}", file=sys.stderr))
            warnings.showwarning = lambda message, *_: tell(str(message))
            options = make_parser().parse_args(arguments)
            is_json = getattr(options, "json", False)
            # Drake's modules would make an ImportError of the exception of a signal.
            with ending_signals(interruption := Interruption()):
                module = import_module(options.module)
            if interruption.signal is not None:
                end_at_once(interruption.signal)
            if options.command == "analyze":  # Its report says so.
                warnings.simplefilter("ignore", NonMinimumPhaseWarning)
            with redirect_stdout(sys.stderr if is_json else sys.stdout):
                result = getattr(module, f"{options.command}_command")(options)
            code, data = result if isinstance(result, tuple) else (result, None)
            if is_json:
                print(json.dumps(data, indent=2))
            sys.stdout.flush()  # The interpreter's own last flush would end with 120.
            return int(code)
    except DrakeDaeError as error:
        # A scenario's error has a line for each problem; other texts, as of Drake, become one line.
        text = str(error) if isinstance(error, ScenarioError) else " ".join(str(error).split())
    except BrokenPipeError:
        # The reader of the output, such as head, has closed it; Python would report that on exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        text = describe_os_error(error)
    except KeyboardInterrupt as interrupt:
        print("interrupted", file=sys.stderr)
        return 128 + (interrupt.args[0] if interrupt.args else signal.SIGINT)
    print(*(f"error: {line}" for line in text.splitlines()), sep="\n", file=sys.stderr)
    if is_json:
        print(json.dumps({"error": text}))
    return 1
