"""Makes a scenario for a robot from nothing but its file."""

import os
from dataclasses import replace
from itertools import product
from pathlib import Path
from textwrap import shorten

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.systems.analysis import SimulatorConfig

from drake_dae.arguments import checked
from drake_dae.errors import DrakeDaeError, ScenarioError
from drake_dae.robots.constraints import PointOnSurface
from drake_dae.robots.links.links import Links
from drake_dae.robots.outputs import PointCoordinates
from drake_dae.robots.surfaces.surface import Vector
from drake_dae.robots.surfaces.surfaces import Plane
from drake_dae.scenario.judging import Feasibility, complete_and_examine
from drake_dae.scenario.new.places import find_places
from drake_dae.scenario.new.robot import NewRobot, new_robot
from drake_dae.scenario.new.task import NewTask, SurfaceKind, circle
from drake_dae.scenario.new.text import scenario_text
from drake_dae.scenario.parts import parts as parts
from drake_dae.scenario.robot_file.links import robot_links
from drake_dae.scenario.scenario import Scenario

_FRACTIONS = (1.0, 0.5, 0.2)
"""The fractions of the usual circle and force that are tried at each place."""

_BESIDE = "B(x) is singular beside the reference, not along it: `drake-dae analyze` says where"

_PLACES = 4
"""The number of places that are tried."""


@checked(lambda text: ScenarioError(("", text)))
def new_scenario(
    file: str,
    surface: SurfaceKind = "plane",
    tip: str = "",
    point: Vector = (0.0, 0.0, 0.0),
    folder: str | Path | None = None,
) -> tuple[Scenario, str]:
    """Makes a scenario in which a robot presses on a surface and moves in a circle on it.

    The base is the free root body of the file. The working chain is the longest one without mimic
    joints, grippers and wheels, or the one that ends at `tip`; all other joints are locked. The
    surface is placed where the tip reaches it with its axis along the normal, and where the
    directions of the task are most independent. If the last joint does not move the tip, the far
    end of the link is the tip. `complete_scenario` chooses outputs and start. Circle and force keep
    a margin to the limits of the joints. `find_feasibility` finds no problem; it may find states
    off the reference where B(x) is singular, and then the text says so.

    Args:
        file: The robot's file, as a scenario has it.
        surface: The surface: "plane", "cylinder" or "sphere".
        tip: The frame in contact; found if empty.
        point: The point in that frame, m, shape (3,).
        folder: The folder in which the text will be saved: a robot's file below it gets a name
            relative to it. Without one the name is absolute, and the text may be saved anywhere.

    Returns:
        The scenario, and its text with a comment on each choice; `load_scenario` reads the same
        scenario from it.

    Raises:
        ScenarioError: The file cannot be read or has no such tip, or no place is reached; the
            message lists the places that were tried.
    """
    is_url = file.startswith("package://")
    robot = new_robot(file if is_url or not file else os.path.realpath(file), tip, point)
    scene_graph = SceneGraph()
    read = robot_links(robot.robot, scene_graph, drawn=False)
    links = read[0]
    tried: list[str] = []
    usable: tuple[Scenario, NewTask, Feasibility] | None = None
    places = find_places(links, robot.tip, robot.point)[:_PLACES]
    for fraction, place in product(_FRACTIONS, places):
        task = circle(place, surface, fraction)
        try:
            whole, report = complete_and_examine(_scenario(robot, task, links), scene_graph, read)
            problems = report.problems
            deeper = usable is not None and _depth(report) >= _depth(usable[2])
            if not deeper and not set(problems) - {*_beside(report), *report.wrong_sides}:
                usable = whole, task, report
        except DrakeDaeError as error:
            problems = (str(error),)
        if not problems:
            return whole, scenario_text(whole, robot, task, folder)
        x, y, z = task.center
        where = f"{task.name} at ({x:g}, {y:g}, {z:g}) m, {task.path} of {task.radius:g} m"
        tried.append(f"{where}: {shorten(problems[0], 160, placeholder=' ...')}")
    if usable is not None:
        whole, task, report = usable
        remarks = {"outputs": _BESIDE} if _beside(report) else {}
        if report.wrong_sides:
            remarks["constraints"] = "; ".join(map(str, report.behind))
        robot = replace(robot, remarks={**robot.remarks, **remarks})
        return whole, scenario_text(whole, robot, task, folder)
    text = (
        f"no place was found where '{robot.tip}' can move along a {surface}. Tried: "
        + ("; ".join(tried[:_PLACES]) or "surfaces along all axes of the world")
        + ". Give another tip, or copy a shipped scenario"
    )
    raise ScenarioError(("robot", text))


def _depth(report: Feasibility) -> float:
    """The sum of the depths of links behind surfaces, in m."""
    return sum(link.depth for link in report.behind)


def _beside(report: Feasibility) -> tuple[str, ...]:
    """The problems with states near the start that are not on the reference."""
    analysis = report.analysis
    if analysis.structure is None or analysis.motion is None or analysis.motion.ending:
        return ()
    return tuple(a.reason for a in analysis.assumptions if a.number == 5)


def _scenario(robot: NewRobot, task: NewTask, links: Links) -> Scenario:
    """The scenario of a robot's task, without the outputs that will complete it."""
    names = [signal.name for signal in links.position_signals]
    stem = Path(robot.robot.file).name.split(".")[0]
    along = "".join("xyz"[axis] for axis in task.place.ways)
    near = dict(zip(names, (np.round(task.place.q, 4) + 0.0).tolist(), strict=True))
    touching = PointOnSurface(robot.tip, task.surface, robot.point, task.name)
    return Scenario(
        description=f"{stem} draws a {task.path} on a {task.name} and presses on it",
        robot=robot.robot,
        constraints=[touching],
        # On a strongly curved surface an axis fixed to the normal hinders motion along it.
        tool_axis="normal" if isinstance(task.surface, Plane) else "fixed",
        outputs=[PointCoordinates(robot.tip, along, robot.point)],
        law=parts.Law(gains=parts.Poles(all=[-4.0])),
        references=dict(task.references(robot.tip)),
        start=parts.Start(positions=near),
        duration=2 * task.period,
        integrator=SimulatorConfig(
            integration_scheme="runge_kutta5", accuracy=1e-8, use_error_control=True
        ),
    )
