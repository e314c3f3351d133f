"""A run of a robot, replayed in Meshcat as one HTML page."""

import html
import json
import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat, MeshcatAnimation, Rgba, SceneGraph, Sphere
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError
from drake_dae.pictures.arrows import LEAST_SCALE, PATH_COLOR, path_of
from drake_dae.pictures.run_motion import RunMotion, ShownLoop, follow, run_extent
from drake_dae.pictures.surroundings import scene_extent, surroundings
from drake_dae.pictures.view import (
    FRAME_RATE,
    draw_scene,
    draw_surroundings,
    look_at,
    start_meshcat,
    view_of_links,
)
from drake_dae.robots.constraint_wrenches import ConstraintWrenches
from drake_dae.simulation.records.phases import PhaseSpan, phase_spans
from drake_dae.simulation.records.record import Record

_DESIRED = Rgba(0.1, 0.6, 0.2, 1.0)

_FLASH = Rgba(1.0, 0.75, 0.1, 0.6)

_FOREVER = 2**31 - 1
"""The number of repetitions of the animation."""

_SIDES = 6
"""The sides of a line drawn as a tube, since lines of a browser are one pixel wide."""

_OVERLAY = Path(__file__).with_name("overlay.html")


class AnimationPage(str):
    """The HTML page of an animation, as text; a notebook shows it in its place."""

    def _repr_html_(self) -> str:
        page = html.escape(str(self), quote=True)
        return f'<iframe srcdoc="{page}" style="width: 100%; height: 500px; border: 0"></iframe>'


@checked(ModelError)
def make_animation(
    loop: ShownLoop, record: Record, context: Context, title: str = ""
) -> AnimationPage:
    """Replays a record of a robot in Meshcat, with the paths of its constrained points.

    The page shows the clock and the size of each constraint force at its arrow, draws the actual
    path over the desired one, and repeats. An impact flashes; an open contact has no arrow.

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
    return animate(follow(loop, record, context), loop.scene_graph, title, phase_spans(record))


def animate(
    course: RunMotion,
    scene_graph: SceneGraph | None,
    title: str = "",
    phases: Sequence[PhaseSpan] = (),
) -> AnimationPage:
    """The page of `make_animation`.

    Args:
        course: The motion of the robot.
        scene_graph: The geometry of the robot, or None.
        title: The title of the page; the robot's name if empty.
        phases: The phases of a task, shown beside the clock.
    """
    # A separate server, made only now: other runs do not open a port.
    with _quiet():
        meshcat = start_meshcat()
    plant, acting = course.plant, course.acting
    model = course.model
    arrows = draw_scene(plant, meshcat, scene_graph)
    links = view_of_links(plant, scene_graph, meshcat)
    arrows.measure(course.wrenches)

    # The static parts: surfaces, actual paths and desired paths.
    _, size = scene_extent(model, acting, course.states[0], scene_graph)
    seen = surroundings(model, acting, course.points, course.parameters[0], size)
    draw_surroundings(meshcat, seen)
    look_at(meshcat, *run_extent(course, scene_graph))
    _draw_paths(meshcat, acting, course.points, "actual", PATH_COLOR, 0.003 * size)
    _draw_paths(meshcat, acting, course.wanted_points, "desired", _DESIRED, 0.0015 * size)

    # The moving parts: links and arrows, frame by frame.
    replay = links.CreateDefaultContext() if links is not None else None
    meshcat.StartRecording(frames_per_second=FRAME_RATE)
    rows = zip(
        course.times, course.states, course.wrenches, course.parameters, course.flashes, strict=True
    )
    flashing = _add_flashes(meshcat, course, 0.05 * size)
    for time, state, wrench, own, bright in rows:
        if links is not None and replay is not None:
            replay.SetTime(time)
            link_state = links.get_input_port()
            link_state.FixValue(replay, state[: link_state.size()])
            links.ForcedPublish(replay)
        arrows.draw(wrench, time)
        arrows.place(own, time)
        for row, path in flashing.items():
            meshcat.SetTransform(path, RigidTransform(wrench.points[row]), time)
            meshcat.SetProperty(f"{path}/ball", "scale", [max(bright[row], LEAST_SCALE)] * 3, time)
    meshcat.StopRecording()
    recording = meshcat.get_mutable_recording()
    recording.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
    recording.set_repetitions(_FOREVER)
    meshcat.PublishRecording()
    name = title or model.dae.name
    return AnimationPage(_with_overlay(meshcat.StaticHtml(), course, name, phases))


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


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppresses Drake's message about the address of a server that is not for users."""
    log = logging.getLogger("drake")
    level = log.level
    log.setLevel(logging.WARNING)
    try:
        yield
    finally:
        log.setLevel(level)


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


def _with_overlay(page: str, course: RunMotion, title: str, phases: Sequence[PhaseSpan]) -> str:
    """Meshcat's page with a title, the clock, the sizes of the forces, and paths that grow."""
    constraints = course.acting.constraints
    sizes = np.linalg.norm([wrench.forces for wrench in course.wrenches], axis=2)
    data = {
        "title": title,
        "rate": FRAME_RATE,
        "start": course.start_time,
        "end": course.start_time + float(course.times[-1]),
        "indices": 6 * _SIDES,
        "forces": [
            {
                "name": constraint.name,
                "path": path_of(constraint, "force").strip("/").split("/"),
                "values": [float(f"{value:.4g}") for value in sizes[:, row]],
            }
            for row, constraint in enumerate(constraints)
        ],
        "impacts": bool(course.flashes.any()),
        "phases": [[span.begin, span.name] for span in phases],
        "paths": [["paths", constraint.name, "actual"] for constraint in constraints],
    }
    # A name may contain text that ends a script.
    text = json.dumps(data).replace("<", "\\u003c")
    overlay = _OVERLAY.read_text("utf-8").replace('"DATA"', text)
    name = html.escape(title)
    page = re.sub(r"<title>.*?</title>", lambda _: f"<title>{name}</title>", page, count=1)
    head, end, tail = page.rpartition("</body>")
    return f"{head}{overlay}{end}{tail}" if end else page + overlay
