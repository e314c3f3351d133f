"""The wrenches of the constraints of a robot: point, force and moment of each.            (38)"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray
from drake_dae.dae import DaeSystem
from drake_dae.robots.constraints.constraint import Constraint
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.model import RobotModel
from drake_dae.trace.functions import TracedFunction


@dataclass(frozen=True, eq=False)
class Wrenches:
    """The wrenches of k constraints on a robot at one time, in the world, shapes (k, 3)."""

    points: FloatArray
    forces: FloatArray
    moments: FloatArray


class ConstraintWrenches:
    """The points, forces and moments of the constraints of a robot that act at a point.

    `frames` are those that they act on; `with_moment` says which have a moment besides the force.
    """

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
    """(x, parameters) -> the normal of each constraint of one force, toward the robot, (3 m, 1).

    It is the force on the robot per unit of constraint force without sliding, so without friction.
    """
    kinematics, v = model.links.kinematics(), model.links.v
    axes = [a.force_axes for _, _, a in ConstraintSet(model.constraints).acting(kinematics)]
    normals = ca.substitute(kinematics.value(ca.vertcat(ca.SX(0, 1), *axes)), v, 0 * v)
    return model.dae.trace("normals", {"normals": ca.densify(normals)})
