"""A constrained robot in Drake's Meshcat: links, surfaces and constraint forces."""

import errno
import logging
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import (
    InMemoryMesh,
    Mesh,
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Rgba,
    Role,
    SceneGraph,
    SourceId,
)
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, listed
from drake_dae.errors import GeometryWarning, ModelError
from drake_dae.files import read_mesh
from drake_dae.robots import ConstraintWrenches
from drake_dae.scene.arrows import ConstraintForceVisualizer, ForceArrows, path_of
from drake_dae.scene.surroundings import (
    DrawnSurface,
    Floor,
    diagonal,
    direction_of,
    floor_below,
    framed,
    scene_points,
    surroundings,
    view_angles,
)
from drake_dae.systems.plant import Plant

FRAME_RATE = 32.0
"""Frames per second of the live view and of the recording."""

_ON_REQUEST = 1e9  # a publish period in s, so long that only a forced publish draws

CAMERA_ANGLE, ASPECT = 0.7, 4.0 / 3.0
"""The vertical angle of view in rad, and the width of a window divided by its height, from which
the camera's position is computed; a wider window shows more."""

PIECE, ARROW = 0.6, 0.2
"""The side of a drawn piece of an unbounded surface, and the length of the longest arrow, as
fractions of the scene's size."""

_FLOOR_COLOR = Rgba(0.8, 0.8, 0.8, 1.0)
_SURFACE_COLOR = Rgba(0.55, 0.65, 0.75, 0.45)


@checked(ModelError)
def start_meshcat(host: str = "localhost") -> Meshcat:
    """Starts a Meshcat server on a network interface, "localhost" or "*" for all of them.

    By default only this computer can reach it. An OSError says that there is no free port.
    """
    try:
        meshcat = Meshcat(MeshcatParams(host=host))
    except RuntimeError as error:
        raise OSError(errno.EADDRINUSE, f"no port for Meshcat: {error}") from None
    for part in ("/Background", "/Grid", "/Axes"):
        meshcat.SetProperty(part, "visible", False)
    return meshcat


def start_unwatched_meshcat() -> Meshcat:
    """Starts a Meshcat server that only writes a page: Drake does not print its address."""
    log = logging.getLogger("drake")
    level = log.level
    log.setLevel(logging.WARNING)
    try:
        return start_meshcat()
    finally:
        log.setLevel(level)


def add_live_view(
    builder: DiagramBuilder,
    plant: Plant,
    scene_graph: SceneGraph | None,
    meshcat: Meshcat,
    exogenous: OutputPort | None = None,
) -> None:
    """Adds the view of a robot, drawn `FRAME_RATE` times a second, to a diagram with its plant."""
    if plant.model is None:
        return
    period = 1.0 / FRAME_RATE
    arrows = draw_scene(plant, meshcat, scene_graph)
    forces = builder.AddSystem(
        ConstraintForceVisualizer(arrows, meshcat, plant.model, plant.exogenous_places, period)
    )
    for name in ("link_state", "constraint_force"):
        builder.Connect(plant.GetOutputPort(name), forces.GetInputPort(name))
    if exogenous is not None:
        builder.Connect(exogenous, forces.GetInputPort("exogenous"))
    links = view_of_links(plant, scene_graph, meshcat, period)
    if links is not None:
        builder.AddSystem(links)
        builder.Connect(plant.GetOutputPort("link_state"), links.get_input_port())


def draw_scene(
    plant: Plant, meshcat: Meshcat, scene_graph: SceneGraph | None = None
) -> ForceArrows:
    """Draws the static parts of a robot's scene at its nominal state; returns the force arrows."""
    model, dae = plant.robot("a view"), plant.dae
    state = plant.structure.manifold.project(dae.nominal_state)
    wrenches = ConstraintWrenches(model)
    robot = scene_points(model, wrenches, state[None], scene_graph)
    size, points = diagonal(robot), wrenches(state, np.zeros(len(dae.force_signals))).points
    surfaces = surroundings(model, wrenches, points[None], dae.parameter_values, PIECE * size)
    draw_surroundings(meshcat, surfaces, floor_below(robot, surfaces))
    direction = direction_of(robot, points, np.zeros_like(points))
    look_at(meshcat, *framed(robot, direction, view_angles(CAMERA_ANGLE, ASPECT)))
    return ForceArrows(meshcat, model, ARROW * size)


def look_at(meshcat: Meshcat, eye: FloatArray, at: FloatArray) -> None:
    """Places the camera at a point `eye`, looking at a point `at`, m, shape (3,)."""
    meshcat.SetProperty("/Cameras/default/rotated/<object>", "fov", float(np.rad2deg(CAMERA_ANGLE)))
    meshcat.SetCameraPose(eye, at)


def draw_surroundings(meshcat: Meshcat, surfaces: Sequence[DrawnSurface], floor: Floor) -> None:
    """Draws the surfaces that a robot touches, and the grid below it."""
    begins, ends = np.asfortranarray(floor.begins.T), np.asfortranarray(floor.ends.T)
    meshcat.SetLineSegments("/floor", begins, ends, 1.0, _FLOOR_COLOR)
    for surface in surfaces:
        path = path_of(surface.constraint, "surface")
        meshcat.SetObject(f"{path}/form", surface.picture.form, rgba=_SURFACE_COLOR)
        meshcat.SetTransform(f"{path}/form", surface.picture.pose)
        meshcat.SetTransform(path, surface.pose)


def view_of_links(
    plant: Plant, scene_graph: SceneGraph | None, meshcat: Meshcat, period: float = _ON_REQUEST
) -> Diagram | None:
    """A diagram that draws a robot's links in Meshcat for its input, the link state (q, v).

    What is drawn on request, by a forced publish, goes into a page, with coarser meshes if these
    are large. None if the links have no geometry.
    """
    links = plant.robot("a view").links.plant
    if scene_graph is None or links is None or links.get_source_id() is None:
        return None
    builder = DiagramBuilder()
    scene = builder.AddSystem(scene_graph.Clone())
    if period == _ON_REQUEST:
        shrink_meshes(scene, links.get_source_id())
    pose = builder.AddSystem(MultibodyPositionToGeometryPose(links, input_multibody_state=True))
    builder.ExportInput(pose.get_input_port(), "link_state")
    builder.Connect(pose.get_output_port(), scene.get_source_pose_port(links.get_source_id()))
    parameters = MeshcatVisualizerParams(publish_period=period)
    MeshcatVisualizer.AddToBuilder(builder, scene, meshcat, parameters)
    diagram = builder.Build()
    diagram.set_name("view_of_links")
    return diagram


MOST_BYTES = 2 << 20  # of all meshes of a page

_CELLS = (128, 96, 64, 48, 32, 24, 16, 12, 8, 6, 4)


def shrink_meshes(scene: SceneGraph, source: SourceId) -> None:
    """Draws meshes of a source coarser, to `MOST_BYTES` together; leaves out what is unreadable."""
    inspector, sizes = scene.model_inspector(), {}
    for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
        shape = inspector.GetShape(geometry)
        if isinstance(shape, Mesh) and shape.source().is_path():
            file = Path(shape.source().path())
            sizes[geometry] = file.stat().st_size if file.is_file() else 0
    total, left, changed = sum(sizes.values()), MOST_BYTES, dict[str, None]()
    if total <= MOST_BYTES:
        return
    for number, geometry in enumerate(sorted(sizes, key=lambda each: sizes[each])):
        size, share = sizes[geometry], left // (len(sizes) - number)
        if size > share:
            mesh = inspector.GetShape(geometry)
            file, size = Path(mesh.source().path()), 0
            text = _coarser(file, share)
            if text is None:
                scene.RemoveRole(source, geometry, Role.kIllustration)
            else:
                data = InMemoryMesh(mesh_file=MemoryFile(text, ".obj", file.name))
                scene.ChangeShape(source, geometry, Mesh(data, mesh.scale3()))
                size = len(text)
            changed[file.name] = None
        left -= size
    warnings.warn(
        f"meshes of {total / 2**20:.3g} MB are drawn coarser in the page, with "
        f"{(MOST_BYTES - left) / 2**20:.2g} MB: {listed(changed)[1:-1]}",
        GeometryWarning,
        stacklevel=2,
    )


def _coarser(file: Path, most: int) -> str | None:
    """The text of an .obj of at most so many bytes, or None: the vertices in a grid's cell join."""
    try:
        vertices, triangles = read_mesh(file)
    except ModelError:
        return None
    if file.suffix.lower() in (".gltf", ".glb"):  # In which y is upward.
        vertices = vertices @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    low, length = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max())
    for cells in _CELLS:
        places = ((vertices - low) / (length / cells or 1.0)).astype(int)
        _, cluster, count = np.unique(places, axis=0, return_inverse=True, return_counts=True)
        cluster = cluster.ravel()
        points = np.column_stack([np.bincount(cluster, x) / count for x in vertices.T])
        a, b, c = cluster[triangles].T
        faces = np.unique(cluster[triangles][(a != b) & (b != c) & (c != a)], axis=0) + 1
        if 30 * len(points) + 15 * len(faces) > most:
            continue
        # No normals: Meshcat computes them.
        rows = ["v {:.5g} {:.5g} {:.5g}\n".format(*point) for point in points.tolist()]
        text = "".join([*rows, *("f {} {} {}\n".format(*face) for face in faces.tolist())])
        if len(text) <= most:
            return text
    return None
