"""The links of a robot with springs in its joints, as a rigid robot."""

from typing import Any, cast

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError
from drake_dae.robots.constraints.plant_constraints import plant_constraints
from drake_dae.robots.links.kinematics import Reaction
from drake_dae.robots.links.links import Links
from drake_dae.robots.model import RobotModel


@checked(ModelError)
def link_side(model: RobotModel) -> RobotModel:
    """The links of a robot with springs in its joints, as a rigid robot,

        (M(q) - B) v' + H(q, v) = J(q)^T lambda + tau,

    whose control is the torque tau of the springs. The rotors B move with the shafts and do not
    belong to it. It has the symbols q and v, the constraints and the outputs of the robot.

    Args:
        model: A robot with springs in its joints.

    Raises:
        ModelError: The robot has no stage that carries its rotors.
    """
    if not any(stage.carries_rotors for stage in model.stages):
        raise ModelError(
            f"{model.name} has no springs in its joints, so that its links are not moved by springs"
        )
    links = cast(Links, _WithoutRotors(model.links))
    constraints = model.constraints[: len(model.constraints) - len(plant_constraints(model.links))]
    exogenous = [parameter.name for parameter in model.dae.parameters if parameter.exogenous]
    robot = RobotModel(
        links,
        constraints,
        model.outputs,
        model.nominal_positions,
        model.name,
        (),
        model.forces,
        exogenous,
        model.known_forces,
        compiled=model.dae.compiled,
    )
    bounds = {p.name: p.bounds for p in model.dae.parameters if p.bounds is not None}
    own = [p.name for p in robot.dae.parameters]
    robot.dae = robot.dae.with_bounds({n: pair for n, pair in bounds.items() if n in own})
    robot.control_limits = np.array(model.links.effort_limits)
    return robot


class _WithoutRotors:
    """The given links with an M that does not include the inertia of rotors."""

    def __init__(self, links: Links) -> None:
        self._links = links
        B = links.actuation_matrix
        self._rotors = np.asarray(B * links.reflected_inertia @ B.T)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._links, name)

    @property
    def mass_matrix(self) -> ca.SX:
        """M(q) without rotors, shape (nv, nv)."""
        return self._links.mass_matrix - ca.SX(ca.sparsify(ca.DM(self._rotors)))

    @property
    def reflected_inertia(self) -> FloatArray:
        """Zeros, shape (nu,)."""
        return np.zeros_like(self._links.reflected_inertia)

    def inverse_dynamics(self, kinematics: Any, reaction: Reaction) -> ca.SX:
        """M(q) v' + H(q, v) - tau of (37) with this M, shape (nv, 1)."""
        balance = self._links.inverse_dynamics(kinematics, reaction)
        rotors = ca.SX(ca.sparsify(ca.DM(self._rotors)))
        return balance - ca.mtimes(rotors, kinematics.acceleration)
