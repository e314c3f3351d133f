"""The animation of a run of a robot in Meshcat, as one HTML page."""

import html
import json
import re
from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat, MeshcatAnimation, MeshcatCone, Rgba
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.blocks.traced_system import context_in
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.record import Record, phase_spans
from drake_dae.errors import ModelError
from drake_dae.pictures.motion import follow, run_points, run_view
from drake_dae.robots import axes_along
from drake_dae.scene.arrows import FORCE_COLOR, LEAST_SCALE, MOMENT_COLOR, PATH_COLOR, path_of
from drake_dae.scene.surroundings import (
    diagonal,
    floor_below,
    scene_points,
    surroundings,
    view_angles,
)
from drake_dae.scene.view import (
    ARROW,
    ASPECT,
    CAMERA_ANGLE,
    FRAME_RATE,
    PIECE,
    draw_scene,
    draw_surroundings,
    look_at,
    start_unwatched_meshcat,
    view_of_links,
)

_DESIRED = Rgba(0.1, 0.6, 0.2, 1.0)
_CONE = Rgba(0.95, 0.6, 0.15, 0.35)

_FOREVER = 2**31 - 1  # The number of repetitions of the animation.
_SIDES = 6  # The number of sides of the tube that draws a path; browsers draw lines one pixel wide.

_OVERLAY = Path(__file__).with_name("overlay.html")


class InlinePage(str):
    """An HTML page as text; a notebook displays it in a frame."""

    def _repr_html_(self) -> str:
        page = html.escape(str(self), quote=True)
        return f'<iframe srcdoc="{page}" style="width: 100%; height: 600px; border: 0"></iframe>'


@checked(ModelError)
def make_animation(
    loop: ClosedLoop, record: Record, context: Context, title: str = ""
) -> InlinePage:
    """Returns an animation of a recorded run in Meshcat, with the paths of the contact points.

    The page shows the time, the constraint forces as arrows with their sizes, and the actual path
    over the desired one; it repeats the run. A time bar shows the phases of a task, and jumps to
    any time; the address "page.html#t=2.5" shows the run at 2.5 s. An
    open contact has no arrow. A contact with friction has a friction cone.

    Args:
        loop: A loop of a `RobotPlant`, a `CompliantPlant` or a `ContactPlant`.
        record: The record of a run of this loop.
        context: The context of its diagram, which contains the parameters; not changed.
        title: The title of the page; the robot's name if empty.

    Returns:
        One HTML page with the scene and the animation, as text. A notebook displays it.

    Raises:
        ModelError: The plant is not a robot.
    """
    motion, scene_graph = follow(loop, record, context), loop.scene_graph
    model, acting = motion.model, motion.acting
    # The server starts here, so that runs without an animation do not open a port.
    meshcat = start_unwatched_meshcat()
    arrows = draw_scene(loop.plant, meshcat, scene_graph)
    links = view_of_links(loop.plant, scene_graph, meshcat)
    arrows.measure(motion.wrenches)

    # The static parts: surfaces, floor, actual paths and desired paths.
    points, normals = motion.points, motion.normals
    size = diagonal(scene_points(model, acting, motion.states[:1], scene_graph))
    surfaces = surroundings(model, acting, points, motion.parameters[0], PIECE * size)
    floor = floor_below(run_points(motion, scene_graph), surfaces)
    draw_surroundings(meshcat, surfaces, floor)
    view = view_angles(CAMERA_ANGLE, ASPECT)
    look_at(meshcat, *run_view(motion, scene_graph, view, ARROW * size))
    desired = motion.desired_points
    for row, constraint in enumerate(acting.constraints):
        path = f"/paths/{constraint.name}"
        _draw_tube(meshcat, f"{path}/actual", points[:, row], PATH_COLOR, 0.003 * size)
        _draw_tube(meshcat, f"{path}/desired", desired[:, row], _DESIRED, 0.0015 * size)

    # The friction cones, with the plant's coefficients.
    friction, cones = loop.plant.friction(context_in(loop.plant, context)), dict[int, float]()
    for row, constraint in enumerate(acting.constraints):
        coefficient = friction.get(constraint.name, 0.0)
        if coefficient > 0.0 and sum(constraint.is_unilateral) == 1 and normals[:, row].any():
            cones[row], side = coefficient, 0.5 * ARROW * size / np.hypot(1.0, coefficient)
            form = MeshcatCone(side, coefficient * side, coefficient * side)
            meshcat.SetObject(f"{path_of(constraint, 'cone')}/form", form, _CONE)

    # The moving parts, frame by frame.
    links_context = links.CreateDefaultContext() if links is not None else None
    meshcat.StartRecording(frames_per_second=FRAME_RATE)
    for frame, time in enumerate(motion.times):
        state, wrench = motion.states[frame], motion.wrenches[frame]
        if links is not None and links_context is not None:
            links_context.SetTime(time)
            link_state = links.get_input_port()
            link_state.FixValue(links_context, state[: link_state.size()])
            links.ForcedPublish(links_context)
        arrows.draw(wrench, time)
        arrows.place(motion.parameters[frame], time)
        for row in cones:
            # The cone opens against the normal, since the arrow's tip is at the contact.
            turn = RotationMatrix(axes_along(-normals[frame, row]))
            path = path_of(acting.constraints[row], "cone")
            meshcat.SetTransform(path, RigidTransform(turn, wrench.points[row]), time)
            scale = 1.0 if wrench.forces[row].any() else LEAST_SCALE
            meshcat.SetProperty(f"{path}/form", "scale", [scale] * 3, time)
    meshcat.StopRecording()
    recording = meshcat.get_mutable_recording()
    recording.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
    recording.set_repetitions(_FOREVER)
    meshcat.PublishRecording()

    # The texts.
    legend = [(_hex(PATH_COLOR), "path"), (_hex(_DESIRED), "desired path")]
    force = f"constraint force, the longest {arrows.largest_force:.3g} N"
    legend = [*legend, (_hex(FORCE_COLOR), force)] if acting.constraints else []
    if arrows.has_moment:
        moment = f"moment, the longest {arrows.largest_moment:.3g} N m"
        legend.append((_hex(MOMENT_COLOR), moment))
    if cones:
        numbers = sorted({f"{coefficient:.3g}" for coefficient in cones.values()})
        legend.append((_hex(_CONE), f"friction cone, coefficient {' and '.join(numbers)}"))
    legend.append(("#bbbbbb", f"grid of {floor.cell:g} m"))
    sizes = np.linalg.norm([wrench.forces for wrench in motion.wrenches], axis=2)
    overlay = {
        "title": title or model.dae.name,
        "legend": legend,
        "phases": [[span.begin, span.name] for span in phase_spans(record)],
        "rate": FRAME_RATE,
        "start": motion.start_time,
        "end": motion.start_time + float(motion.times[-1]),
        "aspect": ASPECT,
        "indices": 6 * _SIDES,
        "forces": [
            {
                "name": constraint.name,
                "path": path_of(constraint, "force").strip("/").split("/"),
                "values": [float(f"{value:.4g}") for value in sizes[:, row]],
            }
            for row, constraint in enumerate(acting.constraints)
        ],
        "paths": [["paths", constraint.name, "actual"] for constraint in acting.constraints],
    }
    # A name may contain text that ends a script.
    data = json.dumps(overlay).replace("<", "\\u003c")
    own = _OVERLAY.read_text("utf-8").replace('"DATA"', data)
    name = f"<title>{html.escape(title or model.dae.name)}</title>"
    page = re.sub(r"<title>.*?</title>", lambda _: name, meshcat.StaticHtml(), count=1)
    before, end, after = page.rpartition("</body>")
    return InlinePage(f"{before}{own}{end}{after}" if end else page + own)


def _hex(color: Rgba) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in (color.r(), color.g(), color.b()))


def _draw_tube(meshcat: Meshcat, path: str, points: FloatArray, color: Rgba, radius: float) -> None:
    """Draws a tube along points, m, (k, 3), in segments: the page draws it up to a time."""
    if len(points) < 2:
        return
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
    first = np.column_stack([corner, following, corner + _SIDES])
    second = np.column_stack([following, following + _SIDES, corner + _SIDES])
    segments = _SIDES * np.arange(len(points) - 1)[:, None, None]
    faces = (np.vstack([first, second]) + segments).reshape(-1, 3)
    columns = (np.asfortranarray(table.T) for table in (rings.reshape(-1, 3), faces))
    meshcat.SetTriangleMesh(path, *columns, color)
