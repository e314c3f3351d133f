"""A robot in compliant point contact, as Drake computes it, as traced equations."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import Block, Held, Requirement, stacked
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.dae import ConstraintStructure, Signal, find_constraint_structure, structure_of
from drake_dae.errors import ModelError
from drake_dae.robots import RobotModel
from drake_dae.systems.contact_laws import (
    FRICTION,
    PointContact,
    PointMaterial,
    ball_normals,
    contact_force,
    contact_force_signals,
    contact_step,
    point_contacts,
    touching,
)
from drake_dae.systems.ideal_plants import joint_outputs
from drake_dae.systems.plant import ParameterizedSystem, Plant, changed_parameters, port_signals
from drake_dae.trace.factorization import PositiveDefiniteFactorization
from drake_dae.trace.functions import FailureKind

FITS = 1e-3  # the allowed depth of a ball at its contact point, relative to its radius

OUTSIDE = (
    "a joint reaches its limit, and this plant has no stops, or the forces of stiff contacts are "
    "not found; `plant: !MultibodyPlant` has stops"
)


@checked(ModelError)
class CompliantPlant(ParameterizedSystem, Plant):
    """A robot whose contacts are compliant, by Drake's equations of point contact.

    Unlike those of a `ContactPlant` its surfaces may have any shape and move. Each `PointOnSurface`
    touches with a ball; nothing else of the robot collides.

    With `time_step` > 0 it is discrete: at t_n = n time_step, with the control of that instant,

        A (v_+ - v*) = J^T gamma,    v* = v + h A^-1 (tau - H),    q_+ = q + h N(q) v_+,

    A = M + h D with the damping D of the joints, and the impulses gamma of `contact_step`: Drake's
    discrete MultibodyPlant with its default, the "lagged" approximation. Stages of actuation step
    as `stages_after`. With `time_step` = 0 it is continuous,

        M v' + H = tau + J^T F,

    with the forces F of `contact_force`, those of a continuous MultibodyPlant. Torques beyond the
    effort limits are cut to them, as Drake does; a joint that reaches its limit ends the run.

    Input ports:
        control: u, shape (p,).
        exogenous: The signals w with their derivatives, if there are any.

    Output ports:
        state, link_state, joint_torque, and the ports of the stages: as for `RobotPlant`.
        contact_force: F of each contact on the robot, N, shape (3 m,), with friction, in the world.
        constraint_force: lambda = n(q) . F, N, shape (m,).
        constraint_residual: phi and phi', as for `DaePlant`; not zero in compliant contact.
        controlled_output: z = l(x) + m(x) lambda.

    Args:
        model: The robot; each constraint a `PointOnSurface`.
        material: The contact material.
        structure: The structure of the model's system; found if None.
        parameters: Parameter name -> the default of the plant; that of the model if left out.

    Raises:
        ModelError: A constraint is no contact of a point with a surface, a ball does not fit its
            surface, or the step is too long for the stages.
        SimulationError: A joint reaches its limit in a run, or a step has no solution.
    """

    __slots__ = SHARED_DICTIONARY
    is_ideal = False

    def __init__(
        self,
        model: RobotModel,
        material: PointMaterial,
        *,
        structure: ConstraintStructure | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        dae, count = model.dae, len(model.constraints)
        values = dae.parameter_vector(changed_parameters(model, parameters or {}))
        self.model: RobotModel = model
        self.structure = structure_of(dae, structure, find_constraint_structure)
        self.time_step, self.material = material.time_step, material
        self._checked_step = np.zeros(0)
        numbers = ca.SX.sym("material", material.values.size)
        normals = ca.SX.sym("normals", 3 * count)
        contacts = point_contacts(model, normals, numbers, material)
        # The balls in the nominal configuration, and how deep they are where they shall touch.
        placed, depths = ball_normals(model), ca.vertcat(*(contact.depth for contact in contacts))
        balls = {"normals": placed, "depths": ca.substitute(depths, normals, placed)}
        self._balls = dae.trace("balls", balls, {"material": numbers}, often=False)
        start = {
            "state": self.structure.manifold.project(dae.nominal_state, values),
            "parameters": self._placed(values, material),
        }
        block = compliant_block(model, self.structure, material, contacts, start)
        own = ca.vertcat(dae.parameter_symbol, numbers, normals)
        super().__init__(dae, replace(block, parameters=own))

    @property
    def further_signals(self) -> Mapping[str, Sequence[Signal]]:
        return {"contact_force": self.block.signals["contact_force"]}

    def friction(self, context: Context) -> dict[str, float]:
        if self.material.friction is None:
            return super().friction(context)
        place = self.dae.parameter_symbol.numel() + self.material.signals.index(FRICTION)
        value = float(context.get_numeric_parameter(0).GetAtIndex(place))
        return {constraint.name: value for constraint in self.robot("friction").constraints}

    def state(self, context: Context) -> FloatArray:
        if not self.time_step:
            return super().state(context)
        self.check_context(context)
        return context.get_discrete_state(0).CopyToVector()

    def set_state(self, context: Context, state: ArrayLike) -> None:
        """Sets x as given, shape (n,), in contact or not; another shape is a ModelError."""
        if not self.time_step:
            super().set_state(context, state)
            return
        self.check_context(context)
        context.SetDiscreteState(0, self.dae.state_vector(state))
        context.SetDiscreteState(1, np.zeros(3 * len(self.model.constraints)))

    @checked(ModelError)
    def set_contact(self, context: Context, material: PointMaterial) -> None:
        """Sets stiffness, dissipation, friction and radius, and places the balls on the robot.

        In the nominal configuration, with the parameters of the context, a ball touches at the
        point of its constraint. A ModelError says that the material has another time_step or
        stiction_tolerance than the plant, or a friction although that has none; that a ball does
        not fit its surface; or that the step does not fit the stages.
        """
        fixed, wanted = (
            (given.time_step, given.stiction_tolerance, given.friction is None)
            for given in (self.material, material)
        )
        if fixed != wanted:
            raise ModelError(
                f"{self.dae.name}: the plant was made with {self.material}; only its stiffness, "
                f"dissipation, radius and a number of its friction may change, got {material}"
            )
        placed = self._placed(self.parameters(context), material)
        context.get_mutable_numeric_parameter(0).SetFromVector(placed)

    def _placed(self, values: FloatArray, material: PointMaterial) -> FloatArray:
        """Those of the system, `PointMaterial.values`, and `ball_normals`, if the balls fit."""
        model = self.model
        if model.stages and self.time_step and not np.array_equal(values, self._checked_step):
            check_step(model, self.time_step, values)
            self._checked_step = values.copy()
        state = self.structure.manifold.project(model.dae.nominal_state, values)
        normals, depths = (v.copy() for v in self._balls(state, material.values, values))
        for constraint, depth in zip(model.constraints, depths.tolist(), strict=True):
            if not depth <= FITS * material.radius:
                raise ModelError(
                    f"a ball with a radius of {material.radius:g} m does not fit "
                    f"'{constraint.name}' where it shall touch, since the surface bends toward it "
                    "more than the ball does: take a smaller radius"
                )
        return np.concatenate([values, material.values, normals])


def compliant_block(
    model: RobotModel,
    structure: ConstraintStructure,
    material: PointMaterial,
    contacts: Sequence[PointContact],
    start: Mapping[str, FloatArray],
) -> Block:
    """The equations of a `CompliantPlant`, whose state is x, or (x, F) if it is discrete."""
    dae, period, names = model.dae, material.time_step, contact_force_signals(model)
    control, force = ca.SX.sym("u", dae.num_controls), ca.SX.sym("F", len(names))
    if period:
        advanced, slack = _step(model, contacts, control, period)
    else:  # x'
        force = ca.vertcat(*(contact_force(contact, model.links.v) for contact in contacts))
        mass, forces = _balance(model, control)
        jacobian = ca.vertcat(*(contact.jacobian for contact in contacts))
        change = PositiveDefiniteFactorization(mass).solve(forces + ca.mtimes(jacobian.T, force))
        velocity = ca.mtimes(model.links.velocity_map, model.links.v)
        advanced = ca.vertcat(velocity, change, stage_rates(model, control))
        slack = _within_limits(model, model.links.q)
    fits = Requirement(slack, OUTSIDE, FailureKind.OUTSIDE)
    advanced = fits.of(advanced)
    normals = ca.horzcat(*(touch.normal for _, touch in touching(model)))
    lambdas = ca.sum1(normals * ca.reshape(force, 3, -1)).T
    block = Block(
        dae.name,
        inputs={"control": control},
        outputs={
            "state": dae.state,
            **joint_outputs(model),
            "contact_force": force,
            "constraint_force": lambdas,
            "constraint_residual": structure.manifold.residual_expression,
            "controlled_output": dae.outputs(lambdas),
        },
        start=start,
        requirements=(fits,),
        signals={
            **port_signals(structure),
            "control": dae.control_signals,
            "contact_force": names,
            "parameters": [*dae.parameter_signals, *material.signals],
        },
    )
    if not period:
        return replace(block, state=dae.state, derivative=advanced, scale=dae.scale)
    after, pushed = ca.vertsplit(advanced, [0, dae.num_states, advanced.numel()])
    held = {
        "state": Held(dae.state, after, start["state"], period),
        "contact_force": Held(force, pushed, np.zeros(len(names)), period),
    }
    return replace(block, held=held)


def _balance(model: RobotModel, control: ca.SX) -> tuple[ca.SX, ca.SX]:
    """M and tau - H without contact, with torques within the limits of the actuators."""
    dae, links = model.dae, model.links
    nq, nv = links.q.numel(), links.v.numel()
    part = slice(nq, nq + nv)
    # Viscous friction belongs to the contacts here.
    parameters = (p for constraint in model.constraints for p in constraint.parameters)
    viscous = [p.symbol for p in parameters if p.name.endswith(".viscous_friction")]
    forces = ca.substitute(dae.f[part], stacked(viscous), ca.DM.zeros(len(viscous)))
    limits = ca.DM(links.effort_limits)
    torque = control if model.joint_force is None else model.joint_force
    within = ca.fmin(ca.fmax(torque, -limits), limits)
    if model.joint_force is not None:
        within -= model.joint_force  # It is also part of f.
    drive = ca.mtimes(ca.SX(ca.sparsify(ca.DM(links.actuation_matrix))), within)
    return dae.mass_matrix[part, part], forces + drive


def _step(
    model: RobotModel, contacts: Sequence[PointContact], control: ca.SX, h: float
) -> tuple[ca.SX, ca.SX]:
    """(x, F) after a step, and a number that is negative where they are not valid."""
    links, kinematics, size = model.links, model.links.kinematics(), model.links.v.numel()
    mass, forces = _balance(model, control)
    # D of the friction -D v of joints, which Drake takes implicitly, at the velocities before.
    damping = np.zeros(size)
    for joint in map(links.plant.get_joint, links.plant.GetJointIndices()) if links.plant else ():
        first = joint.velocity_start()
        damping[first : first + joint.num_velocities()] = joint.default_damping_vector()
    resistance = (load.resistance(kinematics) for load in model.known_forces)
    mass += h * (ca.diag(ca.DM(damping)) + sum(resistance, ca.SX(size, size)))
    free = links.v + h * PositiveDefiniteFactorization(mass).solve(forces)
    velocities, contact_forces, slack = contact_step(contacts, links.v, free, mass, h)
    velocity = ca.mtimes(links.velocity_map, velocities)
    # Drake's stops push if a joint would pass its limit within two steps.
    ahead = _within_limits(model, links.q + 2.0 * h * velocity)
    stages = stages_after(model, h, control) if model.stages else ca.SX(0, 1)
    after = ca.vertcat(links.q + h * velocity, velocities, stages, contact_forces)
    return after, ca.fmin(slack, ahead)


def _within_limits(model: RobotModel, q: ca.SX) -> ca.SX:
    """The least distance of joints from their limits; negative beyond one."""
    low, high = model.links.position_limits
    gaps = [q[i] - low[i] for i in np.flatnonzero(np.isfinite(low)).tolist()]
    gaps += [high[i] - q[i] for i in np.flatnonzero(np.isfinite(high)).tolist()]
    return reduce(ca.fmin, gaps, ca.SX(1))


def stages_after(model: RobotModel, time_step: float, control: ca.SX) -> ca.SX:
    """s after a step of the stages as an expression of x and u, shape (k, 1).

    As the links get new positions from their new velocities, positions of shafts follow from their
    new velocities, and everything else from the values at t_n,

        E (s_(n+1) - s_n) = h (drift(q_n, v_n, s_n) + drive u_n),    but p_(n+1) = p_n + h p'_(n+1).

    For springs, links and shafts together this is the symplectic Euler method: an undamped
    oscillation of frequency w keeps its amplitude for w h < 2, with the frequency w_h of sin(w_h h
    / 2) = w h / 2 in place of w.
    """
    state, rates = model.dae.state, stage_rates(model, control)
    size = state.numel() - rates.numel()
    after = ca.vertcat(state[:size], state[size:] + time_step * rates)
    for position, velocity in _shafts(model).items():
        after[position] = state[position] + time_step * after[velocity]
    return after[size:]


def stage_rates(model: RobotModel, control: ca.SX) -> ca.SX:
    """s' = E^-1 (drift(q, v, s) + drive u) as an expression of x and u, shape (k, 1)."""
    dae, size = model.dae, model.links.q.numel() + model.links.v.numel()
    driven = dae.f[size:] + ca.mtimes(dae.h[size:, :], control)
    # Stages do not share a mass with the links.
    return PositiveDefiniteFactorization(dae.mass_matrix[size:, size:]).solve(driven)


def check_step(model: RobotModel, time_step: float, parameters: FloatArray) -> None:
    """Refuses a step that is too long for the stages of a robot.

    About rest at the nominal state, one step multiplies small deviations of (q, v, s) by a matrix,
    whose eigenvalues must not be outside the unit circle: w h <= 2 for springs without damping,
    R h / L <= 2 for the electric part of a motor, and less if it oscillates with the inertia.
    """
    dae, links = model.dae, model.links
    assert model.joint_force is not None
    # C of x' = C x for links and stages without weight.
    B = ca.SX(ca.sparsify(ca.DM(links.actuation_matrix)))
    velocity = ca.mtimes(links.velocity_map, links.v)
    stages = dae.f[velocity.numel() + B.shape[0] :]
    forces = ca.vertcat(velocity, ca.mtimes(B, model.joint_force), stages)
    outputs = {"mass": dae.mass_matrix, "slope": ca.jacobian(forces, dae.state)}
    mass, force = dae.trace("linear motion", outputs, often=False)(dae.nominal_state, parameters)
    slope: FloatArray = np.asarray(np.linalg.solve(mass, force))
    positions = [*range(links.q.numel()), *_shafts(model)]
    moved, one = np.zeros_like(slope), np.eye(len(slope))
    moved[positions] = slope[positions]

    def is_stable(step: float) -> bool:
        matrix = np.linalg.solve(one - step * moved, one + step * (slope - moved))
        return bool(np.abs(np.linalg.eigvals(matrix)).max() <= 1.0 + 1e-7)  # Round-off.

    if is_stable(time_step):
        return
    shorter = [float(f"{part * time_step:.1e}") for part in np.geomspace(1.0, 0.01, 300)]
    fitting = next(filter(is_stable, shorter), 0.0)
    remedy = f"take {fitting:g} s or less; the law may keep its period with `sampling`"
    if not fitting:
        remedy = f"{shorter[-1]:g} s, too; damp it, or take an ideal plant"
    raise ModelError(
        f"a time_step of {time_step:g} s is too long for what drives the joints, which has motions "
        f"of {np.abs(np.linalg.eigvals(slope)).max():.3g} rad/s: {remedy}"
    )


def _shafts(model: RobotModel) -> dict[int, int]:
    """The index of each shaft's position in x -> that of its velocity."""
    velocities: dict[int, int] = {}
    for shaft in (stage.shaft for stage in model.stages if stage.shaft is not None):
        slopes = (ca.DM(ca.jacobian(each, model.dae.state)).full() for each in shaft)
        velocities.update(zip(*(slope.argmax(axis=1).tolist() for slope in slopes), strict=True))
    return velocities
