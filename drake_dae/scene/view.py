"""A constrained robot in Drake's Meshcat: links, surfaces and constraint forces."""

import errno
import logging
from collections.abc import Sequence

import numpy as np
from pydrake.geometry import (
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Rgba,
    SceneGraph,
)
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError
from drake_dae.robots import ConstraintWrenches
from drake_dae.scene.arrows import ConstraintForceVisualizer, ForceArrows, path_of
from drake_dae.scene.camera import direction_of, framed, view_angles
from drake_dae.scene.meshes import shrink_meshes
from drake_dae.scene.surroundings import (
    DrawnSurface,
    Floor,
    diagonal,
    floor_below,
    scene_points,
    surroundings,
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
    plant.add_own_view(builder, meshcat)


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
