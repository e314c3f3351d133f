"""What a bench draws: Meshcat's page of a robot, and what its parts follow, as functions."""

import gc
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from pydrake.geometry import Rgba
from pydrake.multibody.tree import Frame
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.pictures.scene.arrows import path_of
from drake_dae.pictures.scene.surroundings import scene_extent
from drake_dae.pictures.scene.view import draw_scene, start_unwatched_meshcat, view_of_links
from drake_dae.robots.constraint_wrenches import ConstraintWrenches
from drake_dae.robots.constraints.constraint import Constraint
from drake_dae.robots.model import RobotModel
from drake_dae.robots.outputs import PointCoordinates
from drake_dae.robots.surfaces.surface import rotation_of

VISUALIZER = ("drake", "visualizer")
"""The path of the links in Meshcat."""

_BACKGROUND = Rgba(0.97, 0.97, 0.98, 1.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """What a bench draws of a robot.

    Attributes:
        page: Meshcat's page with the robot at its start, self-contained.
        links: The name and the path in Meshcat of each body that moves.
        constraints: The constraints that act at a point.
        with_moment: Whether each of these has a moment.
        surfaces: The constraints whose surface moves.
        targets: The outputs that are coordinates of a point.
        size: The size of the view, in m.
        function: (link state, lambda, parameters) -> one column: for each body R, column by column,
            and p, 12 numbers; points of application, forces and moments of all constraints; 12
            numbers for each surface; the point of each target, in the world.
    """

    page: str
    links: Sequence[tuple[str, tuple[str, ...]]]
    constraints: Sequence[Constraint]
    with_moment: Sequence[bool]
    surfaces: Sequence[Constraint]
    targets: Sequence[PointCoordinates]
    size: float
    function: ca.Function


def scene_of(loop: ClosedLoop, context: Context) -> Scene:
    """The scene of a loop's robot.

    Args:
        loop: The loop.
        context: The context of its diagram at the start; not changed.

    Raises:
        ModelError: The plant is no robot.
        OSError: There is no free port for Meshcat, which makes the page.
    """
    plant = loop.plant
    model = plant.robot("a bench")
    drawn = _drawn_bodies(loop)
    wrenches = ConstraintWrenches(model)
    surfaces = [each for each in model.constraints if _moves(each)]
    targets = [each for each in model.outputs if isinstance(each, PointCoordinates)]
    state = plant.state(plant.GetMyContextFromRoot(context))
    _, size = scene_extent(model, wrenches, state, loop.scene_graph)
    page = _static_page(loop, state)
    # Drake's Meshcat ends the process if another thread, as of a server, collects it.
    gc.collect()
    return Scene(
        page,
        [(name, path) for name, path, _ in drawn],
        wrenches.constraints,
        wrenches.with_moment,
        surfaces,
        targets,
        size,
        _function(model, wrenches, [frame for _, _, frame in drawn], surfaces, targets),
    )


def _static_page(loop: ClosedLoop, state: FloatArray) -> str:
    """Meshcat's page of a robot in a state, from a server that is gone afterwards."""
    meshcat = start_unwatched_meshcat()
    meshcat.SetProperty("/Background", "visible", True)
    for part in ("top_color", "bottom_color"):
        color = [_BACKGROUND.r(), _BACKGROUND.g(), _BACKGROUND.b()]
        meshcat.SetProperty("/Background/<object>", part, color)
    draw_scene(loop.plant, meshcat, loop.scene_graph)
    links = view_of_links(loop.plant, loop.scene_graph, meshcat)
    if links is not None:
        shown = links.CreateDefaultContext()
        port = links.get_input_port()
        port.FixValue(shown, state[: port.size()])
        links.ForcedPublish(shown)
    return str(meshcat.StaticHtml())


def _drawn_bodies(loop: ClosedLoop) -> list[tuple[str, tuple[str, ...], Frame]]:
    """Name, path in Meshcat and frame of each body with geometry that moves."""
    drawn = loop.plant.robot("a bench").links.plant
    if loop.scene_graph is None or drawn is None or drawn.get_source_id() is None:
        return []
    inspector, found = loop.scene_graph.model_inspector(), []
    for number in inspector.GetAllFrameIds():
        body = drawn.GetBodyFromFrameId(number)
        if body is None or drawn.IsAnchored(body) or not drawn.GetVisualGeometriesForBody(body):
            continue
        path = (*VISUALIZER, *inspector.GetName(number).split("::"))
        found.append((body.scoped_name().get_full(), path, body.body_frame()))
    return found


def _moves(constraint: Constraint) -> bool:
    names = [each.name for each in constraint.parameters if each.exogenous]
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
    column = [
        part for body in bodies for part in (ca.vec(links.rotation(body)), links.position(body))
    ]
    parameters = dae.parameter_symbol
    column += wrenches.function.function.call([links.q, links.v, force, parameters])[:3]
    for constraint in surfaces:
        own = {each.name: each.symbol for each in constraint.parameters}
        rpy = own.get(f"{constraint.name}.rpy")
        column += [
            ca.SX.eye(3) if rpy is None else rotation_of(rpy),
            own[f"{constraint.name}.position"],
        ]
    column += [links.position(each.frame, each.point) for each in targets]
    flat = [ca.vec(ca.densify(part)) for part in column]
    value = ca.cse([ca.densify(ca.vertcat(ca.SX(0, 1), *flat))])
    return ca.Function("scene", [ca.vertcat(links.q, links.v), force, parameters], value)


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
