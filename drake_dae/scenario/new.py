"""Makes a scenario for a robot from nothing but its file."""

import os
from collections.abc import Callable, Sequence
from itertools import product
from math import ceil, log10, pi
from pathlib import Path
from time import process_time
from typing import Literal, NamedTuple

import casadi as ca
import numpy as np
from pydrake.geometry import SceneGraph

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.errors import DrakeDaeError, ScenarioError
from drake_dae.references import CircleReference, Reference, SinusoidReference
from drake_dae.robots import (
    ConstraintSet,
    Cylinder,
    MultibodyExpressions,
    Plane,
    PointOnSurface,
    Sphere,
    Surface,
    Vector,
)
from drake_dae.scenario.chain import far_end, read_working, rounded, working_chain
from drake_dae.scenario.form import at, dump_yaml
from drake_dae.scenario.model import NOTHING_FOUND, completed_model
from drake_dae.scenario.parts import Start
from drake_dae.scenario.postures import Posture, Postures, tool_axis
from drake_dae.scenario.robot_file.reading import robot_links
from drake_dae.scenario.robot_file.robot import Robot
from drake_dae.scenario.scenario import Scenario, scenario_data

SurfaceKind = Literal["plane", "cylinder", "sphere"]

# Walls around, a table, and a ceiling: axis of the normal, its sign, and the preference.
_WALLS = (0, -1.0, 0.8), (0, 1.0, 0.6), (1, -1.0, 0.7), (1, 1.0, 0.6)
_NORMALS = (*_WALLS, (2, 1.0, 1.0), (2, -1.0, 0.4))

_TRIES, _SLANTED = 40, 0.3
"""The postures that are tried for each normal; the weight of one with the tool not along it."""

_ENOUGH = 0.6
"""The friction below which a contact does not jam along the path at a place that is good enough."""

_SHARE = 0.3
"""The share of speed limits that a path may use; half of it of effort limits by the force."""

_RADIUS, _BEND, _FORCE, _SHORTEST = 0.08, 0.4, 20.0, 5.0
"""The radii of the circle and of a curved surface, relative to the robot's size; the largest force,
N; and the shortest period, s."""

_FRACTIONS, _PLACES, _SECONDS = (1.0, 0.5, 0.2), 4, 15.0
"""The fractions of the usual circle and force that are tried, each at so many places; the processor
time in s after which no further place is tried."""


@checked(lambda text: ScenarioError(("", text)))
def new_scenario(
    file: str,
    surface: SurfaceKind = "plane",
    tip: str = "",
    point: Vector = (0.0, 0.0, 0.0),
    folder: str | Path | None = None,
    progress: Callable[[str], object] = lambda text: None,
) -> tuple[Scenario, str]:
    """Makes a scenario in which a robot presses on a surface and moves in a circle on it.

    The base is the free root body of the file. The working chain is the longest one without mimic
    joints, grippers and wheels, or the one that ends at `tip`; all other joints are locked. If the
    last joint of a short chain does not move the tip, the far end of its link is the tip. The
    surface is where the tip reaches it with its axis along the normal, and the directions of the
    task are most independent. Circle and force keep a margin to the limits of the joints.

    Args:
        file: The robot's file, as a scenario has it.
        surface: The surface: "plane", "cylinder" or "sphere".
        tip: The frame in contact; found if empty.
        point: The point in that frame, m, shape (3,).
        folder: Where the text will be saved: a robot's file below it gets a name relative to it.
            Without one the name is absolute.
        progress: Called with a phrase on each step.

    Returns:
        The scenario, in whose way `complete_scenario` finds nothing, and its text with a comment on
        each choice, which `load_scenario` reads back equal.

    Raises:
        ScenarioError: The file cannot be read or has no such tip, or no place is reached; the
            message lists the places that were tried.
    """
    progress("reading the robot")
    end = process_time() + _SECONDS
    is_url = file.startswith("package://")
    with at("robot.file"):
        plant, robot = read_working(file if is_url or not file else os.path.realpath(file))
        robot, tip, chain, why = working_chain(plant, robot, tip)
    read = robot_links(robot, SceneGraph(), drawn=False)
    links, tried = read[0], list[str]()
    if not any(point) and (far := far_end(links, tip, chain)):
        point, why["point"] = far, "m, in that frame: its far end, where no frame of the file is"
    progress("looking for a place")
    found = list[tuple[float, Scenario, str]]()
    places = _places(links, tip, point)[:_PLACES]
    for count, (fraction, place) in enumerate(product(_FRACTIONS, places)):
        # Near a singular wrist little friction jams a contact: the next place may be better.
        is_done = found and (found[-1][0] >= _ENOUGH or count % len(places) == 0)
        if is_done or ((found or tried) and process_time() > end):
            break
        scenario = _scenario(robot, tip, point, place, surface, fraction)
        name = f"{scenario.constraints[0].name} at {place.center} m"
        progress(f"trying a {name}")
        try:
            completed = completed_model(scenario, None, robot=read)[0]
            problem = next((n for n in completed.notes if n.startswith(NOTHING_FOUND)), "")
        except DrakeDaeError as error:
            problem = str(error)
        if problem:
            tried.append(f"{name}, {fraction:g} of the usual circle: {problem[:160]}")
        else:
            found.append((completed.critical_friction, scenario, place.why))
    if found:
        _, scenario, why["surface"] = max(found, key=lambda entry: entry[0])
        return scenario, _text(scenario, why, folder)
    joints = ", ".join(signal.name for signal in links.position_signals)
    where = "; ".join(tried[:_PLACES]) or "surfaces along all axes of the world"
    text = (
        f"no place was found where the joints of '{tip}' ({joints}) move it along a {surface}. "
        f"Tried: {where}. Give another tip, as --tip LINK:x,y,z, or copy a shipped scenario"
    )
    raise ScenarioError(("robot.file", text))


class _Place(NamedTuple):
    """A place for a surface, where the tip can move along the axes `ways` of the world."""

    center: Vector  # m
    normal: Vector
    ways: Sequence[int]
    positions: dict[str, float]  # Of the joints, in m and rad.
    why: str
    speed: float  # The largest one within the limits of joints, m/s.
    force: float  # Likewise, N.
    size: float  # Of the robot, m.
    digits: int  # Of places in m, as they are written.


def _places(links: MultibodyExpressions, tip: str, point: Vector) -> list[_Place]:
    """The best place of a surface for each direction of its normal, the best place first.

    Each is the best of some postures, if possible with the tool normal to the surface. A posture is
    good if the task's directions are independent, joints are away from their limits, all bodies are
    on the free side, the base is beside the tip, and gravity takes less than half of the torques.
    """
    touch = PointOnSurface(tip, Plane((0, 0, 0), (0, 0, 1)), point).touch(links)
    column, sign_out = tool_axis(links, touch)
    R, place = links.rotation(tip), links.position(tip, point)
    # The tip's position, and of each axis of the world the two components across the tool.
    across = [k for k in range(3) if k != column]
    rows = ca.vertcat(place, *[R[k, across].T for k in range(3)])
    postures = Postures(links, ConstraintSet(()), rows, ca.SX(0, 0), [], {})
    bodies = ca.horzsplit(links.landmarks())
    moving = [place, *(body for body in bodies if ca.depends_on(body, links.q))]
    still = [body for body in bodies if not ca.depends_on(body, links.q)]
    weight = ca.substitute(links.bias, links.v, ca.SX.zeros(links.v.numel()))
    parameters = ca.vertcat(*[p.symbol for p in links.parameters])
    outputs = [sign_out * R[:, column], ca.horzcat(*moving), ca.horzcat(*still), weight]
    function = ca.Function("places", [links.q, parameters], outputs)
    values = np.concatenate([p.value for p in links.parameters])
    speeds, efforts = links.velocity_limits[1], np.full(links.v.numel(), np.inf)
    speeds = np.where(np.isfinite(speeds) & (speeds > 0.0), speeds, np.inf)
    efforts[np.argmax(np.abs(links.actuation_matrix), axis=0)] = links.effort_limits
    efforts = np.where(efforts > 0.0, efforts, np.inf)
    guesses, size = postures.guesses(_TRIES), postures.size
    digits = 2 if size > 0.3 else 3

    def seen(q: FloatArray, factor: float) -> tuple[Posture, list[FloatArray], float]:
        return postures.at(q), [value.full() for value in function(q, values)], factor

    slanted, choices = [seen(guess, _SLANTED) for guess in guesses], []
    for axis in range(3):  # A planar robot cannot turn its tool along some axes.
        tilts = [3 + 2 * axis, 4 + 2 * axis]
        solved = (postures.solve(tilts, np.zeros(2), guess) for guess in guesses)
        choices.append([*(seen(q, 1.0) for q in solved if q is not None), *slanted])
    found = list[tuple[float, _Place]]()
    for axis, sign, preference in _NORMALS:
        ways, score, rows_at = [k for k in range(3) if k != axis], 0.0, list[int]()
        for posture, (outward, moved, base, gravity), factor in choices[axis]:
            at_tip, roots = posture.rows[:3], base.mean(axis=1)
            disadvantages = (
                np.min(sign * (moved[axis] - at_tip[axis])) < -0.02 * size,
                sign * outward[axis, 0] > -0.5,
                # A table may be as high as the base; a wall must not cut it.
                axis != 2 and sign * (roots[axis] - at_tip[axis]) < 0.1 * size,
                axis == 2 and np.linalg.norm((at_tip - roots)[:2]) < 0.2 * size,
                np.any(np.abs(gravity[:, 0]) > 0.5 * efforts),
            )
            factor *= postures.margin(posture.q) * 0.1 ** sum(map(bool, disadvantages))
            if factor * 5 <= score:
                continue  # No independence is above 1.
            tilts = [3 + 2 * axis, 4 + 2 * axis]
            chosen = posture.independent([], [axis, *ways, *tilts], posture.q.size)
            quality = factor * posture.independence(chosen) * len(chosen)
            if axis in chosen and {*chosen} & {*ways} and quality > score:
                score, best, rows_at = quality, posture, chosen
        if not rows_at:
            continue
        free = [row for row in rows_at if row in ways]
        inverse = np.linalg.pinv(best.gradients[rows_at])[:, 1 : 1 + len(free)]
        speed = _SHARE / np.max(np.abs(inverse) / speeds[:, None], initial=1e-9)
        force = _SHARE / 2 / np.max(np.abs(best.gradients[axis]) / efforts, initial=1e-9)
        count, share = len(rows_at), score / len(rows_at)
        why = (
            f"where {count} directions of motion are free of each other there by {share:.2g} "
            "(1 is best, 0 singular)"
        )
        names = (signal.name for signal in links.position_signals)
        near = dict(zip(names, (np.round(best.q, 4) + 0.0).tolist(), strict=True))
        center, normal = rounded(best.rows[:3], digits), rounded(sign * np.eye(3)[axis], 0)
        placed = _Place(center, normal, free, near, why, speed, force, size, digits)
        found.append((score * preference, placed))
    return [placed for _, placed in sorted(found, key=lambda entry: -entry[0])]


def _scenario(
    robot: Robot, tip: str, point: Vector, place: _Place, kind: SurfaceKind, fraction: float
) -> Scenario:
    """A circle at a place, or a line, with a fraction of the usual radius and force."""
    center, normal, ways = place.center, np.array(place.normal), place.ways
    radius = _round_number(fraction * _RADIUS * place.size)
    period = max(_SHORTEST, float(ceil(2 * pi * radius / place.speed)))
    axis, bend = int(np.argmax(np.abs(normal))), float(np.round(_BEND * place.size, place.digits))
    middle = rounded(center - bend * normal, place.digits)
    # A planar robot moves around the cylinder, others also along it.
    along = np.eye(3)[ways[-1] if len(ways) > 1 else 3 - axis - ways[0]].tolist()
    flat = ("ceiling" if normal[2] < 0.0 else "table") if axis == 2 else "wall"
    surfaces: dict[str, tuple[str, Surface]] = {
        "plane": (flat, Plane(center, place.normal)),
        "sphere": ("ball", Sphere(middle, bend)),
        "cylinder": ("pipe", Cylinder(middle, along, bend)),
    }
    name, surface = surfaces[kind]
    shape, begin = "line", [center[way] for way in ways]
    path: Reference = SinusoidReference(begin[0], [radius], [round(2 * pi / period, 4)])
    if len(ways) > 1:
        shape, path = "circle", CircleReference(begin, radius, period=period)
    return Scenario(
        description=(
            f"{Path(robot.file).name.split('.')[0]} draws a {shape} on a {name} and presses on it"
        ),
        robot=robot,
        constraints=[PointOnSurface(tip, surface, point, name)],
        # On a strongly curved surface an axis fixed to the normal hinders motion along it.
        tool_axis="normal" if kind == "plane" else "fixed",
        references={
            f"{tip}.{''.join('xyz'[way] for way in ways)}": path,
            f"{name}.force": _round_number(fraction * min(_FORCE, place.force)),
        },
        start=Start(positions=place.positions),
        duration=2 * period,
    )


def _round_number(value: float) -> float:
    """The largest of 1, 2, 3, 5, 8 times a power of ten that is not above a value."""
    power = 10.0 ** int(np.floor(log10(value)))
    return max(float(f"{k * power:.3g}") for k in (1, 2, 3, 5, 8) if k * power <= value * 1.001)


def _text(scenario: Scenario, why: dict[str, str], folder: str | Path | None) -> str:
    """The text of a new scenario, with a comment on each choice."""
    data = {**scenario_data(scenario), "duration": scenario.duration}
    file = Path(data["robot"]["file"])
    if folder is not None and file.is_relative_to(saved := os.path.realpath(folder)):
        data["robot"]["file"] = file.relative_to(saved).as_posix()
    why = {
        "packages": "where package://<name>/ leads",
        "leave_out": "what no equation has",
        "base": "nothing holds it",
        "actuators": "that are not locked",
        "locked": "m or rad; all that is not of the chain, or mimics",
        **why,
        "tool_axis": "kept where it starts",
        "positions": "near there, in rad or m",
        "duration": "s, two rounds",
        f"{scenario.constraints[0].name}.force": "N, at most 20, and a sixth of what efforts allow",
    }
    lines = [
        "# Written by `drake-dae new`, to be changed. Units: m, rad, s, N, N m.",
        "# Outputs beside the tool's path, gains (poles at -4 1/s) and an exact start are added by",
        "# `drake-dae simulate FILE`; --meshcat shows it. `drake-dae analyze FILE` tells margins.",
    ]
    for line in dump_yaml(data).splitlines():
        note = why.get(line.strip().removeprefix("- ").partition(":")[0], "")
        if len(line) + len(note) < 97:
            lines.append(f"{line}  # {note}" if note else line)
        else:
            indent = line[: len(line) - len(line.lstrip(" "))]
            lines += [f"{indent}# {note}", line] if note else [line]
    return "\n".join(lines) + "\n"
