"""What a bench draws: Meshcat's page of a robot, and what its parts follow, as functions."""

import gc
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from pydrake.geometry import Rgba, SceneGraph
from pydrake.multibody.tree import Frame
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.pictures.scene.arrows import path_of
from drake_dae.pictures.scene.surroundings import scene_points
from drake_dae.pictures.scene.view import draw_scene, start_unwatched_meshcat, view_of_links
from drake_dae.robots.constraint_wrenches import ConstraintWrenches
from drake_dae.robots.constraints.constraint import Constraint
from drake_dae.robots.model import RobotModel
from drake_dae.robots.outputs import PointCoordinates
from drake_dae.robots.surfaces.surface import rotation_of
from drake_dae.running.bench.posed import NO_BODIES, VISUALIZER, PosedBodies
from drake_dae.systems.plants.contract import Plant

_BACKGROUND = Rgba(0.97, 0.97, 0.98, 1.0)


@dataclass(frozen=True, eq=False)
class RobotScene:
    """What a bench draws of a robot.

    Attributes:
        plant: The robot.
        links: The name and the path in Meshcat of each body that moves.
        constraints: The constraints that act at a point.
        with_moment: Whether each of these has a moment.
        surfaces: The constraints whose surface moves.
        targets: The outputs that are coordinates of a point.
        function: (link state, lambda, parameters) -> six columns: 12 numbers for each body, R by
            columns and p; points of application, forces and moments of all constraints; 12 numbers
            for each surface; the point of each target, in the world.
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
    """What a bench draws.

    Attributes:
        page: Meshcat's page at the start, self-contained.
        robots: The robots.
        size: The size of the view, in m.
        posed: The bodies that Drake's SceneGraph poses, which stand before those of the robots.
    """

    page: str
    robots: Sequence[RobotScene]
    size: float
    posed: PosedBodies = NO_BODIES

    @property
    def links(self) -> list[tuple[str, tuple[str, ...]]]:
        """The name and the path in Meshcat of each body that moves."""
        return [*self.posed.links, *(link for one in self.robots for link in one.links)]


def scene_of(
    plants: Sequence[Plant],
    scene_graph: SceneGraph | None,
    context: Context,
    posed: PosedBodies = NO_BODIES,
) -> Scene:
    """The scene of robots.

    Args:
        plants: Their plants.
        scene_graph: The geometry of their links, or None.
        context: The context of the diagram at the start; not changed.
        posed: The bodies that Drake's SceneGraph poses.

    Raises:
        ModelError: A plant is no robot.
        OSError: There is no free port for Meshcat, which makes the page.
    """
    robots, seen = list[RobotScene](), [posed.corners(context)]
    states = [plant.state(plant.GetMyContextFromRoot(context)) for plant in plants]
    for plant, state in zip(plants, states, strict=True):
        robots.append(_robot_scene(plant, scene_graph))
        model = plant.robot("a bench")
        seen.append(scene_points(model, ConstraintWrenches(model), state[None], scene_graph))
    corners = np.vstack(seen)
    size = float(np.linalg.norm(np.ptp(corners, axis=0))) if corners.size else 1.0
    page = _static_page(plants, scene_graph, states, posed, context)
    # Drake's Meshcat ends the process if another thread, as of a server, collects it.
    gc.collect()
    return Scene(page, robots, size, posed)


def _robot_scene(plant: Plant, scene_graph: SceneGraph | None) -> RobotScene:
    model = plant.robot("a bench")
    drawn = _drawn_bodies(model, scene_graph)
    wrenches = ConstraintWrenches(model)
    surfaces = [each for each in model.constraints if _moves(each, plant.is_ideal)]
    targets = [each for each in model.outputs if isinstance(each, PointCoordinates)]
    return RobotScene(
        plant,
        [(name, path) for name, path, _ in drawn],
        wrenches.constraints,
        wrenches.with_moment,
        surfaces,
        targets,
        _function(model, wrenches, [frame for _, _, frame in drawn], surfaces, targets),
    )


def _static_page(
    plants: Sequence[Plant],
    scene_graph: SceneGraph | None,
    states: Sequence[FloatArray],
    posed: PosedBodies,
    context: Context,
) -> str:
    """Meshcat's page at the start, from a server that is gone afterwards."""
    meshcat = start_unwatched_meshcat()
    meshcat.SetProperty("/Background", "visible", True)
    for part in ("top_color", "bottom_color"):
        color = [_BACKGROUND.r(), _BACKGROUND.g(), _BACKGROUND.b()]
        meshcat.SetProperty("/Background/<object>", part, color)
    for plant, state in zip(plants, states, strict=True):
        draw_scene(plant, meshcat, scene_graph)
        links = view_of_links(plant, scene_graph, meshcat)
        if links is not None:
            shown = links.CreateDefaultContext()
            port = links.get_input_port()
            port.FixValue(shown, state[: port.size()])
            links.ForcedPublish(shown)
    posed.draw(meshcat, context, is_alone=not plants)
    return str(meshcat.StaticHtml())


def _drawn_bodies(
    model: RobotModel, scene_graph: SceneGraph | None
) -> list[tuple[str, tuple[str, ...], Frame]]:
    """Name, path in Meshcat and frame of each body with geometry that moves."""
    drawn = model.links.plant
    if scene_graph is None or drawn is None or drawn.get_source_id() is None:
        return []
    inspector, found = scene_graph.model_inspector(), []
    for number in inspector.GetAllFrameIds():
        body = drawn.GetBodyFromFrameId(number)
        if body is None or drawn.IsAnchored(body) or not drawn.GetVisualGeometriesForBody(body):
            continue
        path = (*VISUALIZER, *inspector.GetName(number).split("::"))
        found.append((body.scoped_name().get_full(), path, body.body_frame()))
    return found


def _moves(constraint: Constraint, is_ideal: bool) -> bool:
    """Whether a surface moves: of a compliant contact also by its parameters."""
    names = [each.name for each in constraint.parameters if each.exogenous or not is_ideal]
    return f"{constraint.name}.position" in names or f"{constraint.name}.rpy" in names


def _function(
    model: RobotModel,
    wrenches: ConstraintWrenches,
    bodies: Sequence[Frame],
    surfaces: Sequence[Constraint],
    targets: Sequence[PointCoordinates],
) -> ca.Function:
    links, dae = model.links, model.dae
    force = ca.SX.sym("force", wrenches.function.sizes[2])
    parameters = dae.parameter_symbol
    acting = wrenches.function.function.call([links.q, links.v, force, parameters])[:3]
    placed = list[ca.SX]()
    for constraint in surfaces:
        own = {each.name: each.symbol for each in constraint.parameters}
        rpy = own.get(f"{constraint.name}.rpy")
        placed.append(ca.SX.eye(3) if rpy is None else rotation_of(rpy))
        placed.append(own[f"{constraint.name}.position"])
    columns = [
        [part for body in bodies for part in (links.rotation(body), links.position(body))],
        *([part] for part in acting),
        placed,
        [links.position(each.frame, each.point) for each in targets],
    ]
    value = [
        ca.vertcat(ca.SX(0, 1), *(ca.vec(ca.densify(part)) for part in parts)) for parts in columns
    ]
    given = [ca.vertcat(links.q, links.v), force, parameters]
    return ca.Function("scene", given, ca.cse(value))


def surface_direction(model: RobotModel, constraint: Constraint, state: FloatArray) -> FloatArray:
    """The normal of a surface at its contact point, along which it is dragged, shape (3,).

    At rest there is no friction, so that the force is along it.
    """
    wrenches = ConstraintWrenches(model)
    row = list(wrenches.constraints).index(constraint)
    rest = np.concatenate([state[: model.links.q.numel()], np.zeros(model.links.v.numel())])
    push = np.concatenate(
        [np.zeros(0), *(np.ones(len(c.force_signals)) for c in model.constraints)]
    )
    force = wrenches(rest, push).forces[row]
    return np.asarray(force / np.linalg.norm(force))


def path_of_surface(constraint: Constraint) -> list[str]:
    """The path of a surface in Meshcat."""
    return path_of(constraint, "surface").strip("/").split("/")
