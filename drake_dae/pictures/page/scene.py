"""The scene of a page: Meshcat's drawing of robots, and the poses of its parts as expressions."""

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.tree import Frame

from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import stacked
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
from drake_dae.systems.plant import Plant

_BACKGROUND = [0.97, 0.97, 0.98]


class RobotScene:
    """The drawn parts of a robot.

    Moving bodies have name, path in Meshcat and frame; `surfaces` move, and `targets` are
    outputs that are coordinates of a point.
    """

    def __init__(self, plant: Plant, scene_graph: SceneGraph | None) -> None:
        model, self.plant = plant.robot("a page"), plant
        self.bodies, self.wrenches = _drawn_bodies(model, scene_graph), ConstraintWrenches(model)
        surfaces = [c for c in model.constraints if _has_moving_surface(c, plant.is_ideal)]
        self.surfaces: list[Constraint] = surfaces
        self.targets = [each for each in model.outputs if isinstance(each, PointCoordinates)]

    def columns(self, state: ca.SX, force: ca.SX, parameters: ca.SX) -> ca.SX:
        """Numbers in the world, as one column of expressions.

        12 for each body, R by columns and p; points of application, forces and moments of
        all constraints; 12 for each surface; the point of each target.
        """
        model = self.plant.robot("a page")
        links = model.links
        symbols = [ca.vertcat(links.q, links.v), ca.SX.sym("force", model.dae.num_constraints)]
        symbols.append(model.dae.parameter_symbol)
        loads = self.wrenches.function.function.call([links.q, links.v, *symbols[1:]])[:3]
        surfaces = list[ca.SX]()
        for constraint in self.surfaces:
            named = {parameter.name: parameter.symbol for parameter in constraint.parameters}
            rpy = named.get(f"{constraint.name}.rpy")
            surfaces.append(ca.SX.eye(3) if rpy is None else rotation_of(rpy))
            surfaces.append(named[f"{constraint.name}.position"])
        poses = [p for _, _, f in self.bodies for p in (links.rotation(f), links.position(f))]
        points = [links.position(target.frame, target.point) for target in self.targets]
        parts = [ca.vec(ca.densify(part)) for part in (*poses, *loads, *surfaces, *points)]
        function = ca.Function("scene", symbols, ca.cse([stacked(parts)]))
        return function(state[: symbols[0].numel()], force, parameters)

    def data(self, state: FloatArray, slider: Callable[[str, str], int | None]) -> dict[str, Any]:
        """What the browser knows of these parts; `slider` gives the index of a slider."""
        model, acting = self.plant.robot("a page"), list(self.wrenches.constraints)
        names = [signal.name for signal in self.plant.dae.output_signals]
        constraints = [
            {
                "name": constraint.name,
                "force": _path(constraint, "force"),
                "moment": _path(constraint, "moment") if has_moment else None,
            }
            for constraint, has_moment in zip(acting, self.wrenches.with_moment, strict=True)
        ]
        surfaces = []
        for surface in self.surfaces:
            position = next(p for p in surface.parameters if p.name == f"{surface.name}.position")
            direction = self._normal(surface, state).tolist() if surface in acting else None
            surfaces.append(
                {
                    "name": surface.name,
                    "path": _path(surface, "surface"),
                    "controls": [slider("surface", s.name) for s in position.signals],
                    "direction": direction,
                }
            )
        targets = []
        for target in self.targets:
            signals = zip(target.axes, target.signals(model.links), strict=True)
            axes = [("xyz".index(axis), signal.name) for axis, signal in signals]
            commanded = [(axis, slider("reference", name)) for axis, name in axes]
            targets.append(
                {
                    "name": target.name or target.frame,
                    "axes": [[axis, place] for axis, place in commanded if place is not None],
                    "outputs": [[axis, names.index(name)] for axis, name in axes],
                }
            )
        bodies = [{"name": name, "path": path} for name, path, _ in self.bodies]
        return {
            "bodies": bodies,
            "constraints": constraints,
            "surfaces": surfaces,
            "targets": targets,
        }

    def _normal(self, surface: Constraint, state: FloatArray) -> FloatArray:
        """The unit normal of a surface at its contact point: of the force at rest."""
        model = self.plant.robot("a page")
        rest = np.concatenate([state[: model.links.q.numel()], np.zeros(model.links.v.numel())])
        multipliers = np.ones(sum(len(c.force_signals) for c in model.constraints))
        row = list(self.wrenches.constraints).index(surface)
        force = self.wrenches(rest, multipliers).forces[row]
        return np.asarray(force / np.linalg.norm(force))


def scene_size(robot: RobotScene, state: FloatArray, scene_graph: SceneGraph | None) -> float:
    """The diagonal of the bounding box of the drawn robot, in m."""
    model = robot.plant.robot("a page")
    corners = scene_points(model, robot.wrenches, state[None], scene_graph)
    return float(np.linalg.norm(np.ptp(corners, axis=0)))


def meshcat_page(robot: RobotScene, state: FloatArray, scene_graph: SceneGraph | None) -> str:
    """Meshcat's page at the start, self-contained."""
    meshcat = start_unwatched_meshcat()
    meshcat.SetProperty("/Background", "visible", True)
    for part in ("top_color", "bottom_color"):
        meshcat.SetProperty("/Background/<object>", part, _BACKGROUND)
    draw_scene(robot.plant, meshcat, scene_graph)
    links = view_of_links(robot.plant, scene_graph, meshcat)
    if links is not None:
        context, port = links.CreateDefaultContext(), links.get_input_port()
        port.FixValue(context, state[: port.size()])
        links.ForcedPublish(context)
    return str(meshcat.StaticHtml())


def _drawn_bodies(
    model: RobotModel, scene_graph: SceneGraph | None
) -> list[tuple[str, tuple[str, ...], Frame]]:
    """Name, path in Meshcat and frame of each moving body with geometry."""
    plant = model.links.plant
    if scene_graph is None or plant is None or plant.get_source_id() is None:
        return []
    inspector, bodies = scene_graph.model_inspector(), []
    for frame in inspector.GetAllFrameIds():
        body = plant.GetBodyFromFrameId(frame)
        if body is None or plant.IsAnchored(body) or not plant.GetVisualGeometriesForBody(body):
            continue
        path = ("drake", "visualizer", *inspector.GetName(frame).split("::"))
        bodies.append((body.scoped_name().get_full(), path, body.body_frame()))
    return bodies


def _has_moving_surface(constraint: Constraint, is_ideal: bool) -> bool:
    """Whether a surface moves; in a compliant contact its parameters move it, too."""
    names = [p.name for p in constraint.parameters if p.exogenous or not is_ideal]
    return f"{constraint.name}.position" in names or f"{constraint.name}.rpy" in names


def _path(constraint: Constraint, part: str) -> list[str]:
    """The path in Meshcat of a constraint's "force", "moment" or "surface"."""
    return path_of(constraint, part).strip("/").split("/")
