"""The command line: commands, options and their help texts."""

import argparse
import re
import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import drake_dae
from drake_dae.arrays import number_in
from drake_dae.scenario.shipped import DEFAULT_SCENARIO

TIME_LIMIT = 3600.0
"""The default time limit of a run of a sweep, in s."""


class CommandParser(argparse.ArgumentParser):
    """A parser with the kinds of options that several commands have."""

    def flag(self, name: str, text: str) -> None:
        """Adds an option without a value."""
        self.add_argument(name, action="store_true", help=text)

    def path(self, name: str, text: str, **more: Any) -> None:
        """Adds a file or a folder."""
        self.add_argument(name, type=_path_option, help=text, **more)

    def repeatable(self, name: str, metavar: str, text: str, **more: Any) -> None:
        """Adds an option that may be repeated; its values are a list."""
        self.add_argument(
            name, action="append", **{"default": [], "metavar": metavar, "help": text, **more}
        )

    def settings(self, text: str) -> None:
        """Adds `--set`."""
        self.repeatable("--set", "KEY=VALUE", f"{text}; may be repeated", dest="settings")

    def force(self) -> None:
        """Adds `--force`."""
        self.flag("--force", "replace files that exist")

    def json(self, text: str) -> None:
        """Adds `--json`."""
        self.flag("--json", f'{text}; for an error, its text under "error"')


def program() -> str:
    """The words before a command that is printed for the user, so that it works as printed."""
    script = Path(sys.argv[0])
    if script.name != "drake-dae":
        return shlex.join([sys.executable, "-m", "drake_dae"])
    found = shutil.which(script.name)
    is_on_path = found is not None and script.exists() and Path(found).samefile(script)
    return script.name if is_on_path else shlex.quote(str(script.absolute()))


def parse_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parses the command and its options.

    Args:
        arguments: Those after the command's name; those of this process if None.

    Raises:
        SystemExit: They are invalid, or ask for help or the version.
    """
    parser = CommandParser(
        prog="drake-dae",
        description="Robots in contact: position and force tracking on Drake's systems framework.",
    )
    parser.add_argument("--version", action="version", version=drake_dae.__version__)
    commands = parser.add_subparsers(dest="command", required=True)
    scenario = CommandParser(add_help=False)
    scenario.add_argument(
        "scenario",
        nargs="?",
        default=DEFAULT_SCENARIO,
        help=f"a shipped scenario or a YAML file (default: {DEFAULT_SCENARIO})",
    )
    scenario.settings('change the scenario, for example "integrator.accuracy=1e-8"')
    scenario.add_argument(
        "--compiled",
        choices=["true", "false", "auto"],
        help="whether functions become machine code, as the scenario's key `compiled`",
    )
    _add_texts(commands)
    _add_simulate(commands, scenario)
    _add_play(commands)
    _add_analyze(commands, scenario)
    _add_sweep(commands, scenario)
    _add_new(commands)
    _add_export(commands, scenario)
    _add_page(commands, scenario)
    _add_pictures(commands)
    cache = commands.add_parser("cache", help="show the machine code in the cache, or remove it")
    cache.flag("--clear", "remove it all")
    options = parser.parse_args(arguments)
    if options.command == "simulate" and options.rollout and options.meshcat:
        parser.error("--rollout shows nothing while it runs; leave out --meshcat")
    return options


def _add_texts(commands: Any) -> None:
    shipped = commands.add_parser("list", help="list the shipped scenarios")
    shipped.json("print names and descriptions as JSON")
    shown = commands.add_parser(
        "print", help="print a shipped scenario, as the beginning of your own"
    )
    shown.add_argument("scenario", nargs="?", default=DEFAULT_SCENARIO, help="which one")
    shown.flag("--path", "print where its file is instead")
    commands.add_parser("schema", help="print the JSON Schema of a scenario, for editors")


def _add_simulate(commands: Any, scenario: CommandParser) -> None:
    run = commands.add_parser(
        "simulate",
        parents=[scenario],
        help="run a scenario",
        epilog="exit code: 0 if the run came to its end, 1 for an error, also where it ended "
        "early; with --check 2 if it missed its task (the first line begins with BAD): an output "
        "is not at its reference, a contact is lost or would have to pull, a link is behind a "
        "surface, a drive or a joint exceeds its limit; or if errors are not as predicted without "
        "a reason",
    )
    run.path("--out", "folder for the results (default: runs/<scenario>-<time>)")
    run.flag("--meshcat", "show the robot while it runs, in a browser")
    run.flag("--open", "open the animation in a browser at the end")
    run.flag(
        "--rollout",
        "run the whole loop as one function, without Drake's Simulator; faster for many runs (see "
        "sweep), not for one; the record has every fixed step, or 1000 rows under error control, "
        "and is written at the end alone",
    )
    run.flag("--check", "exit code 2 for a run that missed its task")
    run.json("print the verdict and where the files are as JSON, and all else on stderr")


def _add_play(commands: Any) -> None:
    play = commands.add_parser(
        "play",
        help="play the animation of a run in the browser, or of several beside each other",
        description="Opens the animation of a run in the browser. Of several runs it writes a page "
        "that shows their animations beside each other, at the same time after their starts.",
    )
    play.path("runs", "the folder of a run", metavar="RUN", nargs="+")
    play.path("--out", "the page of several runs (default: compare.html)", metavar="FILE")
    play.force()


def _add_analyze(commands: Any, scenario: CommandParser) -> None:
    analyze = commands.add_parser(
        "analyze",
        parents=[scenario],
        help="examine a scenario without running it",
        description="Examines the robot of a scenario (relative degrees, index, Assumptions "
        "(1)-(5), zero dynamics) and what its reference takes: the nearest singularity, control "
        "and joint forces against their limits, contact forces, joint limits, and when the "
        "reference leaves what the robot can reach.",
        epilog="exit code: 0 if no problem was found, 2 if one was (the lines PROBLEM), 1 for an "
        "error",
    )
    analyze.json("print JSON")


def _add_new(commands: Any) -> None:
    new = commands.add_parser(
        "new",
        help="write a scenario for a robot of your own",
        description="Writes a scenario for a robot of which only the file is known: it finds base, "
        "chain and tip, locks grippers and wheels, places a surface within good reach of the tip, "
        "and makes the tip circle and press there within the limits. Comments give the reasons.",
    )
    new.add_argument("robot", help="a URDF, SDFormat, MJCF or model-directives file")
    new.add_argument(
        "--surface",
        choices=["plane", "cylinder", "sphere"],
        default="plane",
        help="the surface (default: plane)",
    )
    new.add_argument(
        "--tip",
        default="",
        metavar="LINK[:x,y,z]",
        help="the link or frame in contact, and the contact point in it in m (default: the end of "
        "the longest chain)",
    )
    new.path("--out", "the file (default: <robot>_<surface>.yaml)", metavar="FILE")
    new.force()


def _add_export(commands: Any, scenario: CommandParser) -> None:
    export = commands.add_parser(
        "export",
        parents=[scenario],
        help="write controller, plant and loop as C99 or WebAssembly",
        description="c: writes the law, the plant and the projection of a scenario as plain C99 "
        "without dependencies, with sizes, names and units; and of a sampled law the whole "
        "controller as one step, with a class of C++ over it. `make` in the folder compiles "
        "programs that compare them with Python and with a run of Drake's Simulator. wasm: "
        "writes controller, plant and loop in fixed steps as one WebAssembly module, and a module "
        "of JavaScript that loads it in a page; it needs drake_dae[compiler].",
    )
    export.add_argument("--format", choices=("c", "wasm"), default="c", help="(default: c)")
    export.path("--out", "folder for the files (default: <scenario>_<format>, _c99 for c)")
    export.force()
    export.json("print the names of the files as JSON")


def _add_page(commands: Any, scenario: CommandParser) -> None:
    page = commands.add_parser(
        "page",
        parents=[scenario],
        help="write a scenario as one HTML file in which it runs",
        description="Writes plant, law and references as WebAssembly into one HTML file that needs "
        "neither server nor network: sliders, a target and surfaces that are dragged, links that "
        "are pushed, plots of force and error with the prediction. It needs drake_dae[compiler].",
    )
    page.path("--out", "(default: <scenario>.html)", metavar="FILE")
    page.path(
        "--shared-bundle",
        "where to write the bundle that draws, 2.2 MB, for several pages; without, it is in the "
        "page",
        metavar="FILE",
    )
    page.force()
    page.flag("--open", "open the page in a browser")
    page.json("print the files with their sizes as JSON")


def _add_pictures(commands: Any) -> None:
    film = commands.add_parser(
        "render",
        help="render a run into a GIF, an MP4 or a strip of pictures",
        description="Renders the run in a folder, with the paths and the forces of its contacts. "
        "It needs no screen and no browser.",
    )
    film.path("folder", "the folder of a run, as runs/seven_joint_wall")
    film.path(
        "--out",
        "a .gif or .mp4 (by ffmpeg), or a .png for four moments side by side (default: film.gif in "
        "the folder)",
    )
    film.force()
    plot = commands.add_parser(
        "plot",
        help="draw signals of runs over each other",
        description="Draws outputs of runs with their references, or other signals by name, with "
        "the errors as predicted beside those measured, into one picture.",
    )
    plot.path("runs", "a folder of a run, or a record.npz", metavar="RUN", nargs="+")
    plot.repeatable(
        "--signals",
        "NAMES",
        "what to draw, as wall.force,control or state/joint1; may be repeated (default: all "
        "outputs)",
    )
    plot.flag("--errors", "|z - r| of outputs, over the predicted one")
    plot.flag(
        "--all",
        "all plots of each run, into its folder: outputs, errors, constraint residual, controls, "
        "paths, as write.plots=true does in a run",
    )
    plot.path("--out", "a .png, .pdf or .svg (default: plot.png)", metavar="FILE")
    plot.force()


def _add_sweep(commands: Any, scenario: CommandParser) -> None:
    study = commands.add_parser(
        "sweep",
        parents=[scenario],
        help="run a scenario many times with other values",
        description="Runs a scenario once for every combination of the values of some keys, on all "
        "cores, and writes a table and a plot with figures of each run. If it is killed, "
        "the same command continues it.",
        epilog="exit code: 0, or 1 for an error, also where the process of a run died or was too "
        "slow: the same command tries that run again; with --check 2 if a run did not finish",
    )
    study.repeatable(
        "--vary",
        "KEY=VALUES",
        'what varies, for example "start.errors.tool.z=0..0.05:6" (six even values), '
        '"law.gains.all=[[-4], [-8]]" (these), "plant.parameters.link1.mass=9.5..10.5" with '
        '--random, "plant.parameters.wall.position=[[0.69..0.71, 0, 0]]" likewise, or '
        '"sensors.force.seed=1..20:20"; may be repeated',
        required=True,
    )
    chosen = study.add_mutually_exclusive_group()
    chosen.add_argument(
        "--random",
        type=_whole_option,
        metavar="COUNT",
        help="number of runs with random values, uniformly distributed in their ranges, instead "
        "of a grid",
    )
    chosen.add_argument(
        "--together",
        action="store_true",
        help="the first values of all keys, then the second ones, instead of a grid",
    )
    study.add_argument(
        "--seed", type=_whole_option, default=0, help="of the random values (default: 0)"
    )
    study.flag(
        "--rollout",
        "run without Drake's Simulator, the whole loop as one function, as `simulate --rollout` "
        "does: many times as fast",
    )
    study.add_argument(
        "--workers",
        type=_whole_option,
        metavar="COUNT",
        help="how many processes (default: one per core)",
    )
    study.add_argument(
        "--time-limit",
        type=_seconds_option,
        default=TIME_LIMIT,
        metavar="SECONDS",
        help="how long a run may take by the clock, building included, until its process is ended "
        f"and it counts as timed out (default: {TIME_LIMIT:g})",
    )
    study.flag("--check", "exit code 2 if a run did not finish")
    study.json("print outcomes and figures as JSON, and all else on stderr")
    study.path("--out", "folder for the results (default: runs/<scenario>-sweep)")


def _path_option(text: str) -> Path:
    """A path of the command line; "", as from an unset variable of the shell, is refused."""
    if not text:
        raise argparse.ArgumentTypeError("a name is needed, got ''")
    return Path(text)


def _whole_option(text: str) -> int:
    """A whole number of the command line; Python also reads 1_000 and digits of other alphabets."""
    if not re.fullmatch("-?[0-9]{1,15}", text):
        raise argparse.ArgumentTypeError(f"expected a whole number, got '{text}'")
    return int(text)


def _seconds_option(text: str) -> float:
    """A positive number of the command line."""
    value = number_in(text)
    if value is None or value <= 0.0:
        raise argparse.ArgumentTypeError(f"expected a positive number of seconds, got '{text}'")
    return value
