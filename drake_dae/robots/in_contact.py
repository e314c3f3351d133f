"""A robot in contact: the wrenches of its constraints (38), and links behind surfaces."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray
from drake_dae.dae import DaeSystem
from drake_dae.robots.constraint import Constraint, ConstraintSet, Touch
from drake_dae.robots.links import Links
from drake_dae.robots.model import RobotModel
from drake_dae.trace.functions import TracedFunction


@dataclass(frozen=True, eq=False)
class Wrenches:
    """The wrenches of k constraints on a robot at one time, in the world, shapes (k, 3)."""

    points: FloatArray
    forces: FloatArray
    moments: FloatArray


class ConstraintWrenches:
    """The wrenches of the `constraints` that act at a point, on `frames`; some `with_moment`."""

    def __init__(self, model: RobotModel, parameters: ArrayLike | None = None) -> None:
        links, bound = model.links, ConstraintSet(model.constraints)
        kinematics, force = links.kinematics(), ca.SX.sym("force", bound.size)
        acting = bound.acting(kinematics)
        self.constraints: Sequence[Constraint] = [constraint for constraint, _, _ in acting]
        self.frames = [a.frame_b for _, _, a in acting]
        self.with_moment = [a.moment_axes.nnz() > 0 for _, _, a in acting]
        columns = {
            "points": [a.point for _, _, a in acting],
            "forces": [a.force(force[part]) for _, part, a in acting],
            "moments": [ca.mtimes(a.moment_axes, force[part]) for _, part, a in acting],
        }
        self.function = TracedFunction(
            "constraint loads",
            {"q": links.q, "v": links.v, "force": force, "parameters": model.dae.parameter_symbol},
            {name: kinematics.value(ca.horzcat(ca.SX(3, 0), *c)) for name, c in columns.items()},
        )
        self._parameters = model.dae.parameter_vector(parameters).copy()
        self._parts = np.cumsum([links.q.numel(), links.v.numel()])

    def __call__(
        self, state: FloatArray, constraint_force: ArrayLike, parameters: ArrayLike | None = None
    ) -> Wrenches:
        """The wrenches at a state x, or link state (q, v), for lambda, shape (m,)."""
        q, v, _ = np.split(state, self._parts)
        values = self._parameters if parameters is None else parameters
        tables = self.function(q, v, constraint_force, values)
        return Wrenches(*(table.reshape(3, -1, order="F").T for table in tables))


def own_values(constraint: Constraint, dae: DaeSystem, parameters: FloatArray) -> FloatArray:
    """The values of a constraint's parameters in one vector, from those of the system."""
    values = [parameters[dae.parameter_slice(p.name)] for p in constraint.parameters]
    return np.concatenate([np.zeros(0), *values])


def contact_normals(model: RobotModel) -> TracedFunction:
    """(x, parameters) -> the force of each constraint at rest per unit of its lambda, (3 m, 1)."""
    kinematics, v = model.links.kinematics(), model.links.v
    axes = [a.force_axes for _, _, a in ConstraintSet(model.constraints).acting(kinematics)]
    normals = ca.substitute(kinematics.value(ca.vertcat(ca.SX(0, 1), *axes)), v, 0 * v)
    return model.dae.trace("normals", {"normals": ca.densify(normals)})


MOST_STATES, TOUCHING, BESIDE = 60, 1e-3, 0.02
"""The examined states of a motion. A point is behind a surface from this depth in m, and this
fraction of its distance from the contact, since tools lie along a surface."""

NEARER = 1.1
"""A real surface may end before the base, and does if the base is behind it: then a point counts if
it is nearer to the contact than to the base. Else this ratio holds, beyond the first link none."""


@dataclass(frozen=True)
class LinkBehind:
    """A link that is behind the surface of a constraint: its depth in m, and when in s."""

    constraint: str
    link: str
    depth: float
    time: float

    def __str__(self) -> str:
        where = f"behind the surface of '{self.constraint}'"
        return f"{self.link} is {where} by {self.depth:.3g} m at {self.time:.4g} s"


class LinkDepths:
    """How deep links are behind the surfaces of contacts; what moves with a contact is left out."""

    def __init__(self, links: Links, touches: Mapping[str, Touch], parameters: ca.SX) -> None:
        def moved_by(R: ca.SX, p: ca.SX) -> set[int]:
            """The places of the positions on which a pose depends."""
            pose = ca.vertcat(ca.vec(R), p)
            return set(np.flatnonzero(ca.which_depends(pose, links.q, 1, False)))

        at, point = [links.q, parameters], ca.SX.sym("point", 3)
        poses = [(links.rotation(o.frame), links.position(o.frame)) for o in links.outlines]
        every = [(o, *pose, moved_by(*pose)) for o, pose in zip(links.outlines, poses, strict=True)]
        base = [p for o, _, p, by in every if not by and o.name != "world"]
        bases = ca.horzcat(ca.SX(3, 0), *base)
        every = [each for each in every if each[3]]
        self.names = [o.name for o, *_ in every]
        self._points = [o.points.T for o, *_ in every]
        self._sizes = [len(o.points) for o, *_ in every]
        self._radii = np.repeat([o.radius for o, *_ in every], self._sizes)
        self._poses = ca.Function("poses", at, [ca.horzcat(R, p) for _, R, p, _ in every])
        self._surfaces = {}
        for name, touch in touches.items():
            contact = links.position(touch.frame, touch.point)
            held = moved_by(links.rotation(touch.frame), contact)
            counts = np.repeat([not held <= by for *_, by in every], self._sizes)
            inner = np.repeat([len(by) > 1 for *_, by in every], self._sizes)
            deepest = ca.mmax(ca.vertcat(-ca.inf, *[-touch.clearance(p) for p in base]))
            depth = ca.Function("depth", [point, *at], [-touch.clearance(point)])
            places = ca.Function("places", at, [contact, bases, deepest])
            self._surfaces[name] = depth, places, counts, inner

    def at(self, q: FloatArray, parameters: FloatArray) -> dict[str, FloatArray]:
        """Name of each constraint -> the depth of each link in m; 0 where it is in front."""
        poses = [pose.full() for pose in self._poses.call([q, parameters])]
        if not poses:
            return {}
        pairs = zip(poses, self._points, strict=True)
        world = np.hstack([pose[:, :3] @ points + pose[:, 3:] for pose, points in pairs])
        depths, starts = {}, np.cumsum([0, *self._sizes[:-1]])
        for name, (function, places, counts, inner) in self._surfaces.items():
            contact, bases, of_base = (v.full() for v in places(q, parameters))
            to_contact = np.linalg.norm(world - contact, axis=0)
            distances = [np.linalg.norm(world - base[:, None], axis=0) for base in bases.T]
            to_base = np.min([np.full(world.shape[1], np.inf), *distances], axis=0)
            depth = function(world, q, parameters).full().ravel() + self._radii
            in_front = of_base.item() < TOUCHING
            near = (to_contact < (NEARER if in_front else 1.0) * to_base) | (inner & in_front)
            behind = counts & near & (depth > np.maximum(TOUCHING, BESIDE * to_contact))
            depths[name] = np.maximum.reduceat(np.where(behind, depth, 0.0), starts)
        return depths


def links_behind(
    model: RobotModel, times: FloatArray, states: FloatArray, parameters: FloatArray
) -> tuple[LinkBehind, ...]:
    """The deepest link behind each surface along a motion, one row of each argument per time."""
    every = {c.name: c.touch(model.links) for c in model.constraints}
    touches = {name: touch for name, touch in every.items() if touch is not None}
    depths = LinkDepths(model.links, touches, model.dae.parameter_symbol)
    nq, last, found = model.links.q.numel(), len(times) - 1, []
    chosen = sorted({round(i) for i in np.linspace(0, last, MOST_STATES)} if last >= 0 else set())
    tables = [depths.at(states[i, :nq], parameters[i]) for i in chosen]
    for name in tables[0] if tables else ():
        table = np.array([one[name] for one in tables])
        row, link = np.unravel_index(np.argmax(table), table.shape)
        if (depth := float(table[row, link])) > 0.0:
            found.append(LinkBehind(name, depths.names[link], depth, float(times[chosen[row]])))
    return tuple(found)
