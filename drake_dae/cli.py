"""The command `drake-dae`: its options, and how it ends."""

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
from pathlib import Path
from typing import Any

import drake_dae
from drake_dae.errors import DrakeDaeError, NonMinimumPhaseWarning, ScenarioError, describe_os_error
from drake_dae.running.interruption import Interruption, end_at_once, ending_signals
from drake_dae.scenario.shipped import DEFAULT_SCENARIO

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

    def scenario(self) -> None:
        """Adds a scenario, and `--set` that changes it."""
        text = f"a shipped scenario or a YAML file (default: {DEFAULT_SCENARIO})"
        self.add_argument("scenario", nargs="?", default=DEFAULT_SCENARIO, help=text)
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


def make_parser() -> Parser:
    """The parser of all commands; `module` is the file in commands/ that has the function."""
    parser = Parser(
        prog="drake-dae",
        description="Robots in contact: position and force tracking on Drake's systems framework.",
        epilog=EXIT_CODES,
    )
    parser.add_argument("--version", action="version", version=drake_dae.__version__)
    commands = parser.add_subparsers(dest="command", required=True)

    def add(name: str, module: str, text: str, more: str = "") -> Parser:
        about = f"{text[0].upper()}{text[1:]}. {more}"
        command: Parser = commands.add_parser(name, help=text, description=about)
        command.set_defaults(module=module)
        return command

    add("list", "texts", "list the shipped scenarios").json("print names and descriptions")

    shown = add("print", "texts", "print a shipped scenario, as the beginning of your own")
    shown.add_argument("scenario", nargs="?", default=DEFAULT_SCENARIO, help="which one")
    shown.flag("--path", "print where its file is instead")

    add("schema", "texts", "print the JSON Schema of a scenario, by which editors complete keys")

    text = (
        "It finds base, chain and tip, locks grippers and wheels, places a surface within good "
        "reach of the tip, and makes the tip circle and press there within the limits. Comments "
        "give the reasons. A run checks it: the exit code is 0 if that is GOOD, and 2 otherwise."
    )
    new = add(
        "new", "scenarios", "write a scenario for a robot of which only the file is known", text
    )
    new.add_argument("robot", help="a URDF, SDFormat, MJCF or model-directives file")
    surfaces = ("plane", "cylinder", "sphere")
    new.add_argument("--surface", choices=surfaces, default="plane", help="(default: plane)")
    text = "the link or frame in contact, and the contact point in it in m (default: the end of "
    new.add_argument("--tip", default="", metavar="LINK[:x,y,z]", help=f"{text}the longest chain)")
    new.out("FILE", "the file (default: <robot>_<surface>.yaml)")

    text = (
        "Of the robot: relative degrees, index, Assumptions (1)-(5), zero dynamics. Of the "
        "reference: the nearest singularity, control and joint forces against their limits, "
        "contact forces, joint limits, and when it leaves what the robot can reach."
    )
    analyze = add("analyze", "scenarios", "examine a scenario without running it", text)
    analyze.scenario()
    analyze.json("print the report")
    analyze.epilog = "exit code: 0, or 2 if a problem was found (the lines PROBLEM)"

    text = (
        "A record, a summary and an animation are written into a folder. The first line of the "
        "summary says whether the run is GOOD, BAD or UNDECIDED, and why. A rollout is faster for "
        "many runs (see sweep), not for one; its record has every fixed step, or 1000 rows under "
        "error control."
    )
    simulate = add("simulate", "runs", "run a scenario", text)
    simulate.scenario()
    simulate.out("FOLDER", "folder for the results (default: runs/<scenario>-<time>)")
    simulate.flag("--meshcat", "show the robot while it runs, in a browser")
    simulate.flag("--open", "open the animation in a browser at the end")
    simulate.flag("--rollout", "run the whole loop as one function, without Drake's Simulator")
    simulate.flag("--check", "exit code 2 for a run that missed its task")
    simulate.json("print the verdict and the files")

    text = (
        "It runs every combination of the values of some keys, on all cores, and writes a table "
        "and a plot with figures of each run. The same command continues a study that was killed, "
        "and tries runs again whose process died or was too slow (exit code 1)."
    )
    sweep = add("sweep", "sweep", "run a scenario many times with other values", text)
    sweep.scenario()
    text = (
        'what varies, for example "start.errors.tool.z=0..0.05:6" (six even values), '
        '"law.gains.all=[[-4], [-8]]" (these), "plant.parameters.link1.mass=9.5..10.5" with '
        '--random, "plant.parameters.wall.position=[[0.69..0.71, 0, 0]]" likewise, or '
        '"sensors.force.seed=1..20:20"'
    )
    sweep.repeatable("--vary", "KEY=VALUES", text, required=True)
    chosen = sweep.add_mutually_exclusive_group()
    text = "number of runs with random values, even in their ranges, instead of a grid"
    chosen.add_argument("--random", type=int, metavar="COUNT", help=text)
    text = "the first values of all keys, then the second ones, instead of a grid"
    chosen.add_argument("--together", action="store_true", help=text)
    sweep.add_argument("--seed", type=int, default=0, help="of random values (0)")
    sweep.flag("--rollout", "as `simulate --rollout` does: many times as fast")
    text = "how many processes (default: one per core)"
    sweep.add_argument("--workers", type=int, metavar="COUNT", help=text)
    text = "how many SECONDS a run may take by the clock until its process is ended (3600)"
    sweep.add_argument("--time-limit", type=float, default=3600.0, metavar="SECONDS", help=text)
    sweep.flag("--check", "exit code 2 if a run did not finish")
    sweep.json("print outcomes and figures")
    sweep.path("--out", "FOLDER", "folder for the results (default: runs/<scenario>-sweep)")

    text = "Errors are drawn as predicted beside those measured, all runs in one picture."
    plot = add("plot", "runs", "draw signals of runs over each other, or make a film of one", text)
    plot.path("runs", "RUN", "a folder of a run, or a record.npz", nargs="+")
    text = "what to draw, as wall.force,control (default: all outputs)"
    plot.repeatable("--signals", "NAMES", text)
    plot.flag("--errors", "|z - r| of outputs, over the predicted one")
    plot.flag("--all", "all plots of each run, into its folder, as write.plots=true does")
    text = "the robot as it moves, with the paths and the forces of its contacts"
    plot.flag("--film", f"{text}: a .gif, or a .png for four moments side by side")
    plot.out("FILE", "a .png, .pdf or .svg (default: plot.png), or the film (film.gif)")

    play = add("play", "runs", "play the animation of a run in the browser")
    play.path("folder", "RUN", "the folder of a run")

    text = (
        "It needs no server and no network. There are sliders, a target and surfaces that are "
        "dragged, links that are pushed, and plots of force and error with the prediction. To make "
        "it takes zig: pip install ziglang."
    )
    page = add("page", "scenarios", "write a scenario as one HTML file in which it runs", text)
    page.scenario()
    page.out("FILE", "the page (default: <scenario>.html)")
    page.flag("--open", "open the page in a browser")

    text = (
        "It is plain C99 without dependencies: the whole loop, and its sampled controller as one "
        "step. Sizes, names and units stand in the code. `make` in the folder compiles programs "
        "that compare with runs of Drake's Simulator."
    )
    export = add("export", "scenarios", "write controller, plant and loop as C code", text)
    export.scenario()
    export.out("FOLDER", "folder for the files (default: <scenario>_c99)")
    return parser


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
    is_json = False
    if isinstance(sys.stdout, TextIOWrapper):
        # Names may have letters that the terminal cannot show.
        sys.stdout.reconfigure(errors="backslashreplace")
    # Drake logs the port of each Meshcat, also of a Meshcat that only records.
    logging.getLogger("drake").setLevel(logging.WARNING)
    try:
        # A signal becomes an exception, so that unfinished files are removed.
        with warnings.catch_warnings(), ending_signals(end_at_once):
            warnings.showwarning = lambda message, *_: print(f"warning: {message}", file=sys.stderr)
            options = make_parser().parse_args(arguments)
            is_json = getattr(options, "json", False)
            # Drake's modules would make an ImportError of the exception of a signal.
            with ending_signals(interruption := Interruption()):
                module = import_module(f"drake_dae.commands.{options.module}")
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
