"""The equations of a robot in compliant point contact, as traced functions."""

from functools import reduce

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae import ConstraintStructure
from drake_dae.errors import ModelError
from drake_dae.robots import RobotModel
from drake_dae.systems.plants.contact.contact_laws import (
    Compliance,
    contact_force,
    contact_step,
)
from drake_dae.systems.plants.contact.contact_material import PointMaterial
from drake_dae.systems.plants.contact.point_contact import ball_normals, point_contacts, touching
from drake_dae.systems.plants.contact.stage_steps import stage_rates, stages_after
from drake_dae.systems.plants.robot_plant import joint_outputs
from drake_dae.trace.factorization import PositiveDefiniteFactorization
from drake_dae.trace.functions import TracedFunction

FITS = 1e-3
"""The allowed depth of a ball at its contact point, relative to its radius."""

OUTSIDE = (
    "a joint reaches its limit, and this plant has no stops, or the forces of stiff contacts are "
    "not found; `plant: !MultibodyPlant` has stops"
)
"""The reason why a `CompliantPlant` cannot continue."""


class CompliantEquations:
    """The functions of a `CompliantPlant`, of (state, control, parameters).

    The state is x, or (x, F) for a discrete plant. Parameters are those of the system, followed by
    `PointMaterial.values` and `ball_normals` of the nominal configuration: see `own_parameters`.

    Args:
        model: The robot.
        structure: The structure of its system.
        material: The contact material.

    Attributes:
        control, force, parameters: The symbols of u, of the contact forces F, and of all
            parameters.
        advanced: x', or (x, F) after a step.
        slack: A number that is negative where `advanced` does not hold.
        outputs: Name of an output port -> its expression.
    """

    def __init__(
        self, model: RobotModel, structure: ConstraintStructure, material: PointMaterial
    ) -> None:
        dae, self._model, self._h = model.dae, model, material.time_step
        self._structure = structure
        numbers = ca.SX.sym("material", 4)
        normals = ca.SX.sym("normals", 3 * len(model.constraints))
        self._compliance = Compliance(numbers[0], numbers[1], material.stiction_tolerance)
        friction = None if material.friction is None else numbers[2]
        self._contacts = point_contacts(model, normals, numbers[3], friction)
        self.control = ca.SX.sym("u", dae.num_controls)
        self.force = ca.SX.sym("F", 3 * len(self._contacts))
        self.parameters = ca.vertcat(dae.parameter_symbol, numbers, normals)
        self.advanced, self.slack = (self._step if self._h else self._rate)(self.control)
        self.outputs = self._outputs(structure, self.force if self._h else self._forces())
        self._normals = dae.trace("normals", {"normals": ball_normals(model)}, often=False)
        depths = ca.vertcat(*(contact.depth for contact in self._contacts))
        inputs = {"state": dae.state, "parameters": self.parameters}
        self._depths = TracedFunction("depths", inputs, {"depths": depths}, often=False)

    def own_parameters(self, values: FloatArray, material: PointMaterial) -> FloatArray:
        """All parameters, with the balls placed where they touch in the nominal configuration.

        Args:
            values: The values of the system's parameters.
            material: The contact material.

        Raises:
            ModelError: A ball does not fit there.
        """
        dae, manifold = self._model.dae, self._structure.manifold
        state = manifold.project(dae.nominal_state, values)
        normals = self._normals(state, values)[0]
        parameters = np.concatenate([values, material.values, normals])
        depths = self._depths(state, parameters)[0]
        for constraint, depth in zip(self._model.constraints, depths.tolist(), strict=True):
            if not depth <= FITS * material.radius:
                raise ModelError(
                    f"a ball with a radius of {material.radius:g} m does not fit "
                    f"'{constraint.name}' where it shall touch, since the surface bends toward it "
                    "more than the ball does: take a smaller radius"
                )
        return parameters

    def _balance(self, control: ca.SX) -> tuple[ca.SX, ca.SX]:
        """M and tau - H without contact, with torques within the limits of the actuators."""
        model, dae, links = self._model, self._model.dae, self._model.links
        nq, nv = links.q.numel(), links.v.numel()
        part = slice(nq, nq + nv)
        viscous = [
            parameter.symbol
            for constraint in model.constraints
            for parameter in constraint.parameters
            if parameter.name == f"{constraint.name}.viscous_friction"
        ]
        # Viscous friction belongs to the contacts here.
        forces = dae.f[part]
        if viscous:
            forces = ca.substitute(forces, ca.vertcat(*viscous), ca.DM.zeros(len(viscous)))
        limits = ca.DM(links.effort_limits)
        torque = control if model.joint_force is None else model.joint_force
        within = ca.fmin(ca.fmax(torque, -limits), limits)
        if model.joint_force is not None:
            within -= model.joint_force  # It is also part of f.
        drive = ca.mtimes(ca.SX(ca.sparsify(ca.DM(links.actuation_matrix))), within)
        return dae.mass_matrix[part, part], forces + drive

    def _forces(self) -> ca.SX:
        """The force of each ball of a continuous plant."""
        v = self._model.links.v
        return ca.vertcat(
            *(contact_force(contact, v, self._compliance) for contact in self._contacts)
        )

    def _rate(self, control: ca.SX) -> tuple[ca.SX, ca.SX]:
        """x' of a continuous plant, and a number that is negative where it is not valid."""
        model, links = self._model, self._model.links
        mass, forces = self._balance(control)
        jacobian = ca.vertcat(*(contact.jacobian for contact in self._contacts))
        forces += ca.mtimes(jacobian.T, self._forces())
        change = PositiveDefiniteFactorization(mass).solve(forces)
        velocity = ca.mtimes(links.velocity_map, links.v)
        rate = ca.vertcat(velocity, change, stage_rates(model, control))
        return rate, self._within_limits(links.q)

    def _step(self, control: ca.SX) -> tuple[ca.SX, ca.SX]:
        """(x, F) after a step, and a number that is negative where they are not valid."""
        model, links, h = self._model, self._model.links, self._h
        mass, forces = self._balance(control)
        mass += h * (ca.diag(ca.DM(_damping(model))) + _resistance(model))
        free = links.v + h * PositiveDefiniteFactorization(mass).solve(forces)
        step = contact_step(self._contacts, links.v, free, mass, h, self._compliance)
        velocity = ca.mtimes(links.velocity_map, step.velocities)
        # Drake's stops push if a joint would pass its limit within two steps.
        ahead = self._within_limits(links.q + 2.0 * h * velocity)
        stages = stages_after(model, h, control) if model.stages else ca.SX(0, 1)
        after = ca.vertcat(links.q + h * velocity, step.velocities, stages, step.forces)
        return after, ca.fmin(step.slack, ahead)

    def _within_limits(self, q: ca.SX) -> ca.SX:
        """The least distance of joints from their limits; negative beyond one."""
        low, high = self._model.links.position_limits
        gaps = [q[i] - low[i] for i in np.flatnonzero(np.isfinite(low)).tolist()]
        gaps += [high[i] - q[i] for i in np.flatnonzero(np.isfinite(high)).tolist()]
        return reduce(ca.fmin, gaps, ca.SX(1))

    def _outputs(self, structure: ConstraintStructure, contact: ca.SX) -> dict[str, ca.SX]:
        """The output ports as expressions of the state and the contact forces."""
        dae = self._model.dae
        normals = ca.horzcat(*(touch.normal for _, touch in touching(self._model)))
        force = ca.sum1(normals * ca.reshape(contact, 3, -1)).T
        return {
            "state": dae.state,
            **joint_outputs(self._model),
            "contact_force": contact,
            "constraint_force": force,
            "constraint_residual": structure.manifold.residual_expression,
            "controlled_output": dae.outputs(force),
        }


def _resistance(model: RobotModel) -> ca.SX:
    """D of the friction -D v of joints, at the velocities before the step, shape (nv, nv)."""
    kinematics = model.links.kinematics()
    size = model.links.v.numel()
    return sum((load.resistance(kinematics) for load in model.known_forces), ca.SX(size, size))


def _damping(model: RobotModel) -> FloatArray:
    """The damping of the joints, which Drake takes implicitly, shape (nv,)."""
    damping, plant = np.zeros(model.links.v.numel()), model.links.plant
    if plant is not None:
        for index in plant.GetJointIndices():
            joint = plant.get_joint(index)
            first = joint.velocity_start()
            damping[first : first + joint.num_velocities()] = joint.default_damping_vector()
    return damping
