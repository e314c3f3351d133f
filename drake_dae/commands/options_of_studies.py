"""The options of studies and identification, and the values of options."""

import argparse
import re
from pathlib import Path
from typing import Any

from drake_dae.arrays import number_in

TIME_LIMIT = 3600.0
"""The default time limit of a run of a sweep, in s."""


def add_sweep(commands: Any, named: argparse.ArgumentParser) -> None:
    """`drake-dae sweep`."""
    study = commands.add_parser(
        "sweep",
        parents=[named],
        help="run a scenario many times with other values",
        description=(
            "Runs a scenario once for every combination of the values of some keys, on "
            "all cores, and writes a table with figures of each run, a summary and "
            "plots. If it is killed, the same command continues it."
        ),
        epilog="exit code: 0, or 1 for an error, also where the process of a run died or was too "
        "slow: the same command tries that run again; with --check 2 if a run did not finish",
    )
    study.add_argument(
        "--vary",
        action="append",
        required=True,
        metavar="KEY=VALUES",
        help='what varies, for example "start.errors.tool.z=0..0.05:6" (six even values), '
        '"gains.all=[[-4], [-8]]" (these), "plant_parameters.link1.mass=9.5..10.5" with --random, '
        '"plant_parameters.wall.position=[[0.69..0.71, 0, 0]]" likewise, or '
        '"force_feedback.seed=1..20:20"; may be repeated',
    )
    chosen = study.add_mutually_exclusive_group()
    chosen.add_argument(
        "--random",
        type=whole_option,
        metavar="COUNT",
        help=(
            "number of runs with random values, uniformly distributed in their ranges, instead "
            "of a grid"
        ),
    )
    chosen.add_argument(
        "--together",
        action="store_true",
        help="the first values of all keys, then the second ones, instead of a grid",
    )
    study.add_argument(
        "--seed", type=whole_option, default=0, help="of the random values (default: 0)"
    )
    study.add_argument(
        "--rollout",
        action="store_true",
        help="run without Drake's Simulator, the whole loop as one function, as `simulate "
        "--rollout` does: many times as fast",
    )
    study.add_argument(
        "--workers",
        type=whole_option,
        metavar="COUNT",
        help="how many processes (default: one per core)",
    )
    study.add_argument(
        "--cluster", metavar="ADDRESS", help="run on the Dask cluster with this scheduler instead"
    )
    study.add_argument(
        "--time-limit",
        type=seconds_option,
        default=TIME_LIMIT,
        metavar="SECONDS",
        help="how long a run may take by the clock, building included, until its process is ended "
        f"and it counts as timed out (default: {TIME_LIMIT:g}; on a cluster there is none)",
    )
    study.add_argument("--check", action="store_true", help="exit code 2 if a run did not finish")
    add_json(study, "print outcomes and figures as JSON, and all else on stderr")
    study.add_argument(
        "--out", type=path_option, help="folder for the results (default: runs/<scenario>-sweep)"
    )


def add_identify(commands: Any) -> None:
    """`drake-dae identify`."""
    command = commands.add_parser(
        "identify",
        help="find masses, friction, stiffness, places and biases from records",
        description="Finds parameters of the plant of a scenario from records of it, with 95 % "
        "intervals, what the records do not determine, and what is left of each measurement. The "
        "plant alone is driven by the recorded controls. Steps in which an ideal contact opens, "
        "closes or is struck are left out.",
    )
    command.add_argument(
        "records",
        nargs="+",
        type=path_option,
        metavar="RECORD",
        help="a run's folder, .npz, .csv or .mcap",
    )
    command.add_argument(
        "--free",
        action="append",
        required=True,
        metavar="NAMES",
        help="parameters of the plant, as tool.mass,wall.position[0],plant.friction; force.bias, "
        "position.bias, force.delay and position.delay of sensors; may be repeated",
    )
    command.add_argument(
        "--scenario", help="that of the plant (default: the one in the first record)"
    )
    command.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change the scenario that --scenario names; may be repeated",
    )
    command.add_argument(
        "--columns",
        type=path_option,
        metavar="FILE",
        help='of a .csv or .mcap: a YAML file with lines "column: control.joint1_motor", or '
        '"/topic.field: control.joint1_motor"',
    )
    command.add_argument(
        "--out", type=path_option, metavar="FILE", help="a scenario with these values"
    )
    add_json(command, "print the values as JSON")


def add_excite(commands: Any, named: argparse.ArgumentParser) -> None:
    """`drake-dae excite`."""
    command = commands.add_parser(
        "excite",
        parents=[named],
        help="find the motion and the force that determine parameters best",
        description="Looks for values of some keys of a scenario with which its record determines "
        "parameters of the plant best, within all limits, and prints the 95 % intervals that "
        "`identify` will find from it, before and after. Ctrl-C gives the best so far.",
    )
    command.add_argument(
        "--free",
        action="append",
        required=True,
        metavar="NAMES",
        help="parameters of the plant, as tool.mass,link3.mass; may be repeated",
    )
    command.add_argument(
        "--vary",
        action="append",
        required=True,
        metavar="KEY=LOW..HIGH",
        help='what may be chosen, as "references.wall.force.amplitudes.0=0..15"; may be repeated',
    )
    command.add_argument(
        "--noise",
        action="append",
        default=[],
        metavar="KIND=DEVIATION",
        help="of sensors, where the scenario states none: position=1e-5,force=0.3 (rad or m; N)",
    )
    command.add_argument(
        "--criterion",
        choices=("D", "A"),
        default="D",
        help="D: the volume of the ellipsoid of the relative errors; A: the sum of their squares "
        "(default: D)",
    )
    command.add_argument(
        "--runs", type=whole_option, default=100, help="how many runs are made (default: 100)"
    )
    command.add_argument("--seed", type=whole_option, default=0, help="of the search (default: 0)")
    command.add_argument(
        "--out", type=path_option, metavar="FILE", help="a scenario with the choice"
    )
    add_json(command, "print the choice and the intervals as JSON")


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


def add_json(command: argparse.ArgumentParser, what: str) -> None:
    """Adds the option `--json`."""
    command.add_argument(
        "--json", action="store_true", help=f'{what}; for an error, its text under "error"'
    )
