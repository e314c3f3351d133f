"""The equations of a robot in contact as a DaeSystem.       (43)-(45), (64)-(68), (74)-(78)"""

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray
from drake_dae.dae import DaeSystem, Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.actuation.stage import ActuationChain, diagonal_parameter
from drake_dae.robots.constraints.constraint_set import ConstraintSet, LoopState
from drake_dae.robots.links.links import Links
from drake_dae.robots.loads import Load
from drake_dae.trace.functions import TracedFunction


def robot_equations(
    name: str,
    links: Links,
    bound: ConstraintSet,
    driven: ActuationChain,
    loop_joints: LoopState,
    known_forces: Sequence[Load],
    h_1: ca.SX,
    S: ca.SX,
    output_signals: tuple[Signal, ...],
    choice: tuple[Parameter, ...],
    nominal: FloatArray,
) -> DaeSystem:
    """(43)-(45) with the outputs z = (h_1(q), S(q) lambda), and M on the left.

    The rows of stages follow those of links. `choice` are the parameters of `control_choice`.
    """
    nq, nv, k = links.q.numel(), links.v.numel(), driven.state.numel()
    controls = (*driven.control_signals, *bound.motors)
    m, nu = bound.size, len(controls)
    B = ca.SX(ca.sparsify(ca.DM(links.actuation_matrix)))
    velocity = ca.mtimes(links.velocity_map, links.v)
    kinematics, known = links.kinematics(), ca.SX(nv, 1)
    for load in known_forces:
        known += links.generalized_force(kinematics, load.reaction(kinematics))
    torque = ca.mtimes(B, driven.joint_force) + known + bound.drag(links)
    torque += loop_joints.force
    reflected = links.actuation_matrix * links.reflected_inertia @ links.actuation_matrix.T
    # Rotors move with the links, or with a stage.
    moved = ca.SX(ca.sparsify(ca.DM(reflected * driven.carries_rotors)))

    def implicit(rate: ca.SX, constraint_force: ca.SX) -> tuple[ca.SX, ca.SX]:
        acceleration = rate[nq : nq + nv]
        inertial, constraint_rate = bound.implicit(links, acceleration, constraint_force)
        slip = ca.sparsify(rate[:nq] - velocity)
        if slip.nnz():  # q' is an unknown of its own where N is not the identity.
            moving = links.kinematics()
            constraint_rate += ca.jtimes(moving.value(bound.rate(moving)), links.q, slip)
        balance = inertial - ca.mtimes(moved, acceleration) - torque  # (37)
        stages = ca.mtimes(driven.mass, rate[nq + nv :]) - driven.drift
        return ca.vertcat(rate[:nq] - velocity, balance, stages), constraint_rate

    return DaeSystem(
        state=ca.vertcat(links.q, links.v, driven.state),
        mass_matrix=ca.diagcat(ca.SX.eye(nq), links.mass_matrix - moved, driven.mass),
        f=ca.vertcat(velocity, torque - links.bias, driven.drift),  # (43)
        g=ca.vertcat(ca.SX(nq, m), bound.force_matrix(links), ca.SX(k, m)),
        h=ca.vertcat(
            ca.SX(nq, nu),
            ca.horzcat(ca.mtimes(B, driven.direct), loop_joints.motors),
            ca.horzcat(driven.drive, ca.SX(k, loop_joints.motors.shape[1])),
        ),
        k=bound.constraint_output(links.kinematics()),  # (44)
        l=ca.vertcat(h_1, ca.SX(S.shape[0], 1)),  # (45)
        m=ca.vertcat(ca.SX(h_1.numel(), m), S),
        parameters=(
            *links.parameters,
            *driven.parameters,
            *bound.parameters,
            *(parameter for load in known_forces for parameter in load.parameters),
            *choice,
        ),
        state_signals=(*links.position_signals, *links.velocity_signals, *driven.state_signals),
        constraint_input_signals=bound.force_signals,
        constraint_output_signals=bound.residual_signals,
        control_signals=controls,
        output_signals=output_signals,
        nominal_state=np.concatenate([nominal, np.zeros(nv + k)]),
        state_scale=np.ones(nq + nv + k),  # For SI units and angles.
        name=name,
        implicit=implicit,
        control_metric=ca.diag(choice[0].symbol) if choice else None,
        free_control=choice[1].symbol if choice else None,
        contacts=bound.contacts(links),
        dry=tuple(name for load in known_forces for name in load.dry),
    )


def check_mass_matrix(dae: DaeSystem, links: Links, nominal: FloatArray) -> None:
    """Refuses an M, without rotors that move with a stage, that is not positive definite."""
    nq, nv = links.q.numel(), links.v.numel()
    inputs = {"q": links.q, "parameters": dae.parameter_symbol}
    expression = dae.mass_matrix[nq : nq + nv, nq : nq + nv]
    function = TracedFunction("mass matrix", inputs, {"mass_matrix": expression})
    mass = np.atleast_2d(function(nominal, dae.parameter_values)[0])
    asymmetry = np.abs(mass - mass.T).max()
    if asymmetry > 1e-9 * np.abs(mass).max():
        raise ModelError(f"{dae.name}: M(q) is not symmetric, by {asymmetry:.2g}")
    smallest = float(np.linalg.eigvalsh(mass)[0])
    if smallest <= 0.0:
        raise ModelError(
            f"{dae.name}: M(q) is not positive definite at the nominal configuration: smallest "
            f"eigenvalue {smallest:.2g}. A link without inertia cannot be moved by a force; give "
            "it mass, or weld it"
        )


def check_outputs(
    name: str,
    links: Links,
    motors: Sequence[Signal],
    forces: int,
    positions: Sequence[Signal],
    is_chosen: bool,
) -> None:
    """Refuses a number of outputs that does not fit that of the actuators.

    `motors` are those in joints that close loops; `is_chosen` says whether weights choose u.
    """
    of_joints, count = len(links.actuator_signals), len(positions)
    nu = of_joints + len(motors)
    if nu == 0 and count + forces:
        raise ModelError(
            f"{name}: there are no actuators, so no output can be controlled, but {count} "
            f"positions and {forces} constraint forces are outputs. To simulate it leave both out; "
            "to steer it give joints actuators, by plant.AddJointActuator or a <transmission>"
        )
    if is_chosen:
        if not 0 < count + forces < nu:
            raise ModelError(
                f"{name}: control_weights choose among the controls of more actuators than "
                f"outputs, but there are {nu} actuators and {count + forces} outputs"
            )
        return
    rank = int(np.linalg.matrix_rank(links.actuation_matrix)) if of_joints else 0
    if rank < of_joints:
        actuators = ", ".join(signal.name for signal in links.actuator_signals)
        raise ModelError(
            f"{name}: the {of_joints} actuators {actuators} move the joints in only {rank} "
            "independent ways; leave one out, or give control_weights and fewer outputs"
        )
    if count + forces and count + forces != nu:  # A robot that is only simulated needs no outputs.
        names = ", ".join(signal.name for signal in positions) or "none"
        remedy = "for fewer, control_weights choose the control"
        if count + forces > nu:
            remedy = "name in `forces` those that shall be steered, [] for none, or add actuators"
        raise ModelError(
            f"{name}: {nu} actuators can steer {nu} outputs, not {forces} constraint forces and "
            f"{count} positions ({names}); {remedy}"
        )


def control_choice(
    name: str, weights: ArrayLike | None, controls: Sequence[Signal]
) -> tuple[Parameter, ...]:
    """The parameters "control_weights" and "free_control" of the least sum w_i (u_i - u_0i)^2.

    Nothing without weights; these are one for all controls, or one for each.
    """
    if weights is None:
        return ()
    units = sorted({signal.unit for signal in controls})
    if np.ndim(weights) == 0 and len(units) > 1:
        raise ModelError(
            f"{name}: the controls are in {' and '.join(units)}, which one weight cannot compare; "
            "give each a weight, as 1 / limit^2"
        )
    nu = len(controls)
    chosen, _ = diagonal_parameter("control_weights", weights, nu, "", positive=True)
    return chosen, Parameter("free_control", np.zeros(nu), units[0] if len(units) == 1 else "")
