"""The film of a run of a robot, rendered by Drake without a screen or a browser."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from pydrake.common import MemoryFile
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    InMemoryMesh,
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
    Shape,
    TriangleSurfaceMesh,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.rendering import MultibodyPositionToGeometryPose
from pydrake.systems.sensors import CameraInfo

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.record import Record, phases_at
from drake_dae.errors import ModelError
from drake_dae.pictures.motion import RunMotion, follow, run_points, run_view
from drake_dae.robots import own_values
from drake_dae.scene.surroundings import diagonal, floor_below, surroundings, view_angles
from drake_dae.scene.view import ARROW, PIECE

_RATE, _STRIP = 10, 4  # Pictures per second of a .gif; pictures in a .png.
# The size of a picture, and the height at its top that is free for texts, in pixels.
_WIDTH, _HEIGHT, _TOP = 480, 400, 56
_ANGLE = 0.62  # The vertical angle of view, in rad.
_LEAST_FORCE = 0.02  # Forces below this fraction of the run's largest force have no arrow.

_ACTUAL, _DESIRED, _FORCE = "#1f3fbf", "#2e9d4a", "#d12b1f"

_LIGHTS = (([0.8, 0.6, -0.7], 1.0), ([-0.8, 0.2, -0.3], 0.4))
# (direction, intensity) of each light; the second set is for physically based materials.
_PHYSICAL_LIGHTS = (
    *(([0.8, 0.6, -0.7], 2.2), ([-0.8, 0.2, -0.3], 1.0)),
    *(([0.3, -0.9, -0.2], 1.0), ([0.0, 0.0, -1.0], 1.0)),
)


@checked(ModelError)
def save_film(loop: ClosedLoop, record: Record, context: Context, path: str | Path) -> None:
    """Writes a film of a recorded run of a robot, with the paths and the forces of the contacts.

    The actual path is blue, the desired path green. The context has the parameters. A .gif has the
    film, a .png four pictures of it side by side.
    """
    path = Path(path)
    if path.suffix not in (".gif", ".png"):
        raise ModelError(f"a film is a .gif, a strip of pictures a .png, got '{path.name}'")
    scene = FilmScene(follow(loop, record, context, _RATE), loop.scene_graph)
    phases = phases_at(record, scene.motion.start_time + scene.motion.times)
    count, last = _STRIP if path.suffix == ".png" else 1, len(phases) - 1
    figure = Figure(figsize=(count * _WIDTH / 100, _HEIGHT / 100), dpi=100)
    axes = [figure.add_axes((i / count, 0.0, 1.0 / count, 1.0)) for i in range(count)]
    if path.suffix == ".png":
        for i, axis in enumerate(axes):
            frame = round(last * i / (count - 1))
            scene.draw(axis, frame, phases[frame])
        figure.savefig(path)
        return
    writer = PillowWriter(fps=_RATE)
    # Not `writer.saving`, which after an interruption writes an incomplete film.
    writer.setup(figure, str(path), dpi=100)
    for frame, phase in enumerate(phases):
        axes[0].clear()
        scene.draw(axes[0], frame, phase)
        writer.grab_frame()
    writer.finish()


class FilmScene:
    """Draws the links, surfaces, paths and forces of a run, frame by frame."""

    def __init__(self, motion: RunMotion, scene_graph: SceneGraph | None) -> None:
        model, links = motion.model, motion.model.links.plant
        if scene_graph is None or links is None or links.get_source_id() is None:
            raise ModelError("a film shows links with geometry; this robot has none")
        corners = run_points(motion, scene_graph)
        size = diagonal(corners)
        self.motion, self._arrow = motion, ARROW * size
        self._points, self._desired = motion.points, motion.desired_points
        self._largest = max(
            float(np.linalg.norm(wrench.forces, axis=1).max(initial=1e-6))
            for wrench in motion.wrenches
        )
        view = view_angles(_ANGLE, _WIDTH / _HEIGHT, _TOP / _HEIGHT)
        self._place_camera(*run_view(motion, scene_graph, view, self._arrow), 10.0 * size)
        builder = DiagramBuilder()
        scene = builder.AddSystem(scene_graph.Clone())
        # With a .gltf mesh the renderer uses physically based materials.
        inspector = scene_graph.model_inspector()
        shapes = map(inspector.GetShape, inspector.GetAllGeometryIds(Role.kPerception))
        is_physical = any(isinstance(s, Mesh) and s.extension() == ".gltf" for s in shapes)
        lights = [
            LightParameter(type="directional", direction=direction, frame="world", intensity=power)
            for direction, power in (_PHYSICAL_LIGHTS if is_physical else _LIGHTS)
        ]
        parameters = RenderEngineVtkParams(default_clear_color=[1.0, 1.0, 1.0], lights=lights)
        scene.AddRenderer("film", MakeRenderEngineVtk(parameters))
        pose = builder.AddSystem(MultibodyPositionToGeometryPose(links, input_multibody_state=True))
        builder.ExportInput(pose.get_input_port(), "link_state")
        builder.Connect(pose.get_output_port(), scene.get_source_pose_port(links.get_source_id()))
        source = scene.RegisterSource("surroundings")
        surfaces = surroundings(
            model, motion.acting, motion.points, motion.parameters[0], PIECE * size
        )
        floor = floor_below(corners, surfaces)
        for i, (begin, end) in enumerate(zip(floor.begins, floor.ends, strict=True)):
            sides = np.abs(end - begin) + 0.002 * size
            line = GeometryInstance(RigidTransform((begin + end) / 2.0), Box(*sides), f"line{i}")
            line.set_perception_properties(_properties(Rgba(1.0, 1.0, 1.0, 1.0)))
            scene.RegisterAnchoredGeometry(source, line)
        self._frames = {}
        for surface in surfaces:
            name, picture = surface.constraint.name, surface.picture
            frame = GeometryFrame(name)
            self._frames[surface.constraint] = scene.RegisterFrame(source, frame)
            shape = GeometryInstance(picture.pose, _rendered(picture.form), name)
            shape.set_perception_properties(_properties(Rgba(0.75, 0.85, 0.95, 0.5)))
            scene.RegisterGeometry(source, frame.id(), shape)
        if self._frames:
            builder.ExportInput(scene.get_source_pose_port(source), "surroundings")
        builder.ExportOutput(scene.get_query_output_port(), "query")
        self._diagram = builder.Build()
        self._context, self._world = self._diagram.CreateDefaultContext(), scene.world_frame_id()
        self._scale = f"longest force {self._largest:.3g} N, grid {floor.cell:g} m"

    def _place_camera(self, eye: FloatArray, at: FloatArray, far: float) -> None:
        """A pinhole camera at `eye` that looks at `at`; the y axis of its picture points down."""
        forward = (at - eye) / np.linalg.norm(at - eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        axes = np.column_stack([right, np.cross(forward, right), forward])
        self.pose = RigidTransform(RotationMatrix(axes), eye)
        self.info = CameraInfo(_WIDTH, _HEIGHT, _ANGLE)
        clipping = ClippingRange(far / 100, far)
        core = RenderCameraCore("film", self.info, clipping, RigidTransform())
        self._camera = ColorRenderCamera(core)

    def project(self, points: FloatArray) -> FloatArray:
        """The pixels of points in the world, shape (k, 2)."""
        seen = self.info.intrinsic_matrix() @ self.pose.inverse().multiply(np.atleast_2d(points).T)
        return np.asarray((seen[:2] / seen[2]).T)

    def draw(self, axis: Axes, number: int, phase: str = "") -> None:
        """Draws a frame of the film, with the actual paths up to its time."""
        motion, halo = self.motion, [withStroke(linewidth=3.0, foreground="white")]
        text: dict[str, Any] = {"fontsize": 10, "path_effects": halo}
        axis.imshow(self._render(number), interpolation="nearest", extent=(0, _WIDTH, _HEIGHT, 0))
        axis.set_axis_off()
        wrench = motion.wrenches[number]
        tails = wrench.points - self._arrow * wrench.forces / self._largest
        for row, constraint in enumerate(motion.acting.constraints):
            for points, color in ((self._desired, _DESIRED), (self._points[: number + 1], _ACTUAL)):
                axis.plot(*self.project(points[:, row]).T, color=color, linewidth=1.6)
            force = float(np.linalg.norm(wrench.forces[row]))
            if force <= _LEAST_FORCE * self._largest:
                continue
            head, tail = self.project(np.array([wrench.points[row], tails[row]]))
            shape = {"color": _FORCE, "width": 2.5, "headwidth": 9, "headlength": 9}
            axis.annotate("", head, tail, arrowprops=shape)
            name = f"{constraint.name} " if len(tails) > 1 else ""
            text |= {"color": _FORCE, "va": "center"}
            beside, text["ha"] = (-5, "right") if tail[0] < head[0] else (5, "left")
            axis.text(tail[0] + beside, tail[1], f"{name}{force:.3g} N", **text)
        time = f"t = {motion.start_time + motion.times[number]:.1f} s\n{phase}"
        text |= {"color": "0.3", "va": "top"}
        axis.text(12, 12, time, **{**text, "ha": "left"})
        axis.text(_WIDTH - 12, 12, self._scale, **{**text, "ha": "right"})
        axis.set_xlim(0, _WIDTH)
        axis.set_ylim(_HEIGHT, 0)

    def _render(self, number: int) -> np.ndarray:
        """The picture of links, surfaces and floor in a frame."""
        motion, diagram, context = self.motion, self._diagram, self._context
        link_state = diagram.GetInputPort("link_state")
        link_state.FixValue(context, motion.states[number][: link_state.size()])
        if self._frames:
            poses = FramePoseVector()
            for constraint, frame in self._frames.items():
                values = own_values(constraint, motion.model.dae, motion.parameters[number])
                poses.set_value(frame, constraint.placement(values))
            diagram.GetInputPort("surroundings").FixValue(context, poses)
        query = diagram.GetOutputPort("query").Eval(context)
        image = query.RenderColorImage(self._camera, self._world, self.pose)
        return np.array(image.data[:, :, :3])


def _properties(color: Rgba) -> PerceptionProperties:
    properties = PerceptionProperties()
    properties.AddProperty("phong", "diffuse", color)
    properties.AddProperty("label", "id", RenderLabel.kDontCare)
    return properties


def _rendered(form: Shape | TriangleSurfaceMesh) -> Shape:
    """A shape that Drake renders; a triangle mesh becomes an .obj file in memory."""
    if isinstance(form, Shape):
        return form
    points = np.array(form.vertices())
    faces = np.array([[triangle.vertex(k) for k in range(3)] for triangle in form.triangles()])
    # The renderer needs normals at the vertices: the mean of the adjacent triangles' normals.
    corners, normals = points[faces], np.zeros_like(points)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for k in range(3):
        np.add.at(normals, faces[:, k], across)
    rows = ["v {:.9g} {:.9g} {:.9g}".format(*point) for point in points]
    rows += ["vn {:.9g} {:.9g} {:.9g}".format(*normal) for normal in normals]
    rows += ["f " + " ".join(f"{k}//{k}" for k in face) for face in faces + 1]
    return Mesh(InMemoryMesh(mesh_file=MemoryFile("\n".join(rows), ".obj", "surface")))
