"""A new scenario as text: every number with its unit and reason."""

import json
import os
import re
from collections.abc import Iterator, Mapping
from math import pi
from pathlib import Path
from textwrap import wrap
from typing import Any

from drake_dae.scenario.forms.typed_yaml import TAG
from drake_dae.scenario.new.robot import NewRobot
from drake_dae.scenario.new.task import NewTask
from drake_dae.scenario.scenario import Scenario, scenario_data

_PLAIN = re.compile(r"[A-Za-z_][\w/-]*(?:\.[\w/-]+)*")
"""Text that needs no quotes in YAML, except its words for booleans and null."""

_PATH = (TAG, "center", "radius", "period", "offset", "amplitudes", "frequencies")
"""The keys of a path; the others have their defaults."""

_WORDS = ("y", "n", "yes", "no", "on", "off", "true", "false", "null")

_WIDTH = 100

_WHOLE: Any = {"break_long_words": False, "break_on_hyphens": False}

_WHY = {
    "!PointCoordinates": "along the surface",
    "!TiltFromNormal": "how the tool's axis leans to the surface's normal",
    "!AxisCoordinates": "where the tool's axis points",
    "!JointPositions": "what is left of freedom, so that B(x) is best conditioned",
}


def scenario_text(
    scenario: Scenario, robot: NewRobot, task: NewTask, folder: str | Path | None
) -> str:
    """The text of a new scenario.

    Args:
        scenario: The scenario, completed.
        robot: Its robot, with remarks.
        task: Its task.
        folder: The folder in which it will be saved, if it is known.
    """
    data = {"duration": scenario.duration, **scenario_data(scenario)}
    if folder is not None:
        file, saved = Path(data["robot"]["file"]), os.path.realpath(folder)
        if file.is_relative_to(saved):
            data["robot"]["file"] = file.relative_to(saved).as_posix()
    return "\n".join(_lines(data, robot, task)) + "\n"


def _lines(data: Mapping[str, Any], robot: NewRobot, task: NewTask) -> Iterator[str]:
    yield "# Written by `drake-dae new`, to be changed. Units: m, rad, s, N, N m."
    yield "# `drake-dae analyze FILE` reports the margins to limits and singularities,"
    yield "# `drake-dae simulate FILE` runs it, and with --meshcat it is seen in a browser."
    yield f"description: {_flow(data['description'])}"
    yield "robot:"
    yield f"  file: {_flow(data['robot']['file'])}"
    for key in ("packages", "base", "locked", "actuators", "leave_out"):
        if value := data["robot"].get(key):
            yield from _with_reason(f"  {key}: {_flow(_short(value))}", robot.remarks[key])
    yield "constraints:"
    yield f"- name: {_flow(task.name)}"
    yield from _with_reason(f"  frame: {_flow(robot.tip)}", robot.remarks["tip"])
    if any(robot.point):
        yield from _with_reason(f"  point: {_flow(list(robot.point))}", robot.remarks["point"])
    (constraint,) = data["constraints"]
    free = (
        f"where {task.place.directions} directions of motion are free of each other by "
        f"{task.place.quality:.2g}: 1 is best, 0 singular"
    )
    yield from _with_reason(f"  surface: {_flow(_short(constraint['surface']))}", free)
    singular = robot.remarks.get("outputs")
    yield from _with_reason("outputs:", singular) if singular else ["outputs:"]
    for output in data["outputs"]:
        yield from _with_reason(f"- {_flow(_short(output))}", _WHY[output[TAG]])
    if "tool_axis" in data:
        fixed = "to keep it normal to a surface that bends would hinder the way along"
        yield from _with_reason(f"tool_axis: {data['tool_axis']}", fixed)
    (pole,) = data["law"]["gains"]["all"]
    fading = f"1/s; after {-6 / pole:.2g} s less than a fiftieth of an error is left"
    yield from _with_reason(f"law: {{gains: {{all: [{pole}]}}}}", fading)
    yield "references:"
    (along, path), (pressing, force), *constant = data["references"].items()
    speed = 2 * pi * task.radius / task.period
    yield from _with_reason(
        f"  {_flow(along)}: {_flow({key: path[key] for key in path if key in _PATH})}",
        f"a {task.path} of {task.radius:g} m in {task.period:g} s: at {speed:.2g} m/s joints stay "
        "below their speed limits",
    )
    least = "N: no more than 20, and than a sixth of what effort limits allow there"
    yield from _with_reason(f"  {_flow(pressing)}: {_flow(force)}", least)
    for name, value in constant:
        yield from _with_reason(f"  {_flow(name)}: {_flow(value)}", "held at what it starts with")
    yield "start:"
    positions = f"  positions: {_flow(data['start']['positions'])}"
    yield from _with_reason(positions, "by inverse kinematics from the references' first values")
    yield from _with_reason(f"duration: {_flow(data['duration'])}", "s, two rounds")
    accuracy = data["integrator"]["accuracy"]
    yield from _with_reason(f"integrator: {{accuracy: {accuracy:.1e}}}", "relative, of each step")


def _with_reason(line: str, why: str) -> Iterator[str]:
    """A line with its reason, which is written above if both are long."""
    if len(line) + len(why) + 4 <= _WIDTH:
        yield f"{line}  # {why}"
        return
    indent = " " * (len(line) - len(line.lstrip()))
    yield f"{indent}# {why}"
    yield from wrap(line, _WIDTH, subsequent_indent=f"{indent}    ", **_WHOLE)


def _short(value: Any) -> Any:
    """Data without keys that have their default values."""
    if not isinstance(value, Mapping):
        return value
    defaults: tuple[Any, ...] = ("", [], {}, None, [0.0, 0.0, 0.0], [0.0])
    entries = {key: _short(inner) for key, inner in value.items()}
    return {key: v for key, v in entries.items() if v is not False and v not in defaults}


def _flow(value: Any) -> str:
    """Data in one line."""
    if isinstance(value, Mapping):
        inner = ", ".join(f"{_flow(k)}: {_flow(v)}" for k, v in value.items() if k != TAG)
        tag = f"{value[TAG]} " if TAG in value else ""
        return f"{tag}{{{inner}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_flow, value))}]"
    if isinstance(value, str):
        is_plain = _PLAIN.fullmatch(value) and value.lower() not in _WORDS
        return value if is_plain else json.dumps(value, ensure_ascii=False)
    return json.dumps(value)
