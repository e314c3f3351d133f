"""A run of a robot as a film: rendered by Drake, without a screen and without a browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydrake.common import MemoryFile
from pydrake.geometry import (
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
from drake_dae.errors import ModelError
from drake_dae.simulation.animation import Loop, frame_times
from drake_dae.simulation.constraint_forces import ConstraintLoads, Loads, own_values
from drake_dae.simulation.record import Record
from drake_dae.simulation.view import RobotBlock, scene_extent

if TYPE_CHECKING:  # Loaded with the first film.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RATE = 10.0
"""Pictures per second of a film."""

STRIP = 4
"""Pictures of a strip."""

_WIDTH, _HEIGHT = 480, 400
_ANGLE = 0.62  # Of view, upwards, in rad.
_LEAST_FORCE = 0.02  # No arrow for what is less, beside the largest force of the run.

Pixels = NDArray[np.uint8]


@checked(ModelError)
def save_film(loop: Loop, record: Record, context: Context, path: str | Path) -> None:
    """Films a record of a robot with the paths and the forces of its contacts.

    Args:
        loop: A loop of a `RobotPlant` whose links have geometry.
        record: The record of a run of this loop.
        context: The context of its diagram, for the parameters; not changed.
        path: A .gif for the film, or a .png for four moments of it side by side.

    Raises:
        ModelError: There is no robot, nothing of it can be seen, or the file has another suffix.
        OSError: The file cannot be written.
    """
    kind, duration = Path(path).suffix, float(record.time[-1] - record.time[0])
    if kind not in (".gif", ".png"):
        raise ModelError(f"a film is a .gif, a strip of pictures a .png, got '{path}'")
    if not isinstance(loop.plant, RobotBlock):
        raise ModelError("a film needs a closed loop of a RobotPlant")
    replay = _Replay.of(loop.plant, record, context, frame_times(duration, RATE))
    scene, last = _Scene(loop.plant, loop.scene_graph, replay), len(replay.times) - 1
    if kind == ".gif":
        from matplotlib.animation import PillowWriter

        figure, (axis,) = _screen(1)
        writer = PillowWriter(fps=int(RATE))
        with writer.saving(figure, str(path), dpi=100):
            for number in range(last + 1):
                axis.clear()
                scene.draw(axis, replay, number)
                writer.grab_frame()
    else:
        figure, axes = _screen(STRIP)
        for place, axis in enumerate(axes):
            scene.draw(axis, replay, round(last * place / (STRIP - 1)))
        figure.savefig(path)


def _screen(columns: int) -> tuple[Figure, list[Axes]]:
    """A figure with room for so many pictures side by side."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(columns * _WIDTH / 100, _HEIGHT / 100), dpi=100)
    places = [(column / columns, 0.0, 1.0 / columns, 1.0) for column in range(columns)]
    return figure, [figure.add_axes(place) for place in places]


@dataclass(frozen=True, eq=False)
class _Replay:
    """A run at some moments.

    Attributes:
        times: The moments, s, shape (k,).
        states: x, shape (k, n).
        values: All parameters, one row each.
        course: What the constraints do, at each.
        parameters: Those that do not move.
        loads: What finds the course.
    """

    times: FloatArray
    states: FloatArray
    values: FloatArray
    course: list[Loads]
    parameters: FloatArray
    loads: ConstraintLoads

    @classmethod
    def of(cls, plant: RobotBlock, record: Record, context: Context, times: FloatArray) -> _Replay:
        """Between the rows of a record lie straight lines."""
        moments = record.time - record.time[0]

        def at(name: str) -> FloatArray:
            return np.column_stack([np.interp(times, moments, column) for column in record[name].T])

        parameters = plant.parameters(plant.GetMyContextFromRoot(context))
        loads = ConstraintLoads(plant.model, parameters)
        values = np.tile(parameters, (len(times), 1))
        if "exogenous" in record.signals:
            values[:, plant.exogenous_places] = at("exogenous")
        states = at("state")
        course = [
            loads(x, force, own)
            for x, force, own in zip(states, at("constraint_force"), values, strict=True)
        ]
        return cls(times + record.time[0], states, values, course, parameters, loads)


class _Camera:
    """A pinhole that looks at a point from an eye; the picture's y axis points down."""

    def __init__(self, eye: FloatArray, at: FloatArray, far: float) -> None:
        forward = (at - eye) / np.linalg.norm(at - eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        axes = np.column_stack([right, np.cross(forward, right), forward])
        self.pose = RigidTransform(RotationMatrix(axes), eye)
        self.info = CameraInfo(_WIDTH, _HEIGHT, _ANGLE)
        core = RenderCameraCore("film", self.info, ClippingRange(far / 100, far), RigidTransform())
        self.color = ColorRenderCamera(core)

    def project(self, points: FloatArray) -> FloatArray:
        """Where points in the world are seen, in pixels; shape (k, 2)."""
        x, y, depth = self.pose.inverse().multiply(np.atleast_2d(points).T)
        info = self.info
        return np.column_stack(
            [
                info.center_x() + info.focal_x() * x / depth,
                info.center_y() + info.focal_y() * y / depth,
            ]
        )


class _Scene:
    """The links and what they touch, before a camera."""

    def __init__(self, plant: RobotBlock, scene_graph: SceneGraph | None, replay: _Replay) -> None:
        model, links = plant.model, plant.model.links.plant
        if scene_graph is None or links is None or links.get_source_id() is None:
            raise ModelError("a film shows links with geometry; this robot has none")
        middle, self._size = scene_extent(model, replay.loads, replay.states[0])
        eye = middle + self._size * np.array([-1.55, -1.1, 0.8])
        self._camera = _Camera(eye, middle, 10.0 * self._size)
        self._model = model
        builder = DiagramBuilder()
        scene = builder.AddSystem(scene_graph.Clone())
        lights = [
            LightParameter(type="directional", direction=direction, frame="world", intensity=power)
            for direction, power in (([0.8, 0.6, -0.7], 1.0), ([-0.8, 0.2, -0.3], 0.4))
        ]
        parameters = RenderEngineVtkParams(default_clear_color=[1.0, 1.0, 1.0], lights=lights)
        scene.AddRenderer("film", MakeRenderEngineVtk(parameters))
        pose = builder.AddSystem(MultibodyPositionToGeometryPose(links, input_multibody_state=True))
        builder.ExportInput(pose.get_input_port(), "link_state")
        builder.Connect(pose.get_output_port(), scene.get_source_pose_port(links.get_source_id()))
        self._frames = {}
        source = scene.RegisterSource("surroundings")
        points = replay.course[0].points
        for constraint, point in zip(replay.loads.constraints, points, strict=True):
            own = own_values(constraint, model.dae, replay.parameters)
            picture = constraint.picture(own, point, self._size)
            if picture is None:
                continue
            frame = GeometryFrame(constraint.name)
            self._frames[constraint] = scene.RegisterFrame(source, frame)
            seen = GeometryInstance(
                constraint.placement(own).inverse() @ picture.pose,
                _shape(picture.form),
                constraint.name,
            )
            seen.set_perception_properties(_surface_properties())
            scene.RegisterGeometry(source, frame.id(), seen)
        if self._frames:
            builder.ExportInput(scene.get_source_pose_port(source), "surroundings")
        builder.ExportOutput(scene.get_query_output_port(), "query")
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._world = scene.world_frame_id()
        self._largest = max(
            float(np.linalg.norm(load.forces, axis=1).max(initial=0.0)) for load in replay.course
        )

    def draw(self, axis: Axes, replay: _Replay, number: int) -> None:
        """Draws the moment of that number, with the paths up to it."""
        axis.imshow(self._render(replay, number), interpolation="nearest")
        axis.set_axis_off()
        load = replay.course[number]
        for row, _ in enumerate(replay.loads.constraints):
            path = np.array([earlier.points[row] for earlier in replay.course[: number + 1]])
            axis.plot(*self._camera.project(path).T, color="#1f3fbf", linewidth=1.6)
            force = load.forces[row]
            size = float(np.linalg.norm(force))
            if size > _LEAST_FORCE * self._largest:
                ends = np.array([load.points[row], load.points[row]])
                ends[0] -= 0.25 * self._size * force / self._largest
                tail, head = self._camera.project(ends)
                axis.annotate(
                    f"{size:.1f} N",
                    head,
                    tail,
                    color="#d12b1f",
                    fontsize=11,
                    arrowprops={"color": "#d12b1f", "width": 2.5, "headwidth": 9, "headlength": 9},
                )
        axis.text(12, 24, f"t = {replay.times[number]:.1f} s", fontsize=11, color="0.25")
        axis.set_xlim(-0.5, _WIDTH - 0.5)
        axis.set_ylim(_HEIGHT - 0.5, -0.5)

    def _render(self, replay: _Replay, number: int) -> Pixels:
        link_state = self._diagram.GetInputPort("link_state")
        link_state.FixValue(self._context, replay.states[number][: link_state.size()])
        if self._frames:
            poses = FramePoseVector()
            for constraint, frame in self._frames.items():
                own = own_values(constraint, self._model.dae, replay.values[number])
                poses.set_value(frame, constraint.placement(own))
            self._diagram.GetInputPort("surroundings").FixValue(self._context, poses)
        query = self._diagram.GetOutputPort("query").Eval(self._context)
        image = query.RenderColorImage(self._camera.color, self._world, self._camera.pose)
        return np.array(image.data[:, :, :3])


def _shape(form: Shape | TriangleSurfaceMesh) -> Shape:
    """A form as what is rendered: a mesh as the text of an .obj file."""
    if isinstance(form, Shape):
        return form
    points = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in form.vertices()]
    faces = [
        "f " + " ".join(str(1 + triangle.vertex(corner)) for corner in range(3))
        for triangle in form.triangles()
    ]
    text = "\n".join([*points, *faces])
    return Mesh(InMemoryMesh(mesh_file=MemoryFile(text, ".obj", "surface")))


def _surface_properties() -> PerceptionProperties:
    properties = PerceptionProperties()
    properties.AddProperty("phong", "diffuse", Rgba(0.75, 0.85, 0.95, 0.5))
    properties.AddProperty("label", "id", RenderLabel.kDontCare)
    return properties
