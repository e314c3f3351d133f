"""The animation of a run of a robot in Meshcat, as one HTML page."""

import html
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat, MeshcatAnimation, MeshcatCone, Rgba, SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.diagrams.record import Record
from drake_dae.errors import ModelError
from drake_dae.pictures.friction import DrawnFrictionCone, friction_cones, slips
from drake_dae.pictures.moments import RunEvent, event_kinds, events_of, sorted_events
from drake_dae.pictures.run_motion import (
    RunMotion,
    ShownLoop,
    follow,
    run_points,
    run_view,
)
from drake_dae.robots import Constraint, ConstraintWrenches, axes_along
from drake_dae.running.limits import robot_limits
from drake_dae.running.phases import PhaseSpan, phase_spans
from drake_dae.scene.arrows import (
    FORCE_COLOR,
    LEAST_SCALE,
    MOMENT_COLOR,
    PATH_COLOR,
    ForceArrows,
    path_of,
)
from drake_dae.scene.floor import Floor, floor_below
from drake_dae.scene.framing import ViewAngles
from drake_dae.scene.surroundings import scene_extent, surroundings
from drake_dae.scene.view import (
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

_DESIRED = Rgba(0.1, 0.6, 0.2, 1.0)
_CONE = Rgba(0.95, 0.6, 0.15, 0.35)

_FOREVER = 2**31 - 1
"""The number of repetitions of the animation."""

_SIDES = 6
"""The number of sides of the tube that draws a path; browsers draw lines one pixel wide."""

_OVERLAY = Path(__file__).with_name("overlay.html")


class InlinePage(str):
    """An HTML page as text; a notebook displays it in a frame."""

    def _repr_html_(self) -> str:
        page = html.escape(str(self), quote=True)
        return f'<iframe srcdoc="{page}" style="width: 100%; height: 600px; border: 0"></iframe>'


@checked(ModelError)
def make_animation(
    loop: ShownLoop, record: Record, context: Context, title: str = ""
) -> InlinePage:
    """Returns an animation of a recorded run in Meshcat, with the paths of the contact points.

    The page shows the time, the constraint forces as arrows with their sizes, and the actual path
    over the desired one; it repeats the run. A time bar shows the phases of a task and the events
    of the run, and jumps to any time; the address "page.html#t=2.5" shows the run at 2.5 s. An
    open contact has no arrow. A contact with friction has a friction cone.

    Args:
        loop: A loop of a `RobotPlant`.
        record: The record of a run of this loop.
        context: The context of its diagram, which contains the parameters; not changed.
        title: The title of the page; the robot's name if empty.

    Returns:
        One HTML page with the scene and the animation, as text. A notebook displays it.

    Raises:
        ModelError: The plant is not a robot.
    """
    course = follow(loop, record, context)
    events = [*events_of(record, robot_limits(course.model)), *slips(course)]
    phases = phase_spans(record)
    return animate(course, loop.scene_graph, title, phases, sorted_events(record, events))


def animate(
    course: RunMotion,
    scene_graph: SceneGraph | None,
    title: str = "",
    phases: Sequence[PhaseSpan] = (),
    events: Sequence[RunEvent] = (),
) -> InlinePage:
    """Returns the page of `make_animation`.

    Args:
        course: The motion of the robot.
        scene_graph: The geometry of the robot, or None.
        title: The title of the page; the robot's name if empty.
        phases: The phases of a task, shown beside the time.
        events: The events of the run, marked on the time bar.
    """
    # The server starts here, so that runs without an animation do not open a port.
    meshcat = start_unwatched_meshcat()
    plant, acting = course.plant, course.acting
    model = course.model
    arrows = draw_scene(plant, meshcat, scene_graph)
    links = view_of_links(plant, scene_graph, meshcat)
    arrows.measure(course.wrenches)

    # The static parts: surfaces, floor, actual paths and desired paths.
    _, size = scene_extent(model, acting, course.states[0], scene_graph)
    surfaces = surroundings(model, acting, course.points, course.parameters[0], PIECE * size)
    draw_surroundings(meshcat, surfaces)
    floor = floor_below(run_points(course, scene_graph), surfaces)
    draw_floor(meshcat, floor)
    view = ViewAngles.of(CAMERA_ANGLE, ASPECT)
    look_at(meshcat, *run_view(course, scene_graph, view, ARROW * size))
    _draw_paths(meshcat, acting, course.points, "actual", PATH_COLOR, 0.003 * size)
    _draw_paths(meshcat, acting, course.desired_points, "desired", _DESIRED, 0.0015 * size)

    # The moving parts: links and arrows, frame by frame.
    links_context = links.CreateDefaultContext() if links is not None else None
    cones = friction_cones(course)
    for cone in cones:
        _add_cone(meshcat, acting.constraints[cone.row], cone, 0.5 * ARROW * size)
    meshcat.StartRecording(frames_per_second=FRAME_RATE)
    for frame, time in enumerate(course.times):
        state, wrench = course.states[frame], course.wrenches[frame]
        if links is not None and links_context is not None:
            links_context.SetTime(time)
            link_state = links.get_input_port()
            link_state.FixValue(links_context, state[: link_state.size()])
            links.ForcedPublish(links_context)
        arrows.draw(wrench, time)
        arrows.place(course.parameters[frame], time)
        for cone in cones:
            # The cone opens against the normal, since the arrow's tip is at the contact.
            rotation = RotationMatrix(axes_along(-cone.normals[frame]))
            path = path_of(acting.constraints[cone.row], "cone")
            meshcat.SetTransform(path, RigidTransform(rotation, wrench.points[cone.row]), time)
            scale = 1.0 if wrench.forces[cone.row].any() else LEAST_SCALE
            meshcat.SetProperty(f"{path}/form", "scale", [scale] * 3, time)
    meshcat.StopRecording()
    recording = meshcat.get_mutable_recording()
    recording.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
    recording.set_repetitions(_FOREVER)
    meshcat.PublishRecording()
    legend = _legend(course, arrows, cones, floor)
    texts = {
        "title": title or model.dae.name,
        "legend": [*legend, *((kind.color, kind.label) for kind in event_kinds(events))],
        "phases": [[span.begin, span.name] for span in phases],
        "moments": [[event.time, event.kind.color, event.text] for event in events],
    }
    return InlinePage(_with_overlay(meshcat.StaticHtml(), course, texts))


def _legend(
    course: RunMotion, arrows: ForceArrows, cones: Sequence[DrawnFrictionCone], floor: Floor
) -> list[tuple[str, str]]:
    """Returns (color, meaning) of everything drawn besides the robot."""
    entries = []
    if course.acting.constraints:
        entries += [(_hex(PATH_COLOR), "path"), (_hex(_DESIRED), "desired path")]
        longest = f"constraint force, the longest {arrows.largest_force:.3g} N"
        entries.append((_hex(FORCE_COLOR), longest))
    if arrows.has_moment:
        longest = f"moment, the longest {arrows.largest_moment:.3g} N m"
        entries.append((_hex(MOMENT_COLOR), longest))
    if cones:
        numbers = sorted({f"{cone.coefficient:.3g}" for cone in cones})
        entries.append((_hex(_CONE), f"friction cone, coefficient {' and '.join(numbers)}"))
    return [*entries, ("#bbbbbb", f"grid of {floor.cell:g} m")]


def _hex(color: Rgba) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in (color.r(), color.g(), color.b()))


def _add_cone(
    meshcat: Meshcat, constraint: Constraint, cone: DrawnFrictionCone, side: float
) -> None:
    """Adds the friction cone of a contact; `side` is its slant height in m, its tip the origin."""
    angle = np.arctan(cone.coefficient)
    radius = side * np.sin(angle)
    shape = MeshcatCone(side * np.cos(angle), radius, radius)
    meshcat.SetObject(f"{path_of(constraint, 'cone')}/form", shape, _CONE)


def _draw_paths(
    meshcat: Meshcat,
    wrenches: ConstraintWrenches,
    points: FloatArray,
    kind: str,
    color: Rgba,
    radius: float,
) -> None:
    """Draws a line through the points of each constraint, m, shape (frames, constraints, 3)."""
    for row, constraint in enumerate(wrenches.constraints):
        line = points[:, row]
        if len(line) > 1:
            vertices, faces = _tube(line, radius)
            meshcat.SetTriangleMesh(
                f"/paths/{constraint.name}/{kind}",
                np.asfortranarray(vertices.T),
                np.asfortranarray(faces.T),
                color,
            )


def _tube(points: FloatArray, radius: float) -> tuple[FloatArray, np.ndarray]:
    """Returns a thin tube around a line through points, m, shape (k, 3).

    Returns:
        Its vertices, ring after ring of `_SIDES` vertices around the points, shape
        (k * _SIDES, 3), and its triangles, segment after segment of the line.
    """
    tangent = np.gradient(points, axis=0)
    length = np.linalg.norm(tangent, axis=1, keepdims=True)
    tangent = np.where(length > 0.0, tangent / np.where(length > 0.0, length, 1.0), [0.0, 0.0, 1.0])
    other = np.where(np.abs(tangent[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    normal = np.cross(tangent, other)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normals = np.stack([normal, np.cross(tangent, normal)], axis=1)
    angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    rings = points[:, None] + radius * np.column_stack([np.cos(angle), np.sin(angle)]) @ normals
    corner = np.arange(_SIDES)
    following = np.roll(corner, -1)
    segment = np.vstack(
        [
            np.column_stack([corner, following, corner + _SIDES]),
            np.column_stack([following, following + _SIDES, corner + _SIDES]),
        ]
    )
    faces = segment + _SIDES * np.arange(len(points) - 1)[:, None, None]
    return rings.reshape(-1, 3), faces.reshape(-1, 3)


def _with_overlay(page: str, course: RunMotion, texts: dict[str, Any]) -> str:
    """Returns Meshcat's page with texts, sizes of forces, and paths that grow with time."""
    constraints = course.acting.constraints
    sizes = np.linalg.norm([wrench.forces for wrench in course.wrenches], axis=2)
    data = {
        **texts,
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
    name = html.escape(texts["title"])
    page = re.sub(r"<title>.*?</title>", lambda _: f"<title>{name}</title>", page, count=1)
    head, end, tail = page.rpartition("</body>")
    return f"{head}{overlay}{end}{tail}" if end else page + overlay
