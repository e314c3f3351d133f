"""The film of a run of a robot, rendered by Drake without a screen or a browser."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    LightParameter,
    MakeRenderEngineVtk,
    Mesh,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngineVtkParams,
    RenderLabel,
    Rgba,
    Role,
    SceneGraph,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.rendering import MultibodyPositionToGeometryPose
from pydrake.systems.sensors import CameraInfo

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.diagrams.record import Record
from drake_dae.errors import ModelError
from drake_dae.pictures.film_marks import FilmMarks
from drake_dae.pictures.friction import slips
from drake_dae.pictures.labels import label_box, reserved_pixels
from drake_dae.pictures.moments import RunEvent, events_of, sorted_events
from drake_dae.pictures.rendered import rendered
from drake_dae.pictures.run_motion import (
    RunMotion,
    ShownLoop,
    follow,
    run_points,
    run_view,
)
from drake_dae.robots import own_values
from drake_dae.running.limits import robot_limits
from drake_dae.running.phases import phase_spans, phases_at
from drake_dae.scene.floor import floor_below
from drake_dae.scene.framing import ViewAngles
from drake_dae.scene.surroundings import surroundings
from drake_dae.scene.view import ARROW, PIECE

if TYPE_CHECKING:  # Loaded with the first film.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GIF_RATE = 10.0
"""Pictures per second of a .gif."""

MP4_RATE = 25.0
"""Pictures per second of an .mp4."""

STRIP_COUNT = 4
"""The number of pictures in a .png."""

_WIDTH, _HEIGHT = 480, 400
_ANGLE = 0.62  # The vertical angle of view, in rad.
_FFMPEG_OPTIONS = ["-pix_fmt", "yuv420p", "-preset", "veryfast"]
"""A pixel format that browsers can play, and a preset that takes no longer than the drawing."""

_LETTER = 7.0  # The width of a letter of a label, in pixels.
_LEAST_FORCE = 0.02  # Forces below this fraction of the run's largest force have no arrow.

ACTUAL, DESIRED, FORCE = "#1f3fbf", "#2e9d4a", "#d12b1f"
"""Colors of the actual path, the desired path, and forces."""

_TOP = 56.0 / _HEIGHT
"""The fraction of a picture's height that is reserved for the texts at the top."""

_LIGHTS = (([0.8, 0.6, -0.7], 1.0), ([-0.8, 0.2, -0.3], 0.4))
_PHYSICAL_LIGHTS = (
    ([0.8, 0.6, -0.7], 2.2),
    ([-0.8, 0.2, -0.3], 1.0),
    ([0.3, -0.9, -0.2], 1.0),
    ([0.0, 0.0, -1.0], 1.0),
)
"""(direction, intensity) of each light; the second set is for physically based materials."""

_SURFACE, _FLOOR = Rgba(0.75, 0.85, 0.95, 0.5), Rgba(1.0, 1.0, 1.0, 1.0)

Pixels = NDArray[np.uint8]


@checked(ModelError)
def save_film(loop: ShownLoop, record: Record, context: Context, path: str | Path) -> None:
    """Writes a film of a recorded run, with the paths and the forces of the contacts.

    The actual path is blue, the desired path green. A contact with friction
    has a friction cone. A moment is an arrow with two heads. A time bar at the bottom has marks for
    phases and events.

    Args:
        loop: A loop of a `RobotPlant` whose links have geometry.
        record: The record of a run of this loop.
        context: The context of its diagram, which contains the parameters; not changed.
        path: A .gif or .mp4 for the film, or a .png for four pictures of it side by side. An .mp4
            has more pixels and pictures per second, and needs the program ffmpeg.

    Raises:
        ModelError: The plant is not a robot, its links have no geometry, the file has another
            suffix, or ffmpeg is not installed.
        OSError: The file cannot be written.
    """
    name, kind = Path(path).name, Path(path).suffix
    if kind not in (".gif", ".mp4", ".png"):
        raise ModelError(f"a film is a .gif or .mp4, a strip of pictures a .png, got '{name}'")
    if kind == ".mp4" and shutil.which("ffmpeg") is None:
        raise ModelError(
            "an .mp4 needs the program ffmpeg, which is not installed; install it (apt install "
            "ffmpeg), or write a .gif"
        )
    rate, sharpness = (MP4_RATE, 2) if kind == ".mp4" else (GIF_RATE, 1)
    course = follow(loop, record, context, rate)
    events = [*events_of(record, robot_limits(course.model)), *slips(course)]
    phases = [span.begin for span in phase_spans(record)]
    scene = _Scene(course, loop.scene_graph, sharpness, sorted_events(record, events), phases)
    last = len(course.times) - 1
    scene.notes = phases_at(record, course.start_time + course.times)
    if kind == ".png":
        figure, axes = _canvas(STRIP_COUNT)
        for i, axis in enumerate(axes):
            scene.draw(axis, round(last * i / (STRIP_COUNT - 1)))
        figure.savefig(path)
        return
    from matplotlib.animation import FFMpegWriter, PillowWriter

    figure, (axis,) = _canvas(1)
    if kind == ".gif":
        writer: PillowWriter | FFMpegWriter = PillowWriter(fps=int(rate))
    else:
        writer = FFMpegWriter(fps=int(rate), codec="h264", extra_args=_FFMPEG_OPTIONS)
    # Not `writer.saving`, which after an interruption writes an incomplete film.
    writer.setup(figure, str(path), dpi=100 * sharpness)
    try:
        for frame in range(last + 1):
            axis.clear()
            scene.draw(axis, frame)
            writer.grab_frame()
    except BaseException:
        if kind == ".mp4":  # ffmpeg is running.
            writer.finish()
            Path(path).unlink(missing_ok=True)
        raise
    writer.finish()


def _canvas(columns: int) -> tuple[Figure, list[Axes]]:
    """Returns a figure and the axes of its pictures, side by side."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(columns * _WIDTH / 100, _HEIGHT / 100), dpi=100)
    boxes = [(column / columns, 0.0, 1.0 / columns, 1.0) for column in range(columns)]
    return figure, [figure.add_axes(box) for box in boxes]


class _Camera:
    """A pinhole camera at `eye` that looks at `at`; the y axis of its picture points down."""

    def __init__(self, eye: FloatArray, at: FloatArray, far: float, sharpness: int = 1) -> None:
        forward = (at - eye) / np.linalg.norm(at - eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        axes = np.column_stack([right, np.cross(forward, right), forward])
        self.pose = RigidTransform(RotationMatrix(axes), eye)
        self.info = CameraInfo(_WIDTH, _HEIGHT, _ANGLE)
        sharp = CameraInfo(sharpness * _WIDTH, sharpness * _HEIGHT, _ANGLE)
        core = RenderCameraCore("film", sharp, ClippingRange(far / 100, far), RigidTransform())
        self.color = ColorRenderCamera(core)

    def project(self, points: FloatArray) -> FloatArray:
        """Returns the pixels of points in the world, shape (k, 2)."""
        x, y, depth = self.pose.inverse().multiply(np.atleast_2d(points).T)
        info = self.info
        return np.column_stack(
            [
                info.center_x() + info.focal_x() * x / depth,
                info.center_y() + info.focal_y() * y / depth,
            ]
        )


class _Scene:
    """Draws the links, surfaces, paths and forces of a run, frame by frame.

    Attributes:
        notes: The text of each frame, such as its phase.
        floor: The grid below the robot.
    """

    def __init__(
        self,
        course: RunMotion,
        scene_graph: SceneGraph | None,
        sharpness: int = 1,
        events: Sequence[RunEvent] = (),
        phases: Sequence[float] = (),
    ) -> None:
        model, links = course.model, course.model.links.plant
        if scene_graph is None or links is None or links.get_source_id() is None:
            raise ModelError("a film shows links with geometry; this robot has none")
        corners = run_points(course, scene_graph)
        self._size = float(np.linalg.norm(np.ptp(corners, axis=0)))
        view = ViewAngles.of(_ANGLE, _WIDTH / _HEIGHT, _TOP)
        self._arrow = ARROW * self._size
        eye, at = run_view(course, scene_graph, view, self._arrow)
        self._camera = _Camera(eye, at, 10.0 * self._size, sharpness)
        self._marks = FilmMarks(course, self._camera.project, self._arrow, events, phases)
        self.notes = [""] * len(course.times)
        self._course, self._points, self._desired = course, course.points, course.desired_points
        builder = DiagramBuilder()
        scene = builder.AddSystem(scene_graph.Clone())
        # With a .gltf mesh the renderer uses physically based materials, which need more light.
        is_physical = _has_gltf(scene_graph)
        lights = [
            LightParameter(type="directional", direction=direction, frame="world", intensity=power)
            for direction, power in (_PHYSICAL_LIGHTS if is_physical else _LIGHTS)
        ]
        parameters = RenderEngineVtkParams(default_clear_color=[1.0, 1.0, 1.0], lights=lights)
        scene.AddRenderer("film", MakeRenderEngineVtk(parameters))
        pose = builder.AddSystem(MultibodyPositionToGeometryPose(links, input_multibody_state=True))
        builder.ExportInput(pose.get_input_port(), "link_state")
        builder.Connect(pose.get_output_port(), scene.get_source_pose_port(links.get_source_id()))
        self._frames = {}
        source = scene.RegisterSource("surroundings")
        surfaces = surroundings(
            model, course.acting, course.points, course.parameters[0], PIECE * self._size
        )
        self.floor = floor_below(corners, surfaces)
        for i, (begin, end) in enumerate(zip(*self.floor.lines, strict=True)):
            sides = np.abs(end - begin) + 0.002 * self._size
            line = GeometryInstance(RigidTransform((begin + end) / 2.0), Box(*sides), f"line{i}")
            line.set_perception_properties(_properties(_FLOOR))
            scene.RegisterAnchoredGeometry(source, line)
        for surface in surfaces:
            constraint, picture = surface.constraint, surface.picture
            frame = GeometryFrame(constraint.name)
            self._frames[constraint] = scene.RegisterFrame(source, frame)
            shape = GeometryInstance(picture.pose, rendered(picture.form), constraint.name)
            shape.set_perception_properties(_properties(_SURFACE))
            scene.RegisterGeometry(source, frame.id(), shape)
        if self._frames:
            builder.ExportInput(scene.get_source_pose_port(source), "surroundings")
        builder.ExportOutput(scene.get_query_output_port(), "query")
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._world = scene.world_frame_id()
        self._largest = max(
            float(np.linalg.norm(wrench.forces, axis=1).max(initial=0.0))
            for wrench in course.wrenches
        )

    def draw(self, axis: Axes, number: int) -> None:
        """Draws a frame of the film, with the actual paths up to its time."""
        from matplotlib.patheffects import withStroke

        course, halo = self._course, withStroke(linewidth=3.0, foreground="white")
        extent = (-0.5, _WIDTH - 0.5, _HEIGHT - 0.5, -0.5)
        axis.imshow(self._render(number), interpolation="nearest", extent=extent)
        axis.set_axis_off()
        event_text = self._marks.draw(axis, number, _WIDTH, _HEIGHT)
        wrench, boxes = course.wrenches[number], list[FloatArray]()
        sizes = np.linalg.norm(wrench.forces, axis=1)
        tails = wrench.points - self._arrow * wrench.forces / max(self._largest, 1e-6)
        arrows = zip(wrench.points, tails, strict=True)
        ends = [self._camera.project(np.array(arrow)) for arrow in arrows]
        with_arrow = [row for row, size in enumerate(sizes) if size > _LEAST_FORCE * self._largest]
        reserved = reserved_pixels([ends[row] for row in with_arrow])
        for row in range(len(ends)):
            for points, color in ((self._desired, DESIRED), (self._points[: number + 1], ACTUAL)):
                axis.plot(*self._camera.project(points[:, row]).T, color=color, linewidth=1.6)
        within = (0.0, _TOP * _HEIGHT, _WIDTH, _HEIGHT)
        for row in with_arrow:
            head, tail = ends[row]
            shape = {"color": FORCE, "width": 2.5, "headwidth": 9, "headlength": 9}
            axis.annotate("", head, tail, arrowprops=shape)
            name = f"{course.acting.constraints[row].name} " if len(ends) > 1 else ""
            text = f"{name}{sizes[row]:.3g} N"
            size = np.array([_LETTER * len(text) + 4.0, 16.0])
            box = label_box(size, head, tail, boxes, reserved, within)
            boxes.append(box)
            x, y = box[:2] + size / 2.0
            label = axis.text(x, y, text, color=FORCE, fontsize=10, ha="center", va="center")
            label.set_path_effects([halo])
        time = course.start_time + course.times[number]
        scale = f"longest force {self._largest:.3g} N, grid {self.floor.cell:g} m"
        texts = [
            axis.text(12, 24, f"t = {time:.1f} s", fontsize=11, color="0.25"),
            axis.text(12, 46, self.notes[number], fontsize=11, color="0.25"),
            axis.text(_WIDTH - 12, 24, scale, fontsize=9, color="0.35", ha="right"),
            axis.text(_WIDTH - 12, 38, self._marks.scale, fontsize=9, color="0.35", ha="right"),
            axis.text(_WIDTH - 12, 54, event_text, fontsize=9, color="0.2", ha="right"),
        ]
        for text_artist in texts:
            text_artist.set_path_effects([halo])
        axis.set_xlim(-0.5, _WIDTH - 0.5)
        axis.set_ylim(_HEIGHT - 0.5, -0.5)

    def _render(self, number: int) -> Pixels:
        """Returns the picture of links, surfaces and floor in a frame."""
        course, diagram, context = self._course, self._diagram, self._context
        link_state = diagram.GetInputPort("link_state")
        link_state.FixValue(context, course.states[number][: link_state.size()])
        if self._frames:
            poses = FramePoseVector()
            for constraint, frame in self._frames.items():
                values = own_values(constraint, course.model.dae, course.parameters[number])
                poses.set_value(frame, constraint.placement(values))
            diagram.GetInputPort("surroundings").FixValue(context, poses)
        query = diagram.GetOutputPort("query").Eval(context)
        image = query.RenderColorImage(self._camera.color, self._world, self._camera.pose)
        return np.array(image.data[:, :, :3])


def _has_gltf(scene_graph: SceneGraph) -> bool:
    inspector = scene_graph.model_inspector()
    shapes = map(inspector.GetShape, inspector.GetAllGeometryIds(Role.kPerception))
    return any(isinstance(shape, Mesh) and shape.extension() == ".gltf" for shape in shapes)


def _properties(color: Rgba) -> PerceptionProperties:
    properties = PerceptionProperties()
    properties.AddProperty("phong", "diffuse", color)
    properties.AddProperty("label", "id", RenderLabel.kDontCare)
    return properties
