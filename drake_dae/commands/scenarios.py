"""`drake-dae new`, `analyze`: a scenario for a robot of one's own, and one that is examined."""

import argparse
import json
import logging
import re
import shlex
import warnings
from pathlib import Path

from drake_dae.arrays import number_in
from drake_dae.commands.parser import Parser, program, waiting
from drake_dae.errors import GeometryWarning, ScenarioError
from drake_dae.files import check_unwritten
from drake_dae.robots.surfaces.surface import Vector
from drake_dae.scenario.files import load_scenario
from drake_dae.scenario.judging import find_feasibility
from drake_dae.scenario.new.new_scenario import new_scenario
from drake_dae.scenario.shipped import DEFAULT_SCENARIO, find_scenario


def _new_options(parser: Parser) -> None:
    parser.add_argument("robot", help="a URDF, SDFormat, MJCF or model-directives file")
    surfaces = ("plane", "cylinder", "sphere")
    parser.add_argument(
        "--surface", choices=surfaces, default="plane", help="the surface (default: plane)"
    )
    parser.add_argument(
        "--tip",
        default="",
        metavar="LINK[:x,y,z]",
        help="the link or frame in contact, and the contact point in it in m (default: the end of "
        "the longest chain)",
    )
    parser.out("FILE", "the file (default: <robot>_<surface>.yaml)")


def _new(options: argparse.Namespace) -> int:
    """Writes a scenario for a robot of which only the file is known.

    It finds base, chain and tip, locks grippers and wheels, places a surface within good reach of
    the tip, and makes the tip circle and press there within the limits. Comments give the reasons.
    """
    out = options.out or Path(f"{Path(options.robot).name.split('.')[0]}_{options.surface}.yaml")
    check_unwritten([out], options.force)
    # The simulation reports what it leaves out, and Drake's parser warns of every tag.
    logging.getLogger("drake").setLevel(logging.ERROR)
    with warnings.catch_warnings(), waiting("looking for a place within good reach"):
        warnings.simplefilter("ignore", GeometryWarning)
        tip, point = _tip(options.tip)
        _, text = new_scenario(options.robot, options.surface, tip, point, out.parent)
    out.write_text(text, encoding="utf-8")
    print(f"written: {out}\nnow run: {program()} simulate {shlex.quote(str(out))}")
    return 0


def _tip(text: str) -> tuple[str, Vector]:
    """The frame and the point in a text "LINK" or "LINK:x,y,z"."""
    match = re.fullmatch(r"(.*[^:]):([^:]*,[^:]*)", text)
    if match is None:
        return text, (0.0, 0.0, 0.0)
    numbers = [number for word in match[2].split(",") if (number := number_in(word)) is not None]
    if len(numbers) != 3 or match[2].count(",") != 2:
        form = "LINK or LINK:x,y,z with three numbers in m"
        raise ScenarioError(("--tip", f"expected {form}, got '{text}'"))
    return match[1], (numbers[0], numbers[1], numbers[2])


def _analyze_options(parser: Parser) -> None:
    parser.scenario(DEFAULT_SCENARIO)
    parser.json("print the report")
    parser.epilog = "exit code: 0, or 2 if a problem was found (the lines PROBLEM)"


def _analyze(options: argparse.Namespace) -> int:
    """Examines the robot of a scenario and what its reference takes.

    Of the robot: relative degrees, index, Assumptions (1)-(5), zero dynamics. Of the reference: the
    nearest singularity, control and joint forces against their limits, contact forces, joint
    limits, and when it leaves what the robot can reach.
    """
    path = find_scenario(options.scenario)
    with waiting(f"analyzing {path.stem}"):
        report = find_feasibility(load_scenario(path, options.settings))
    as_json = {"scenario": path.stem, **report.to_dict()}
    print(json.dumps(as_json, indent=2) if options.json else f"{path.stem}\n\n{report}")
    return 2 if report.problems else 0


COMMANDS = {"new": (_new_options, _new), "analyze": (_analyze_options, _analyze)}
