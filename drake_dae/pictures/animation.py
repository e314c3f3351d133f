"""A run of a robot, replayed in Meshcat as one HTML page."""

import html
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat, MeshcatAnimation, MeshcatCone, Rgba, SceneGraph, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError
from drake_dae.pictures.inline import InlinePage
from drake_dae.pictures.moments import RunEvent, RunEventKind, moments_of, ordered
from drake_dae.pictures.scene.arrows import (
    FORCE_COLOR,
    LEAST_SCALE,
    MOMENT_COLOR,
    PATH_COLOR,
    ForceArrows,
    path_of,
)
from drake_dae.pictures.scene.floor import Floor, floor_below
from drake_dae.pictures.scene.framing import ViewAngles
from drake_dae.pictures.scene.friction import DrawnFrictionCone, friction_cones, slips
from drake_dae.pictures.scene.run_motion import (
    RunMotion,
    ShownLoop,
    follow,
    run_points,
    run_view,
)
from drake_dae.pictures.scene.surroundings import scene_extent, surroundings
from drake_dae.pictures.scene.view import (
    ARROW,
    ASPECT,
    CAMERA_ANGLE,
    FRAME_RATE,
    PIECE,
    draw_floor,
    draw_scene,
    draw_surroundings,
    look_at,
    start_unwatched_meshcat,
    view_of_links,
)
from drake_dae.robots.constraint_wrenches import ConstraintWrenches
from drake_dae.robots.constraints.constraint import Constraint
from drake_dae.robots.surfaces.surface import axes_along
from drake_dae.simulation.records.phases import PhaseSpan, phase_spans
from drake_dae.simulation.records.record import Record
from drake_dae.simulation.summary import Limits

_DESIRED = Rgba(0.1, 0.6, 0.2, 1.0)
_FLASH = Rgba(1.0, 0.75, 0.1, 0.6)
_CONE = Rgba(0.95, 0.6, 0.15, 0.35)

_FOREVER = 2**31 - 1
"""The number of repetitions of the animation."""

_SIDES = 6
"""The sides of a line drawn as a tube, since lines of a browser are one pixel wide."""

_OVERLAY = Path(__file__).with_name("overlay.html")


@checked(ModelError)
def make_animation(
    loop: ShownLoop, record: Record, context: Context, title: str = ""
) -> InlinePage:
    """Replays a record of a robot in Meshcat, with the paths of its constrained points.

    The page shows the clock and the size of each constraint force at its arrow, draws the actual
    path over the desired one, and repeats. A bar below has the phases of a task and marks of what
    happens, and moves the run to any time; the address "page.html#t=2.5" shows that moment. An
    impact flashes; an open contact has no arrow; a contact with friction has its cone.

    Args:
        loop: A loop of a `RobotPlant`.
        record: The record of a run of this loop.
        context: The context of its diagram, for the parameters; not changed.
        title: The title of the page; the robot's name if empty.

    Returns:
        One HTML page that holds the scene and the animation, as text. In a notebook it shows
        itself.

    Raises:
        ModelError: There is no robot.
    """
    course = follow(loop, record, context)
    moments = [*moments_of(record, Limits.of(course.model)), *slips(course)]
    return animate(course, loop.scene_graph, title, phase_spans(record), ordered(record, moments))


def animate(
    course: RunMotion,
    scene_graph: SceneGraph | None,
    title: str = "",
    phases: Sequence[PhaseSpan] = (),
    moments: Sequence[RunEvent] = (),
) -> InlinePage:
    """The page of `make_animation`.

    Args:
        course: The motion of the robot.
        scene_graph: The geometry of the robot, or None.
        title: The title of the page; the robot's name if empty.
        phases: The phases of a task, shown beside the clock.
        moments: What happens in the run, marked on the bar of time.
    """
    # A separate server, made only now: other runs do not open a port.
    meshcat = start_unwatched_meshcat()
    plant, acting = course.plant, course.acting
    model = course.model
    arrows = draw_scene(plant, meshcat, scene_graph)
    links = view_of_links(plant, scene_graph, meshcat)
    arrows.measure(course.wrenches)

    # The static parts: surfaces, floor, actual paths and desired paths.
    _, size = scene_extent(model, acting, course.states[0], scene_graph)
    touched = surroundings(model, acting, course.points, course.parameters[0], PIECE * size)
    draw_surroundings(meshcat, touched)
    seen = run_points(course, scene_graph)
    floor = floor_below(seen, touched)
    draw_floor(meshcat, floor)
    view = ViewAngles.of(CAMERA_ANGLE, ASPECT)
    look_at(meshcat, *run_view(course, scene_graph, view, ARROW * size))
    _draw_paths(meshcat, acting, course.points, "actual", PATH_COLOR, 0.003 * size)
    _draw_paths(meshcat, acting, course.wanted_points, "desired", _DESIRED, 0.0015 * size)

    # The moving parts: links and arrows, frame by frame.
    replay = links.CreateDefaultContext() if links is not None else None
    cones = friction_cones(course)
    for cone in cones:
        _add_cone(meshcat, acting.constraints[cone.row], cone, 0.5 * ARROW * size)
    meshcat.StartRecording(frames_per_second=FRAME_RATE)
    flashing = _add_flashes(meshcat, course, 0.05 * size)
    for number, time in enumerate(course.times):
        state, wrench = course.states[number], course.wrenches[number]
        if links is not None and replay is not None:
            replay.SetTime(time)
            link_state = links.get_input_port()
            link_state.FixValue(replay, state[: link_state.size()])
            links.ForcedPublish(replay)
        arrows.draw(wrench, time)
        arrows.place(course.parameters[number], time)
        for cone in cones:
            # It encloses the arrow, which ends at the contact.
            turned = RotationMatrix(axes_along(-cone.normals[number]))
            path = path_of(acting.constraints[cone.row], "cone")
            meshcat.SetTransform(path, RigidTransform(turned, wrench.points[cone.row]), time)
            is_there = 1.0 if wrench.forces[cone.row].any() else LEAST_SCALE
            meshcat.SetProperty(f"{path}/form", "scale", [is_there] * 3, time)
        for row, path in flashing.items():
            meshcat.SetTransform(path, RigidTransform(wrench.points[row]), time)
            bright = max(course.flashes[number, row], LEAST_SCALE)
            meshcat.SetProperty(f"{path}/ball", "scale", [bright] * 3, time)
    meshcat.StopRecording()
    recording = meshcat.get_mutable_recording()
    recording.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
    recording.set_repetitions(_FOREVER)
    meshcat.PublishRecording()
    said = {
        "title": title or model.dae.name,
        "legend": [*_legend(course, arrows, cones, floor), *_marks(moments)],
        "phases": [[span.begin, span.name] for span in phases],
        "moments": [[one.time, one.kind.color, one.text] for one in moments],
    }
    return InlinePage(_with_overlay(meshcat.StaticHtml(), course, said))


def _legend(
    course: RunMotion, arrows: ForceArrows, cones: Sequence[DrawnFrictionCone], floor: Floor
) -> list[tuple[str, str]]:
    """The color and the meaning of all that is drawn besides the robot."""
    found = []
    if course.acting.constraints:
        # Lines in a legend, in the order of what one looks for.
        found += [(_hex(PATH_COLOR), "path"), (_hex(_DESIRED), "desired path")]
        longest = f"constraint force, the longest {arrows.largest_force:.3g} N"
        found.append((_hex(FORCE_COLOR), longest))
    if arrows.has_moment:
        longest = f"moment, the longest {arrows.largest_moment:.3g} N m"
        found.append((_hex(MOMENT_COLOR), longest))
    if cones:
        numbers = sorted({f"{cone.coefficient:.3g}" for cone in cones})
        found.append((_hex(_CONE), f"friction cone, coefficient {' and '.join(numbers)}"))
    return [*found, ("#bbbbbb", f"grid of {floor.cell:g} m")]


def _marks(moments: Sequence[RunEvent]) -> list[tuple[str, str]]:
    """The color and the meaning of each kind of mark."""
    return [
        (kind.color, kind.label)
        for kind in RunEventKind
        if any(one.kind is kind for one in moments)
    ]


def _hex(color: Rgba) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in (color.r(), color.g(), color.b()))


def _add_cone(
    meshcat: Meshcat, constraint: Constraint, cone: DrawnFrictionCone, side: float
) -> None:
    """Adds the friction cone of a contact, with a side of that length; its tip is the origin."""
    angle = np.arctan(cone.coefficient)
    radius = side * np.sin(angle)
    shape = MeshcatCone(side * np.cos(angle), radius, radius)
    meshcat.SetObject(f"{path_of(constraint, 'cone')}/form", shape, _CONE)


def _add_flashes(meshcat: Meshcat, course: RunMotion, radius: float) -> dict[int, str]:
    """Adds a ball for each constraint with impacts, which shows them; row -> path."""
    paths = {
        row: path_of(constraint, "impact")
        for row, constraint in enumerate(course.acting.constraints)
        if course.flashes[:, row].any()
    }
    for path in paths.values():
        meshcat.SetObject(f"{path}/ball", Sphere(radius), _FLASH)
    return paths


def _draw_paths(
    meshcat: Meshcat,
    wrenches: ConstraintWrenches,
    points: FloatArray,
    kind: str,
    color: Rgba,
    radius: float,
) -> None:
    """A line through the points of each constraint, m, shape (frames, constraints, 3)."""
    for number, constraint in enumerate(wrenches.constraints):
        line = points[:, number]
        if len(line) > 1:
            vertices, faces = _tube(line, radius)
            meshcat.SetTriangleMesh(
                f"/paths/{constraint.name}/{kind}",
                np.asfortranarray(vertices.T),
                np.asfortranarray(faces.T),
                color,
            )


def _tube(points: FloatArray, radius: float) -> tuple[FloatArray, np.ndarray]:
    """A thin tube around a line through points, m, shape (k, 3).

    Returns:
        Its vertices, a ring of `_SIDES` around each point after the other, and its triangles, all
        of a piece of the line before those of the next.
    """
    along = np.gradient(points, axis=0)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.where(length > 0.0, along / np.where(length > 0.0, length, 1.0), [0.0, 0.0, 1.0])
    # Two directions normal to the line.
    aside = np.where(np.abs(along[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    first = np.cross(along, aside)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    across = np.stack([first, np.cross(along, first)], axis=1)
    turn = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    rings = points[:, None] + radius * np.column_stack([np.cos(turn), np.sin(turn)]) @ across
    near = np.arange(_SIDES)
    far = np.roll(near, -1)
    piece = np.vstack(
        [
            np.column_stack([near, far, near + _SIDES]),
            np.column_stack([far, far + _SIDES, near + _SIDES]),
        ]
    )
    faces = piece + _SIDES * np.arange(len(points) - 1)[:, None, None]
    return rings.reshape(-1, 3), faces.reshape(-1, 3)


def _with_overlay(page: str, course: RunMotion, said: dict[str, Any]) -> str:
    """Meshcat's page with what is said of the run, the sizes of the forces, and growing paths."""
    constraints = course.acting.constraints
    sizes = np.linalg.norm([wrench.forces for wrench in course.wrenches], axis=2)
    data = {
        **said,
        "rate": FRAME_RATE,
        "start": course.start_time,
        "end": course.start_time + float(course.times[-1]),
        "aspect": ASPECT,
        "indices": 6 * _SIDES,
        "forces": [
            {
                "name": constraint.name,
                "path": path_of(constraint, "force").strip("/").split("/"),
                "values": [float(f"{value:.4g}") for value in sizes[:, row]],
            }
            for row, constraint in enumerate(constraints)
        ],
        "paths": [["paths", constraint.name, "actual"] for constraint in constraints],
    }
    # A name may contain text that ends a script.
    text = json.dumps(data).replace("<", "\\u003c")
    overlay = _OVERLAY.read_text("utf-8").replace('"DATA"', text)
    name = html.escape(said["title"])
    page = re.sub(r"<title>.*?</title>", lambda _: f"<title>{name}</title>", page, count=1)
    head, end, tail = page.rpartition("</body>")
    return f"{head}{overlay}{end}{tail}" if end else page + overlay
