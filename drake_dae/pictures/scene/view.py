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
from drake_dae.pictures.scene.arrows import ConstraintForceVisualizer, ForceArrows, path_of
from drake_dae.pictures.scene.floor import Floor, floor_below
from drake_dae.pictures.scene.framing import ViewAngles, direction_of, framed
from drake_dae.pictures.scene.surroundings import (
    DrawnSurface,
    scene_extent,
    scene_points,
    surroundings,
)
from drake_dae.robots.constraint_wrenches import ConstraintWrenches
from drake_dae.systems.plants.contract import Plant

FRAME_RATE = 32.0
"""Frames per second of the live view and of the recording."""

_ON_REQUEST = 1e9
"""A publish period so long that only a forced publish draws."""


CAMERA_ANGLE = 0.7
"""The vertical angle of view, in rad."""

ASPECT = 4.0 / 3.0
"""The ratio of width and height that the camera is placed for; a wider window shows more."""

PIECE = 0.6
"""The side of a drawn piece of an unbounded surface, relative to the size of the scene."""

ARROW = 0.2
"""The length of the longest arrow, relative to the size of the scene."""

_FLOOR_COLOR = Rgba(0.8, 0.8, 0.8, 1.0)

_SURFACE_COLOR = Rgba(0.55, 0.65, 0.75, 0.45)


@checked(ModelError)
def start_meshcat(host: str = "localhost") -> Meshcat:
    """A Meshcat server, by default reachable only from this machine.

    Raises:
        OSError: There is no free port.
    """
    try:
        meshcat = Meshcat(MeshcatParams(host=host))
    except RuntimeError as error:
        raise OSError(errno.EADDRINUSE, f"no port for Meshcat: {error}") from None
    meshcat.SetProperty("/Background", "visible", False)
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    return meshcat


def start_unwatched_meshcat() -> Meshcat:
    """A Meshcat server for a page that is written: Drake does not print its address.

    Raises:
        OSError: There is no free port.
    """
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
    """Adds the live view of a robot, drawn `FRAME_RATE` times a second.

    Args:
        builder: The builder of the diagram, with the plant in it.
        plant: The plant; nothing is drawn if it is not a robot.
        scene_graph: The geometry of the MultibodyPlant that the links come from, or None.
        meshcat: The Meshcat to draw in.
        exogenous: The plant's port of that name, if any.
    """
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
    """Draws the static parts, and returns the force arrows.

    Args:
        plant: The robot.
        meshcat: The Meshcat to draw in.
        scene_graph: The geometry of its links, or None.

    Raises:
        ModelError: The plant is not a robot.
    """
    model, dae = plant.robot("a view"), plant.dae
    state = plant.structure.manifold.project(dae.nominal_state)
    wrenches = ConstraintWrenches(model)
    _, size = scene_extent(model, wrenches, state, scene_graph)
    points = wrenches(state, np.zeros(len(dae.force_signals))).points[None]
    touched = surroundings(model, wrenches, points, dae.parameter_values, PIECE * size)
    draw_surroundings(meshcat, touched)
    seen = scene_points(model, wrenches, state[None], scene_graph)
    draw_floor(meshcat, floor_below(seen, touched))
    direction = direction_of(seen, points[0], np.zeros_like(points[0]))
    look_at(meshcat, *framed(seen, direction, ViewAngles.of(CAMERA_ANGLE, ASPECT)))
    return ForceArrows(meshcat, model, ARROW * size)


def look_at(meshcat: Meshcat, eye: FloatArray, at: FloatArray) -> None:
    """Places the camera.

    Args:
        meshcat: The Meshcat.
        eye: The place of the camera, m, shape (3,).
        at: The point that it looks at, m, shape (3,).
    """
    meshcat.SetProperty("/Cameras/default/rotated/<object>", "fov", float(np.rad2deg(CAMERA_ANGLE)))
    meshcat.SetCameraPose(eye, at)


def draw_floor(meshcat: Meshcat, floor: Floor) -> None:
    """Draws the grid below a robot."""
    begin, end = (np.asfortranarray(each.T) for each in floor.lines)
    meshcat.SetLineSegments("/floor", begin, end, 1.0, _FLOOR_COLOR)


def view_of_links(
    plant: Plant, scene_graph: SceneGraph | None, meshcat: Meshcat, period: float = _ON_REQUEST
) -> Diagram | None:
    """Drake's own view of a robot, posed by our link state; its plant is not simulated.

    Args:
        plant: The robot.
        scene_graph: The geometry of the MultibodyPlant that the links come from, or None. The view
            has a copy of it.
        meshcat: The Meshcat to draw in.
        period: Time between pictures in s; if None they are drawn on request.

    Returns:
        A diagram with (q, v) as its input, or None if the links have no geometry.
    """
    drawn = plant.robot("a view").links.plant
    if scene_graph is None or drawn is None or drawn.get_source_id() is None:
        return None
    builder = DiagramBuilder()
    scene = builder.AddSystem(scene_graph.Clone())
    pose = builder.AddSystem(MultibodyPositionToGeometryPose(drawn, input_multibody_state=True))
    builder.ExportInput(pose.get_input_port(), "link_state")
    builder.Connect(pose.get_output_port(), scene.get_source_pose_port(drawn.get_source_id()))
    parameters = MeshcatVisualizerParams(publish_period=period)
    MeshcatVisualizer.AddToBuilder(builder, scene, meshcat, parameters)
    diagram = builder.Build()
    diagram.set_name("view_of_links")
    return diagram


def draw_surroundings(meshcat: Meshcat, seen: Sequence[DrawnSurface]) -> None:
    """Draws the surfaces in contact with a robot.

    Args:
        meshcat: The Meshcat to draw in.
        seen: The surfaces.
    """
    for one in seen:
        path = path_of(one.constraint, "surface")
        meshcat.SetObject(f"{path}/form", one.picture.form, rgba=_SURFACE_COLOR)
        meshcat.SetTransform(f"{path}/form", one.picture.pose)
        meshcat.SetTransform(path, one.stands)
