"""The shipped arms behind actuation stages, and their dynamics from MultibodyPlant and NumPy."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import pytest
from arms import arm, consistent_states, numbers, touching
from pydrake.multibody.tree import JacobianWrtVariable

from drake_dae import RobotModel, find_structure
from drake_dae.dae import Structure
from drake_dae.robots import DcMotors, ElectrohydraulicServos, FlexibleJoints, Stage

ARMS = ["two_link", "seven_joint"]
DEGREES = {
    "flexible": (4, 2),
    "motor": (3, 1),
    "hydraulic": (3, 1),
    "flexible motor": (5, 3),
    "flexible hydraulic": (5, 3),
    "damped": (3, 1),
}
"""Of positions and forces. A kind names its stages from the joints toward the motor; damped is
flexible with full matrices of stiffness, inertia and damping.
"""

EACH = [
    pytest.param(name, kind, marks=[pytest.mark.thorough] * (i > 0))
    for i, name in enumerate(ARMS)
    for kind in DEGREES
]
"""Each arm behind each kind; seven joints show the same, by larger functions."""

OFFSET = {"two_link": [0.35], "seven_joint": [0.03, 0.57, 0.02, -0.03, 0.05, -0.06]}


class Actuated(NamedTuple):
    model: RobotModel
    structure: Structure


class Drive(NamedTuple):
    """The numbers of one kind, all matrices; what it does not have does not act."""

    flexible: bool
    electric: bool
    fluid: bool
    rotors: np.ndarray  # What of MultibodyPlant's M does not turn with the links.
    stiffness: np.ndarray
    inertia: np.ndarray
    damping: np.ndarray
    inductance: np.ndarray
    resistance: np.ndarray
    constant: np.ndarray  # K_m
    torque: np.ndarray  # N K_m
    leakage: np.ndarray
    compliance: np.ndarray  # K_h^-1


@cache
def drive(name: str, kind: str) -> Drive:
    plant = arm(name).plant
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
    gears = np.array([a.default_gear_ratio() for a in actuators])
    rotors = np.diag([a.default_rotor_inertia() for a in actuators] * gears**2)
    p, parts = len(gears), kind.split()
    if name == "two_link":
        gears, stiffness, inertia = [100.0, 80.0], np.diag([8e3, 5e3]), np.diag([1.0, 0.6])
    else:
        stiffness, inertia = np.diag([2e4, 2e4, 1e4, 1e4, 5e3, 2e3, 2e3]), rotors
    if kind == "damped":
        mix = np.eye(p) + 0.2 * np.eye(p, k=1)
        stiffness, inertia = mix @ stiffness @ mix.T, mix @ inertia @ mix.T
    flexible = parts[0] in ("flexible", "damped")
    ramp = np.linspace(1.0, 1.5, p)
    return Drive(
        flexible=flexible,
        electric=parts[-1] == "motor",
        fluid=parts[-1] == "hydraulic",
        rotors=rotors * flexible,
        stiffness=stiffness,
        inertia=inertia,
        damping=1e-3 * stiffness * (kind == "damped"),
        inductance=np.diag(2e-3 * ramp),
        resistance=0.5 * np.eye(p),
        constant=np.diag(0.1 / ramp),
        torque=np.diag(0.1 / ramp * gears),
        leakage=2e-6 * (np.eye(p) + 0.2),
        compliance=1e-6 * np.diag(ramp),
    )


def lever(position: Any, library: Any = np) -> Any:
    """A geometry matrix G(q) in m that depends on q and is not diagonal."""
    p = position.shape[0]
    diagonal = library.diag(0.05 + 0.01 * library.sin(position))
    return diagonal + 0.004 * library.cos(position[0]) * (np.eye(p, k=1) - np.eye(p, k=-1))


def stages(name: str, kind: str) -> list[Stage]:
    """What the library is given; the seven-joint arm declares its rotors and gears."""
    d = drive(name, kind)
    given = (lambda m: m) if kind == "damped" else np.diag
    made = []
    if d.flexible:
        declared = name == "seven_joint" and kind != "damped"
        inertia = None if declared else given(d.inertia)
        made.append(FlexibleJoints(given(d.stiffness), inertia, given(d.damping)))
    if d.electric:
        constant = np.diag(d.constant)
        gears = None if name == "seven_joint" else np.diag(d.torque) / constant
        made.append(DcMotors(constant, np.diag(d.inductance), 0.5, gears))
    if d.fluid:
        fluid = 1.0 / np.diag(d.compliance)
        made.append(ElectrohydraulicServos(fluid, d.leakage, lambda q: lever(q, ca)))
    return made


@cache
def actuated(name: str, kind: str) -> Actuated:
    model = touching(name, stages(name, kind))
    return Actuated(model, find_structure(model.dae))


def split(d: Drive, x: np.ndarray) -> tuple[np.ndarray, ...]:
    """q, v, the position and velocity that the motors drive, and currents or actuator forces."""
    parts = x.reshape(-1, len(d.torque))
    shaft = parts[2:4] if d.flexible else parts[:2]
    return parts[0], parts[1], shaft[0], shaft[1], parts[-1]


class Rates(NamedTuple):
    state: np.ndarray
    acceleration: np.ndarray
    force: np.ndarray
    torque: np.ndarray


def rates(name: str, d: Drive, x: np.ndarray, u: np.ndarray) -> Rates:
    """x', v', lambda and the joint torques of (64)-(65), (74)-(75) and their kin.

    The links by one dense solve: [[M, -J^T], [J, 0]] (v', lambda) = (tau - H, -Jdot v).
    """
    q, v, q_2, v_2, s = split(d, x)
    torque, stage_rates = u, []
    if d.electric:
        torque = d.torque @ s
        change = u - d.resistance @ s - d.torque @ v_2
        stage_rates = [np.linalg.solve(d.inductance, change)]
    if d.fluid:
        torque = lever(q_2) @ s
        change = u - d.leakage @ s - lever(q_2).T @ v_2
        stage_rates = [np.linalg.solve(d.compliance, change)]
    if d.flexible:
        spring = d.stiffness @ (q_2 - q) + d.damping @ (v_2 - v)
        stage_rates = [v_2, np.linalg.solve(d.inertia, torque - spring), *stage_rates]
        torque = spring
    n = numbers(name, q, v)
    j = n.constraint_jacobian
    matrix = np.block([[n.mass - d.rotors, -j.T], [j, np.zeros((1, 1))]])
    right = np.concatenate([torque - n.bias, -n.constraint_acceleration])
    acceleration, force = np.split(np.linalg.solve(matrix, right), [q.size])
    return Rates(np.concatenate([v, acceleration, *stage_rates]), acceleration, force, torque)


def output_bias(name: str, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Pdot v of the tip's height."""
    plant = arm(name).plant
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    world, tool = plant.world_frame(), plant.GetFrameByName("tool")
    bias = plant.CalcBiasSpatialAcceleration(
        context, JacobianWrtVariable.kV, tool, np.zeros(3), world, world
    )
    return bias.translational()[[2]]


def start_position(name: str) -> np.ndarray:
    """The configuration on the wall with outputs `OFFSET`."""
    model = arm(name).model
    return model.configuration(OFFSET[name], np.split(model.dae.nominal_state, 2)[0])


def at_rest(name: str, kind: str, q: np.ndarray, force: float) -> tuple[np.ndarray, np.ndarray]:
    """The state (q, 0, s) and the control that hold a force: tau = H - J^T lambda."""
    d, still = drive(name, kind), np.zeros_like(q)
    n = numbers(name, q, still)
    torque = n.bias - n.constraint_jacobian.T @ [force]
    return standing(d, np.concatenate([q, still]), torque, still)


def standing(
    d: Drive, link: np.ndarray, torque: np.ndarray, change: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The state whose stages deliver torques that change at a rate; the control to hold them."""
    state, q_2, control = [link], link[: len(torque)], torque
    if d.flexible:
        q_2 = q_2 + np.linalg.solve(d.stiffness, torque)
        state += [q_2, link[len(torque) :] + np.linalg.solve(d.stiffness, change)]
    if d.electric:
        state.append(np.linalg.solve(d.torque, torque))
        control = d.resistance @ state[-1]
    if d.fluid:
        state.append(np.linalg.solve(lever(q_2), torque))
        control = d.leakage @ state[-1]
    return np.concatenate(state), control


def states(name: str, kind: str, count: int, seed: int = 0) -> np.ndarray:
    """Random states on N*: links at about 1 rad/s, 3 rad/s^2, 10 rad/s^3, pressed with 20 N.

    Random torques would throw the light wrist about and hide all else that a law computes.
    """
    d, random = drive(name, kind), np.random.default_rng(seed)
    p, made = len(d.torque), []
    for link in consistent_states(name, count, seed):
        n = numbers(name, link[:p], link[p:])
        mass, across = n.mass - d.rotors, n.constraint_jacobian[0]
        torque = mass @ (3.0 * random.standard_normal(p)) + n.bias
        torque -= across * 20.0 * random.standard_normal()
        change = mass @ (10.0 * random.standard_normal(p))
        change -= across * 100.0 * random.standard_normal()
        made.append(standing(d, link, torque, change)[0])
    return np.array(made)


def slope(
    function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, along: np.ndarray, step: float
) -> np.ndarray:
    """The derivative along a direction, by central differences with two Richardson steps.

    The error is O(step^6), and round-off over step. The step is a length in the space of `at`.
    """
    length = np.linalg.norm(along)
    direction = along / (length or 1.0)
    d = [
        (function(at + h * direction) - function(at - h * direction)) * (0.5 * length / h)
        for h in (step, step / 2.0, step / 4.0)
    ]
    coarse, fine = (4.0 * d[1] - d[0]) / 3.0, (4.0 * d[2] - d[1]) / 3.0
    return (16.0 * fine - coarse) / 15.0
