"""The scene of a bench: Meshcat's page of a robot, and the poses of its parts as functions."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.tree import Frame
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.robots import (
    Constraint,
    ConstraintWrenches,
    PointCoordinates,
    RobotModel,
    rotation_of,
)
from drake_dae.scene.arrows import path_of
from drake_dae.scene.surroundings import scene_points
from drake_dae.scene.view import draw_scene, start_unwatched_meshcat, view_of_links
from drake_dae.systems.plants.contract import Plant

VISUALIZER = ("drake", "visualizer")
"""The path in Meshcat that contains the links."""

_BACKGROUND = [0.97, 0.97, 0.98]


@dataclass(frozen=True, eq=False)
class RobotScene:
    """The drawn parts of a robot.

    Attributes:
        plant: The plant of the robot.
        links: The name and the path in Meshcat of each moving body.
        constraints: The constraints that act at a point.
        with_moment: For each of `constraints`, whether it has a moment.
        surfaces: The constraints with a moving surface.
        targets: The outputs that are coordinates of a point.
        function: (link state, lambda, parameters) -> six columns, in the world: 12 numbers for each
            body, R by columns and p; points of application, forces and moments of all constraints;
            12 numbers for each surface; the point of each target.
    """

    plant: Plant
    links: Sequence[tuple[str, tuple[str, ...]]]
    constraints: Sequence[Constraint]
    with_moment: Sequence[bool]
    surfaces: Sequence[Constraint]
    targets: Sequence[PointCoordinates]
    function: ca.Function


@dataclass(frozen=True, eq=False)
class Scene:
    """The drawn robots.

    Attributes:
        page: Meshcat's page at the start, self-contained.
        robots: The drawn robots.
        size: The diagonal of the bounding box of the scene, in m.
    """

    page: str
    robots: Sequence[RobotScene]
    size: float

    @property
    def links(self) -> list[tuple[str, tuple[str, ...]]]:
        """The name and the path in Meshcat of each moving body."""
        return [link for robot in self.robots for link in robot.links]


def scene_of(
    plants: Sequence[Plant],
    scene_graph: SceneGraph | None,
    context: Context,
) -> Scene:
    """Returns the scene of robots.

    Args:
        plants: The plants of the robots.
        scene_graph: The geometry of their links, or None.
        context: The initial context of the diagram, which is not changed.

    Raises:
        ModelError: A plant is not a robot.
        OSError: There is no free port for Meshcat, which makes the page.
    """
    robots, points = list[RobotScene](), [np.zeros((0, 3))]
    states = [plant.state(plant.GetMyContextFromRoot(context)) for plant in plants]
    for plant, state in zip(plants, states, strict=True):
        robots.append(_robot_scene(plant, scene_graph))
        model = plant.robot("a bench")
        points.append(scene_points(model, ConstraintWrenches(model), state[None], scene_graph))
    corners = np.vstack(points)
    size = float(np.linalg.norm(np.ptp(corners, axis=0))) if corners.size else 1.0
    page = _static_page(plants, scene_graph, states)
    return Scene(page, robots, size)


def _robot_scene(plant: Plant, scene_graph: SceneGraph | None) -> RobotScene:
    model = plant.robot("a bench")
    bodies = _drawn_bodies(model, scene_graph)
    wrenches = ConstraintWrenches(model)
    surfaces = [c for c in model.constraints if _has_moving_surface(c, plant.is_ideal)]
    targets = [output for output in model.outputs if isinstance(output, PointCoordinates)]
    return RobotScene(
        plant,
        [(name, path) for name, path, _ in bodies],
        wrenches.constraints,
        wrenches.with_moment,
        surfaces,
        targets,
        _function(model, wrenches, [frame for _, _, frame in bodies], surfaces, targets),
    )


def _static_page(
    plants: Sequence[Plant],
    scene_graph: SceneGraph | None,
    states: Sequence[FloatArray],
) -> str:
    """Returns Meshcat's initial page, which does not depend on the server that made it."""
    meshcat = start_unwatched_meshcat()
    meshcat.SetProperty("/Background", "visible", True)
    for part in ("top_color", "bottom_color"):
        meshcat.SetProperty("/Background/<object>", part, _BACKGROUND)
    for plant, state in zip(plants, states, strict=True):
        draw_scene(plant, meshcat, scene_graph)
        links = view_of_links(plant, scene_graph, meshcat)
        if links is not None:
            view_context = links.CreateDefaultContext()
            port = links.get_input_port()
            port.FixValue(view_context, state[: port.size()])
            links.ForcedPublish(view_context)
    return str(meshcat.StaticHtml())


def _drawn_bodies(
    model: RobotModel, scene_graph: SceneGraph | None
) -> list[tuple[str, tuple[str, ...], Frame]]:
    """Returns name, path in Meshcat and frame of each moving body with geometry."""
    plant = model.links.plant
    if scene_graph is None or plant is None or plant.get_source_id() is None:
        return []
    inspector, bodies = scene_graph.model_inspector(), []
    for frame in inspector.GetAllFrameIds():
        body = plant.GetBodyFromFrameId(frame)
        if body is None or plant.IsAnchored(body) or not plant.GetVisualGeometriesForBody(body):
            continue
        path = (*VISUALIZER, *inspector.GetName(frame).split("::"))
        bodies.append((body.scoped_name().get_full(), path, body.body_frame()))
    return bodies


def _has_moving_surface(constraint: Constraint, is_ideal: bool) -> bool:
    """Returns whether a surface moves; in a compliant contact its parameters move it, too."""
    names = [p.name for p in constraint.parameters if p.exogenous or not is_ideal]
    return f"{constraint.name}.position" in names or f"{constraint.name}.rpy" in names


def _function(
    model: RobotModel,
    wrenches: ConstraintWrenches,
    bodies: Sequence[Frame],
    surfaces: Sequence[Constraint],
    targets: Sequence[PointCoordinates],
) -> ca.Function:
    links, dae = model.links, model.dae
    force = ca.SX.sym("force", dae.num_constraints)
    parameters = dae.parameter_symbol
    inputs = [links.q, links.v, force, parameters]
    wrench_columns = wrenches.function.function.call(inputs)[:3]
    surface_poses = list[ca.SX]()
    for constraint in surfaces:
        symbols = {parameter.name: parameter.symbol for parameter in constraint.parameters}
        rpy = symbols.get(f"{constraint.name}.rpy")
        surface_poses.append(ca.SX.eye(3) if rpy is None else rotation_of(rpy))
        surface_poses.append(symbols[f"{constraint.name}.position"])
    columns = [
        [part for body in bodies for part in (links.rotation(body), links.position(body))],
        *([column] for column in wrench_columns),
        surface_poses,
        [links.position(target.frame, target.point) for target in targets],
    ]
    value = [
        ca.vertcat(ca.SX(0, 1), *(ca.vec(ca.densify(part)) for part in parts)) for parts in columns
    ]
    arguments = [ca.vertcat(links.q, links.v), force, parameters]
    return ca.Function("scene", arguments, ca.cse(value))


def surface_direction(model: RobotModel, constraint: Constraint, state: FloatArray) -> FloatArray:
    """Returns the unit normal of a surface at its contact point, shape (3,).

    At zero velocity there is no friction, so that the contact force is along the normal.
    """
    wrenches = ConstraintWrenches(model)
    row = list(wrenches.constraints).index(constraint)
    rest = np.concatenate([state[: model.links.q.numel()], np.zeros(model.links.v.numel())])
    multipliers = np.ones(sum(len(c.force_signals) for c in model.constraints))
    force = wrenches(rest, multipliers).forces[row]
    return np.asarray(force / np.linalg.norm(force))


def path_in_meshcat(constraint: Constraint, part: str) -> list[str]:
    """Returns the path in Meshcat of a constraint's "force", "moment" or "surface"."""
    return path_of(constraint, part).strip("/").split("/")
