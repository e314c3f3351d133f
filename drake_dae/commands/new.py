"""`drake-dae new` and `analyze`: write a scenario for a robot, and examine one without a run."""

import argparse
import json
import logging
import re
import shlex
import sys
import time
import warnings
from pathlib import Path

from pydrake.systems.framework import Context

from drake_dae.arrays import number_in
from drake_dae.commands.options import program
from drake_dae.errors import DrakeDaeError, GeometryWarning, ScenarioError, SimulationError
from drake_dae.files import check_unwritten
from drake_dae.robots.surfaces.surface import Vector
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.files import load_scenario
from drake_dae.scenario.judging import find_feasibility, judge_run
from drake_dae.scenario.new import new_scenario
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.shipped import find_scenario
from drake_dae.scenario.start import start_scenario
from drake_dae.simulation.simulate import simulate

_LONGEST = 20.0
"""The time in s by the clock after which a new scenario is no longer checked."""


def run_command(options: argparse.Namespace) -> int:
    """Runs the command that the options name; returns the exit code."""
    return {"new": _new, "analyze": _analyze}[options.command](options)


def _analyze(options: argparse.Namespace) -> int:
    """Prints the report on the scenario that the options name."""
    path = find_scenario(options.scenario)
    report = find_feasibility(load_scenario(path, options.settings))
    if options.json:
        print(json.dumps({"scenario": path.stem, **report.to_dict()}, indent=2))
    else:
        print(f"{path.stem}\n\n{report}")
    return 2 if report.problems else 0


def _new(options: argparse.Namespace) -> int:
    """Writes a scenario for the robot that the options name."""
    robot = Path(options.robot)
    out = options.out or Path(f"{robot.name.split('.')[0]}_{options.surface}.yaml")
    check_unwritten([out], options.force)
    # The simulation reports what it leaves out, and Drake's parser warns of every tag.
    logging.getLogger("drake").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)
        tip, point = _tip(options.tip)
        began = time.perf_counter()

        def tell(text: str) -> None:
            print(f"{time.perf_counter() - began:4.1f} s: {text}", file=sys.stderr, flush=True)

        where = options.robot, options.surface, tip, point, out.parent
        _, text = new_scenario(*where, progress=tell)
        out.write_text(text, encoding="utf-8")
        print(f"written: {out}", flush=True)
        tell("checking it by a run")
        verdict = _check(load_scenario(out), began + _LONGEST)
    print(f"checked: {verdict}\nnow run: {program()} simulate {shlex.quote(str(out))}")
    return 0 if verdict.startswith("GOOD") else 2


def _check(scenario: Scenario, end: float) -> str:
    """The verdict of a run of a new scenario, or why there is none before an end by the clock."""

    def look(context: Context) -> None:
        if time.perf_counter() > end:
            now = context.get_time()
            text = f"not to its end: the run takes long, and came to {now:.3g} s without a fault"
            raise SimulationError(text, now, [])

    try:
        completed, loop = build_completed(scenario)
        context = start_scenario(completed.scenario, loop)
        config = completed.scenario.integrator
        run = simulate(loop.diagram, context, scenario.duration, config, look=look)
        summary = judge_run(completed.scenario, loop, context, loop.record(context), run)
    except DrakeDaeError as error:
        return str(error)
    return str(summary.judgement)


def _tip(text: str) -> tuple[str, Vector]:
    """The frame and the point in a text "LINK" or "LINK:x,y,z".

    Raises:
        ScenarioError: The point is not three numbers.
    """
    match = re.fullmatch(r"(.*[^:]):([^:]*,[^:]*)", text)
    if match is None:
        return text, (0.0, 0.0, 0.0)
    numbers = [number_in(word) for word in match[2].split(",")]
    x, y, z = numbers if len(numbers) == 3 else (None, None, None)
    if x is None or y is None or z is None:
        form = "LINK or LINK:x,y,z with three numbers in m"
        raise ScenarioError(("--tip", f"expected {form}, got '{text}'"))
    return match[1], (x, y, z)
