"""The equations of a robot in contact as a DaeSystem.       (43)-(45), (64)-(68), (74)-(78)"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae import DaeSystem, Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.actuation.chain import ActuationChain
from drake_dae.robots.constraints.constraint_set import ConstraintSet
from drake_dae.robots.known_forces import Load
from drake_dae.robots.links.links import Links
from drake_dae.robots.loop_state import LoopState
from drake_dae.trace.factorization import BlockFactors, Factors, PositiveDefiniteFactorization
from drake_dae.trace.functions import TracedFunction


@dataclass(frozen=True, eq=False)
class Outputs:
    """The controlled outputs z = (h_1(q), S(q) lambda) of a robot.

    Attributes:
        positions: h_1, shape (p - k, 1).
        forces: S, shape (k, m).
        signals: Names and units of z.
    """

    positions: ca.SX
    forces: ca.SX
    signals: tuple[Signal, ...]


def robot_equations(
    name: str,
    links: Links,
    bound: ConstraintSet,
    driven: ActuationChain,
    loop_joints: LoopState,
    known_forces: Sequence[Load],
    outputs: Outputs,
    choice: tuple[Parameter, ...],
    nominal: FloatArray,
) -> DaeSystem:
    """(43)-(45), with M on the left; the rows of stages follow those of links.

    Args:
        name: The robot's name in messages.
        links, bound, driven, loop_joints, known_forces, outputs: The parts of the robot.
        choice: The parameters of the choice of the control, if any; see `control_choice`.
        nominal: A configuration of the robot at work, shape (nq,).
    """
    nq, nv, k = links.q.numel(), links.v.numel(), driven.state.numel()
    controls = (*driven.control_signals, *bound.motors)
    m, nu = bound.size, len(controls)
    h_1, S = outputs.positions, outputs.forces
    B = ca.SX(ca.sparsify(ca.DM(links.actuation_matrix)))
    velocity = ca.mtimes(links.velocity_map, links.v)
    torque = (
        ca.mtimes(B, driven.joint_force) + _known_force(links, known_forces) + bound.drag(links)
    )
    torque += loop_joints.force
    motors = loop_joints.motors
    rotors = _moved_rotors(links, driven)

    def implicit(rate: ca.SX, constraint_force: ca.SX) -> tuple[ca.SX, ca.SX]:
        acceleration = rate[nq : nq + nv]
        inertial, constraint_rate = bound.implicit(links, acceleration, constraint_force)
        slip = ca.sparsify(rate[:nq] - velocity)
        if slip.nnz():  # q' is an unknown of its own where N is not the identity.
            kinematics = links.kinematics()
            motion = kinematics.value(bound.rate(kinematics))
            constraint_rate += ca.jtimes(motion, links.q, slip)
        balance = inertial - ca.mtimes(rotors, acceleration) - torque  # (37)
        stages = ca.mtimes(driven.mass, rate[nq + nv :]) - driven.drift
        return ca.vertcat(rate[:nq] - velocity, balance, stages), constraint_rate

    def factorize(rows: Sequence[int]) -> Factors | None:
        first = rows[0] if rows else 0
        if first > nq or list(rows) != list(range(first, nq + nv + k)):
            return None
        bodies = links.articulated_bodies(_rotors_in_links(links, driven))
        if bodies is None:
            return None
        others = (ca.SX.eye(nq - first), driven.mass)
        before, after = ((PositiveDefiniteFactorization(e), e.shape[0]) for e in others)
        return BlockFactors([before, (bodies, nv), after])

    return DaeSystem(
        state=ca.vertcat(links.q, links.v, driven.state),
        mass_matrix=ca.diagcat(ca.SX.eye(nq), links.mass_matrix - rotors, driven.mass),
        f=ca.vertcat(velocity, torque - links.bias, driven.drift),  # (43)
        g=ca.vertcat(ca.SX(nq, m), bound.force_matrix(links), ca.SX(k, m)),
        h=ca.vertcat(
            ca.SX(nq, nu),
            ca.horzcat(ca.mtimes(B, driven.direct), motors),
            ca.horzcat(driven.drive, ca.SX(k, motors.shape[1])),
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
        state_signals=(
            *links.position_signals,
            *links.velocity_signals,
            *driven.state_signals,
        ),
        constraint_input_signals=bound.force_signals,
        constraint_output_signals=bound.residual_signals,
        control_signals=controls,
        output_signals=outputs.signals,
        nominal_state=np.concatenate([nominal, np.zeros(nv + k)]),
        state_scale=np.ones(nq + nv + k),  # For SI units and angles.
        name=name,
        implicit=implicit,
        factorize=factorize,
        control_metric=ca.diag(choice[0].symbol) if choice else None,
        free_control=choice[1].symbol if choice else None,
        contacts=bound.contacts(links),
        dry=tuple(name for load in known_forces for name in load.dry),
    )


def check_mass_matrix(dae: DaeSystem, links: Links, nominal: FloatArray) -> None:
    """Refuses an M, without rotors that move with a stage, that is not positive definite.

    Args:
        dae: The robot's system.
        links: The links, with nq positions and nv velocities.
        nominal: The positions at which M is examined, shape (nq,).

    Raises:
        ModelError: M is not symmetric, or not positive definite.
    """
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


def _known_force(links: Links, known_forces: Sequence[Load]) -> ca.SX:
    """The generalized force of the known_forces, shape (nv, 1)."""
    total, kinematics = ca.SX(links.v.numel(), 1), links.kinematics()
    for load in known_forces:
        total += links.generalized_force(kinematics, load.reaction(kinematics))
    return total


def _moved_rotors(links: Links, driven: ActuationChain) -> ca.SX:
    """The part of M that moves with a stage instead of the links, shape (nv, nv)."""
    return ca.SX(ca.sparsify(ca.DM(_rotors(links) * driven.carries_rotors)))


def _rotors_in_links(links: Links, driven: ActuationChain) -> FloatArray:
    """The diagonal of the part of M from rotors that move with the links, shape (nv,)."""
    return np.diag(_rotors(links)) * (not driven.carries_rotors)


def _rotors(links: Links) -> FloatArray:
    """The part of M from rotors, shape (nv, nv)."""
    B = links.actuation_matrix
    rotors: FloatArray = B * links.reflected_inertia @ B.T
    return rotors
