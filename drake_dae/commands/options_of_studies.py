"""The kinds of options of commands, and the options of studies."""

import argparse
import re
from pathlib import Path
from typing import Any

from drake_dae.arrays import number_in

TIME_LIMIT = 3600.0
"""The default time limit of a run of a sweep, in s."""


class CommandParser(argparse.ArgumentParser):
    """A parser with the kinds of options that several commands have."""

    def flag(self, name: str, text: str) -> None:
        """Adds an option without a value."""
        self.add_argument(name, action="store_true", help=text)

    def path(self, name: str, text: str, **more: Any) -> None:
        """Adds a file or a folder."""
        self.add_argument(name, type=path_option, help=text, **more)

    def repeatable(self, name: str, metavar: str, text: str, **more: Any) -> None:
        """Adds an option that may be repeated; its values are a list."""
        self.add_argument(
            name, action="append", **{"default": [], "metavar": metavar, "help": text, **more}
        )

    def settings(self, text: str) -> None:
        """Adds `--set`."""
        self.repeatable("--set", "KEY=VALUE", f"{text}; may be repeated", dest="settings")

    def json(self, text: str) -> None:
        """Adds `--json`."""
        self.flag("--json", f'{text}; for an error, its text under "error"')


def add_sweep(commands: Any, scenario: CommandParser) -> None:
    """Adds the command `sweep`."""
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
        '"gains.all=[[-4], [-8]]" (these), "plant_parameters.link1.mass=9.5..10.5" with --random, '
        '"plant_parameters.wall.position=[[0.69..0.71, 0, 0]]" likewise, or '
        '"force_feedback.seed=1..20:20"; may be repeated',
        required=True,
    )
    chosen = study.add_mutually_exclusive_group()
    chosen.add_argument(
        "--random",
        type=whole_option,
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
        "--seed", type=whole_option, default=0, help="of the random values (default: 0)"
    )
    study.flag(
        "--rollout",
        "run without Drake's Simulator, the whole loop as one function, as `simulate --rollout` "
        "does: many times as fast",
    )
    study.add_argument(
        "--workers",
        type=whole_option,
        metavar="COUNT",
        help="how many processes (default: one per core)",
    )
    study.add_argument(
        "--time-limit",
        type=seconds_option,
        default=TIME_LIMIT,
        metavar="SECONDS",
        help="how long a run may take by the clock, building included, until its process is ended "
        f"and it counts as timed out (default: {TIME_LIMIT:g})",
    )
    study.flag("--check", "exit code 2 if a run did not finish")
    study.json("print outcomes and figures as JSON, and all else on stderr")
    study.path("--out", "folder for the results (default: runs/<scenario>-sweep)")


def path_option(text: str) -> Path:
    """A path of the command line; "", as from an unset variable of the shell, is refused."""
    if not text:
        raise argparse.ArgumentTypeError("a name is needed, got ''")
    return Path(text)


def whole_option(text: str) -> int:
    """A whole number of the command line; Python also reads 1_000 and digits of other alphabets."""
    if not re.fullmatch("-?[0-9]{1,15}", text):
        raise argparse.ArgumentTypeError(f"expected a whole number, got '{text}'")
    return int(text)


def seconds_option(text: str) -> float:
    """A positive number of the command line."""
    value = number_in(text)
    if value is None or value <= 0.0:
        raise argparse.ArgumentTypeError(f"expected a positive number of seconds, got '{text}'")
    return value
