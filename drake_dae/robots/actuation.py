"""Flexible joints, motors and servos, and their chain.     (64)-(65), (74)-(75)

Without stages the joints are rigid (37), and the control is the joint torque. A stage applies a
force to its load, the joints or the shaft of the previous stage, and is driven by the next stage or
by the control. All positions, velocities and forces are on the joints' side of the gears.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, each, numbers
from drake_dae.dae import Parameter, Signal, as_expression, signals
from drake_dae.errors import ModelError
from drake_dae.robots.links import Links


@dataclass(frozen=True, eq=False)
class AttachedStage:
    """A stage at the p actuators of one robot: E s' = drift(load) + drive_matrix * drive.

    The load is given by its position and velocity, shape (p, 1) each.
    """

    state: ca.SX  # s, symbols, shape (k, 1).
    state_signals: tuple[Signal, ...]
    mass: ca.SX  # E, shape (k, k), symmetric positive definite.
    drift: Callable[[ca.SX, ca.SX], ca.SX]  # The load -> shape (k, 1).
    drive_matrix: ca.SX  # Shape (k, p).
    drive_signals: tuple[Signal, ...]
    force: Callable[[ca.SX, ca.SX], ca.SX]  # The load -> the force on it, shape (p, 1).
    parameters: tuple[Parameter, ...] = ()
    ports: Mapping[str, slice] = field(default_factory=dict)  # Port of the plant -> entries of s.
    shaft: tuple[ca.SX, ca.SX] | None = None  # Position and velocity of what a next stage drives.
    carries_rotors: bool = False  # Whether rotors move with it instead of the links.


class Stage(ABC):
    """One kind of actuation, to be attached to a robot.

    1. `attach` gives equations for the p actuators of the given links, in new symbols for the
       state; the stage itself does not change and can be attached to many robots.
    2. Numbers are `parameters` of these equations, with names that begin with the kind, as
       "dc_motors.resistance". An invalid value raises ModelError with the name and the value.
    3. E is symmetric positive definite. `drift` and `force` are smooth, and depend on s, on
       parameters, and on the load's position and velocity, not on the drive: so the control does
       not reach the joints in the same instant.
    4. Another stage can drive it exactly if there is a `shaft`; its drive is then a force.
    5. At rest, the drive can balance any force on the load: s' = 0 has a solution (s, drive).
    6. Names of states and ports are unique in a chain. At most one stage carries the rotors.
    """

    @abstractmethod
    def attach(self, links: Links) -> AttachedStage:
        """The equations at the actuators of these links; ModelError if a value does not fit."""


@dataclass(frozen=True, eq=False)
class ActuationChain:
    """Stages attached to a robot, from the joints toward the motor: E s' = drift + drive u."""

    stages: tuple[AttachedStage, ...]  # Empty for rigid joints.
    joint_force: ca.SX  # tau(q, v, s), shape (p, 1); 0 for rigid joints.
    direct: ca.SX  # Of u on the joints, shape (p, p): 1 for rigid joints, otherwise 0.
    mass: ca.SX  # E, shape (k, k).
    drift: ca.SX
    drive: ca.SX  # Shape (k, p).
    control_signals: tuple[Signal, ...]
    state: ca.SX  # Of all stages, shape (k, 1).


def chain(stages: Sequence[Stage], links: Links) -> ActuationChain:
    """Wires stages from the joints toward the motor: each drives the one before it."""
    p, none = len(links.actuator_signals), ca.SX(0, 1)
    if not stages:  # Rigid joints: the control is the joint force.
        rigid = ca.SX(p, 1), ca.SX.eye(p), ca.SX(0, 0), none, ca.SX(0, p)
        return ActuationChain((), *rigid, tuple(links.actuator_signals), none)
    names = [type(stage).__name__ for stage in stages]
    select = links.actuation_matrix
    if not p or not np.allclose(select.T @ select, np.eye(p)):
        raise ModelError(
            f"{names[0]} needs one actuator per actuated joint, so orthonormal columns of the "
            f"actuation matrix; there are {p} actuators"
        )
    transposed = ca.SX(ca.sparsify(ca.DM(select.T)))
    if not ca.is_equal(ca.sparsify(ca.mtimes(transposed, links.velocity_map)), transposed, 9):
        raise ModelError(
            "actuation stages need the actuated velocities to be derivatives of positions, "
            "q_i' = v_i: choose such coordinates where N(q) is not the identity"
        )
    attached = [stage.attach(links) for stage in stages]
    loads = [(ca.mtimes(transposed, links.q), ca.mtimes(transposed, links.v))]
    for name, other, before in zip(names[1:], names, attached, strict=False):
        if before.shaft is None:
            raise ModelError(f"{name} cannot drive {other}, which has no shaft; put {other} last")
        loads.append(before.shaft)
    delivered = [stage.force(*load) for stage, load in zip(attached, loads, strict=True)]
    drifts = [stage.drift(*load) for stage, load in zip(attached, loads, strict=True)]
    for i, force in enumerate(delivered[1:]):
        drifts[i] += ca.mtimes(attached[i].drive_matrix, force)
    idle = sum(stage.state.numel() for stage in attached[:-1])
    return ActuationChain(
        stages=tuple(attached),
        joint_force=delivered[0],
        direct=ca.SX(p, p),
        mass=ca.diagcat(*[stage.mass for stage in attached]),
        drift=ca.vertcat(*drifts),
        drive=ca.vertcat(ca.SX(idle, p), attached[-1].drive_matrix),
        control_signals=attached[-1].drive_signals,
        state=ca.vertcat(*[stage.state for stage in attached]),
    )


def full_matrix(name: str, value: ArrayLike, size: int) -> FloatArray:
    """A finite number, a diagonal or a matrix, as a matrix of shape (size, size)."""
    array = numbers(name, value)
    if array.shape in ((), (size,)):
        return np.diag(np.broadcast_to(array, (size,)))
    if array.shape != (size, size):
        raise ModelError(
            f"{name} must be a finite number, shape ({size},) or ({size}, {size}), got {value!r}"
        )
    return array


def diagonal_parameter(
    name: str,
    value: ArrayLike,
    size: int,
    unit: str,
    positive: bool = False,
    nonnegative: bool = False,
) -> tuple[Parameter, ca.SX]:
    """A parameter of one number per actuator, and its symbol, shape (size, 1)."""
    parameter = Parameter(name, each(name, value, size), unit, positive, nonnegative=nonnegative)
    return parameter, parameter.symbol


def matrix_parameter(
    name: str, value: ArrayLike, size: int, unit: str, definite: bool = True
) -> tuple[Parameter, ca.SX]:
    """A parameter that is a diagonal, or column by column a matrix, and the matrix of symbols."""
    array = full_matrix(name, value, size)
    if not np.allclose(array, array.T, rtol=1e-12, atol=0):
        raise ModelError(f"{name} must be symmetric")
    smallest = float(np.linalg.eigvalsh(array)[0])
    if smallest <= 0 if definite else smallest < -1e-12 * np.abs(array).max():
        kind = "positive definite" if definite else "positive semidefinite"
        raise ModelError(f"{name} must be {kind}; its smallest eigenvalue is {smallest:.3g}")
    if np.ndim(value) < 2:
        parameter = Parameter(name, np.diag(array), unit, positive=definite)
        return parameter, ca.diag(parameter.symbol)
    parameter = Parameter(name, array.reshape(-1, order="F"), unit)
    return parameter, ca.reshape(parameter.symbol, size, size)


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class FlexibleJoints(Stage):
    """Elastic transmissions (64)-(65), with joint damping D beside the paper's stiffness K_2:

        M(q_1) q_1'' + H = J^T lambda + K_2 (q_2 - q_1) + D (q_2' - q_1'),
        M_2 q_2'' + K_2 (q_2 - q_1) + D (q_2' - q_1') = u.

    The rotor inertia that the URDF declares moves from the links to the shafts. Degrees: mu = 4 for
    positions and 2 for forces; 3 and 1 with damping, which adds stable zero dynamics of dimension
    p, K_2 d + D d' = tau for the deflections d: they limit the step of an explicit integrator. A
    law with a delay needs poles that are fast beside the springs; model springs that are too stiff
    for the sample time as rigid joints. The law needs positions and velocities of links and shafts.
    The plant has the port `motor_state`, (q_2, q_2'), shape (2p,).

    Attributes:
        stiffness: K_2 in N m/rad (N/m), a number, shape (p,) or (p, p), positive definite. All are
            finite: with rigid joints among flexible ones B(x) of Assumption (5) is singular, since
            the control reaches the outputs at different orders. Use a high stiffness instead.
        inertia: M_2 in kg m^2 (kg), likewise; that of the URDF if None.
        damping: D in N m s/rad (N s/m), likewise positive definite; 0 for none.
        friction: Coulomb friction of the motors, F_c in N m (N), not negative, a number or shape
            (p,): u less F_c s drives the shafts, with s_i = q_2i' / sqrt(q_2i'^2 + v_s^2), which
            creeps below v_s. None for none and no such parameters; 0 for a law that does not know
            it, while the plant may have other values.
        stiction_tolerance: v_s in rad/s (m/s), positive; only with friction.
    """

    stiffness: ArrayLike
    inertia: ArrayLike | None = None
    damping: ArrayLike = 0.0
    friction: ArrayLike | None = None
    stiction_tolerance: float = 0.01

    def attach(self, links: Links) -> AttachedStage:
        names = [signal.name for signal in links.actuator_signals]
        p, inertia = len(names), self.inertia
        if inertia is None:
            inertia = links.reflected_inertia
            bare = [name for name, i in zip(names, inertia, strict=True) if i <= 0]
            if bare:
                raise ModelError(
                    f"FlexibleJoints: no rotor inertia is declared for {', '.join(bare)}; give "
                    "'inertia', or drake:rotor_inertia and drake:gear_ratio in the URDF"
                )
        rotary = all(signal.unit == "N m" for signal in links.actuator_signals)
        units = ("N m/rad", "kg m^2", "N m s/rad", "N m") if rotary else ("", "", "", "")
        stiffness, k = matrix_parameter("flexible_joints.stiffness", self.stiffness, p, units[0])
        rotors, m_2 = matrix_parameter("flexible_joints.inertia", inertia, p, units[1])
        parameters, d, name = [stiffness, rotors], ca.SX(p, p), "flexible_joints.damping"
        if np.any(self.damping):
            damping, d = matrix_parameter(name, self.damping, p, units[2])
            parameters.append(damping)
        q_2, rate = ca.SX.sym("q2", p), ca.SX.sym("q2'", p)
        drag = ca.SX(p, 1)
        if self.friction is not None:
            name, slow = "flexible_joints.friction", np.array([self.stiction_tolerance])
            dry, F_c = diagonal_parameter(name, self.friction, p, units[3], nonnegative=True)
            creep = Parameter("flexible_joints.stiction_tolerance", slow, positive=True)
            parameters += [dry, creep]
            drag = F_c * rate / ca.sqrt(rate**2 + creep.symbol**2)

        def force(position: ca.SX, velocity: ca.SX) -> ca.SX:
            return ca.mtimes(k, q_2 - position) + ca.mtimes(d, rate - velocity)  # (64)

        def drift(position: ca.SX, velocity: ca.SX) -> ca.SX:
            return ca.vertcat(rate, -force(position, velocity) - drag)  # (65)

        lengths = ["m" if signal.unit == "N" else "rad" for signal in links.actuator_signals]
        positions = [Signal(f"{n}.position", m) for n, m in zip(names, lengths, strict=True)]
        rates = [Signal(f"{n}.velocity", f"{m}/s") for n, m in zip(names, lengths, strict=True)]
        return AttachedStage(
            state=ca.vertcat(q_2, rate),
            state_signals=(*positions, *rates),
            mass=ca.diagcat(ca.SX.eye(p), m_2),
            drift=drift,
            drive_matrix=ca.vertcat(ca.SX(p, p), ca.SX.eye(p)),
            drive_signals=tuple(links.actuator_signals),
            force=force,
            shaft=(q_2, rate),
            carries_rotors=True,
            ports={"motor_state": slice(0, 2 * p)},
            parameters=tuple(parameters),
        )


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class DcMotors(Stage):
    """Armature-controlled direct-current motors (74)-(75), driven by voltages u:

        M(q) q'' + H = J^T lambda + N K_m I_a,    L I_a' + R I_a + K_m N q' = u.

    After `FlexibleJoints`, q is the position of the shafts. Degrees on rigid joints: mu = 3 for
    positions and 1 for forces. The law needs positions and velocities, and the currents. The plant
    has the port `motor_current`, I_a in A, shape (p,).

    Attributes:
        torque_constant: K_m in N m/A, a number or shape (p,), not 0.
        inductance: L in H, positive.
        resistance: R in ohm, not negative.
        gear_ratio: N; that of the URDF if None.
    """

    torque_constant: ArrayLike
    inductance: ArrayLike
    resistance: ArrayLike
    gear_ratio: ArrayLike | None = None

    def attach(self, links: Links) -> AttachedStage:
        names = [signal.name for signal in links.actuator_signals]
        p, kind = len(names), "dc_motors"
        ratio = links.gear_ratios if self.gear_ratio is None else self.gear_ratio
        constant, k_m = diagonal_parameter(
            f"{kind}.torque_constant", self.torque_constant, p, "N m/A"
        )
        inductance, L = diagonal_parameter(f"{kind}.inductance", self.inductance, p, "H", True)
        resistance, R = diagonal_parameter(
            f"{kind}.resistance", self.resistance, p, "ohm", nonnegative=True
        )
        gears, n = diagonal_parameter(f"{kind}.gear_ratio", ratio, p, "")
        for parameter in (constant, gears):
            if (parameter.value == 0).any():
                raise ModelError(f"{parameter.name} must not be zero, got {parameter.value}")
        current = ca.SX.sym("I", p)
        return AttachedStage(
            state=current,
            state_signals=signals([f"{name}.current" for name in names], "A"),
            mass=ca.diag(L),
            drift=lambda position, velocity: -R * current - k_m * n * velocity,  # (75)
            drive_matrix=ca.SX.eye(p),
            drive_signals=signals([f"{name}.voltage" for name in names], "V"),
            force=lambda position, velocity: n * k_m * current,  # (74)
            ports={"motor_current": slice(0, p)},
            parameters=(constant, inductance, resistance, gears),
        )


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class ElectrohydraulicServos(Stage):
    """Electrohydraulic servos (the last model of section 3.3), driven by normalized currents u:

        M(q) q'' + H = J^T lambda + G(q) f_a,    K_h^-1 f_a' + G_p f_a + G(q)^T q' = u.

    After `FlexibleJoints`, q is the position of the shafts. Degrees on rigid joints: mu = 3 for
    positions and 1 for forces. The law needs positions and velocities, and the actuator forces. The
    plant has the port `actuator_force`, f_a in N, shape (p,).

    Attributes:
        stiffness: K_h of the fluid in N/m, a number or shape (p,), positive.
        leakage: G_p in m/(N s), a number, shape (p,) or (p, p), positive semidefinite.
        geometry: The function G of the actuated positions, a CasADi column of shape (p, 1), with
            values of shape (p, p) in m; or a constant: a number, shape (p,) or (p, p). 1 by
            default.
    """

    stiffness: ArrayLike
    leakage: ArrayLike
    geometry: Callable[[ca.SX], ca.SX] | ArrayLike = 1.0

    def attach(self, links: Links) -> AttachedStage:
        names = [signal.name for signal in links.actuator_signals]
        p = len(names)
        fluid, k_h = diagonal_parameter("hydraulics.stiffness", self.stiffness, p, "N/m", True)
        leakage, g_p = matrix_parameter("hydraulics.leakage", self.leakage, p, "m/(N s)", False)
        pressing = ca.SX.sym("fa", p)

        def geometry(position: ca.SX) -> ca.SX:
            if not callable(self.geometry):
                return ca.SX(full_matrix("hydraulics.geometry", self.geometry, p))
            value = as_expression("hydraulics", "geometry", self.geometry(position))
            if value.shape != (p, p):
                raise ModelError(f"hydraulics.geometry has shape {value.shape}, expected {(p, p)}")
            return value

        return AttachedStage(
            state=pressing,
            state_signals=signals([f"{name}.actuator_force" for name in names], "N"),
            mass=ca.diag(1 / k_h),
            drift=lambda position, velocity: (
                -ca.mtimes(g_p, pressing) - ca.mtimes(geometry(position).T, velocity)
            ),
            drive_matrix=ca.SX.eye(p),
            drive_signals=signals([f"{name}.valve_current" for name in names]),
            force=lambda position, velocity: ca.mtimes(geometry(position), pressing),
            ports={"actuator_force": slice(0, p)},
            parameters=(fluid, leakage),
        )
