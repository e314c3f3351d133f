"""What stands between the control and the joints: a chain of stages toward the motor.

No stage is rigid joints (37), where the control is the joint torque. A stage delivers a force to
its load, the joints or the shaft of the stage before it, and is driven by the stage after it or by
the control. All positions, velocities and forces are on the joints' side of the gears.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.dae.signals import Parameter, Signal
from drake_dae.errors import FloatArray, ModelError
from drake_dae.robots.links import Links


@dataclass(frozen=True, eq=False)
class AttachedStage:
    """A stage at the p actuators of one robot: E s' = drift(load) + drive_matrix * drive.

    Attributes:
        state: s, symbols, shape (k, 1).
        state_signals: Names and units of s.
        mass: E, shape (k, k), symmetric positive definite.
        drift: Of the load's position and velocity, each of shape (p, 1); returns shape (k, 1).
        drive_matrix: Shape (k, p).
        drive_signals: Names and units of the drive, shape (p,).
        force: What the load gets, of its position and velocity; returns shape (p, 1).
        shaft: Position and velocity of what a next stage drives; None if nothing can drive it.
        carries_rotors: Whether the rotors that the URDF declares turn with it, not with the links.
        ports: Output port name -> which entries of s it shows.
        parameters: Of these expressions.
    """

    state: ca.SX
    state_signals: tuple[Signal, ...]
    mass: ca.SX
    drift: Callable[[ca.SX, ca.SX], ca.SX]
    drive_matrix: ca.SX
    drive_signals: tuple[Signal, ...]
    force: Callable[[ca.SX, ca.SX], ca.SX]
    shaft: tuple[ca.SX, ca.SX] | None
    carries_rotors: bool
    ports: dict[str, slice]
    parameters: tuple[Parameter, ...]


class Stage(Protocol):
    """One kind of actuation; `attach` gives its equations for a robot."""

    def attach(self, links: Links) -> AttachedStage:
        """The equations at the actuators of these links.

        Raises:
            ModelError: A value that does not fit.
        """


@dataclass(frozen=True, eq=False)
class FlexibleJoints:
    """Elastic transmissions (64)-(65), with joint damping D beside the paper's stiffness K_2:

        M(q_1) q_1'' + H = J^T lambda + K_2 (q_2 - q_1) + D (q_2' - q_1'),
        M_2 q_2'' + K_2 (q_2 - q_1) + D (q_2' - q_1') = u.

    The rotor inertia that the URDF declares moves from the links to the shafts. Degrees: mu = 4
    for positions and 2 for forces; 3 and 1 with damping. Damping leaves p zero dynamics, which the
    law does not move: K_2 d + D d' = tau for the deflections d, with the rates of D^-1 K_2. They
    are stable, but bound the step of an explicit integrator. The law needs positions and
    velocities of links and shafts.

    Attributes:
        stiffness: K_2 in N m/rad (N/m), a number, shape (p,) or (p, p), positive definite.
        inertia: M_2 in kg m^2 (kg), likewise; what the URDF declares if None.
        damping: D in N m s/rad (N s/m), likewise, positive definite; 0 for none.
    """

    stiffness: ArrayLike
    inertia: ArrayLike | None = None
    damping: ArrayLike = 0.0

    def attach(self, links: Links) -> AttachedStage:
        names = [signal.name for signal in links.actuator_signals]
        p = len(names)
        if np.any(np.isinf(_numbers("flexible_joints.stiffness", self.stiffness))):
            raise ModelError(
                "FlexibleJoints: a stiffness is infinite. Rigid joints beside flexible ones are "
                "not supported: the control would reach the outputs at different orders, and B(x) "
                "of Assumption (5) would be singular. Give a high stiffness instead"
            )
        inertia = self.inertia
        if inertia is None:
            inertia = links.reflected_inertia
            bare = [n for n, i in zip(names, links.reflected_inertia, strict=True) if i <= 0]
            if bare:
                raise ModelError(
                    f"FlexibleJoints: no rotor inertia is declared for {', '.join(bare)}; give "
                    "'inertia', or drake:rotor_inertia and drake:gear_ratio in the URDF"
                )
        rotary = all(signal.unit == "N m" for signal in links.actuator_signals)
        units = ("N m/rad", "kg m^2", "N m s/rad") if rotary else ("", "", "")
        stiffness, k = _matrix("flexible_joints.stiffness", self.stiffness, p, units[0])
        rotors, m_2 = _matrix("flexible_joints.inertia", inertia, p, units[1])
        parameters = [stiffness, rotors]
        d = ca.SX(p, p)
        if np.any(_full("flexible_joints.damping", self.damping, p)):
            try:
                damping, d = _matrix("flexible_joints.damping", self.damping, p, units[2])
            except ModelError as error:
                raise ModelError(
                    f"{error}. Damp all flexible joints or none: where only some are damped, the "
                    "control reaches the outputs at different orders"
                ) from None
            parameters.append(damping)
        q_2, rate = ca.SX.sym("q2", p), ca.SX.sym("q2'", p)

        def force(position: ca.SX, velocity: ca.SX) -> ca.SX:
            return ca.mtimes(k, q_2 - position) + ca.mtimes(d, rate - velocity)

        kinds = ["m" if signal.unit == "N" else "rad" for signal in links.actuator_signals]
        positions = [Signal(f"{n}.position", unit) for n, unit in zip(names, kinds, strict=True)]
        rates = [Signal(f"{n}.velocity", f"{unit}/s") for n, unit in zip(names, kinds, strict=True)]
        return AttachedStage(
            state=ca.vertcat(q_2, rate),
            state_signals=(*positions, *rates),
            mass=ca.diagcat(ca.SX.eye(p), m_2),
            drift=lambda position, velocity: ca.vertcat(rate, -force(position, velocity)),
            drive_matrix=ca.vertcat(ca.SX(p, p), ca.SX.eye(p)),
            drive_signals=tuple(links.actuator_signals),
            force=force,
            shaft=(q_2, rate),
            carries_rotors=True,
            ports={"motor_state": slice(0, 2 * p)},
            parameters=tuple(parameters),
        )


@dataclass(frozen=True, eq=False)
class DcMotors:
    """Armature-controlled direct-current motors (74)-(75), driven by voltages u:

        M(q) q'' + H = J^T lambda + N K_m I_a,    L I_a' + R I_a + K_m N q' = u.

    Behind `FlexibleJoints`, q is the position of the shafts. Degrees on rigid joints: mu = 3 for
    positions and 1 for forces. The law needs positions and velocities, and the currents.

    Attributes:
        torque_constant: K_m in N m/A, a number or shape (p,), not 0.
        inductance: L in H, positive.
        resistance: R in ohm, not negative.
        gear_ratio: N; what the URDF declares if None.
    """

    torque_constant: ArrayLike
    inductance: ArrayLike
    resistance: ArrayLike
    gear_ratio: ArrayLike | None = None

    def attach(self, links: Links) -> AttachedStage:
        names = [signal.name for signal in links.actuator_signals]
        p = len(names)
        ratio = links.gear_ratios if self.gear_ratio is None else self.gear_ratio
        constant, k_m = _diagonal("dc_motors.torque_constant", self.torque_constant, p, "N m/A")
        inductance, l = _diagonal("dc_motors.inductance", self.inductance, p, "H", True)  # noqa: E741
        resistance, r = _diagonal("dc_motors.resistance", self.resistance, p, "ohm")
        gears, n = _diagonal("dc_motors.gear_ratio", ratio, p, "")
        for parameter, wrong, wanted in (
            (constant, constant.value == 0, "not be zero"),
            (gears, gears.value == 0, "not be zero"),
            (resistance, resistance.value < 0, "not be negative"),
        ):
            if wrong.any():
                raise ModelError(f"{parameter.name} must {wanted}, got {parameter.value}")
        current = ca.SX.sym("I", p)
        return AttachedStage(
            state=current,
            state_signals=tuple(Signal(f"{name}.current", "A") for name in names),
            mass=ca.diag(l),
            drift=lambda position, velocity: -r * current - k_m * n * velocity,
            drive_matrix=ca.SX.eye(p),
            drive_signals=tuple(Signal(f"{name}.voltage", "V") for name in names),
            force=lambda position, velocity: n * k_m * current,
            shaft=None,
            carries_rotors=False,
            ports={"motor_current": slice(0, p)},
            parameters=(constant, inductance, resistance, gears),
        )


@dataclass(frozen=True, eq=False)
class ElectrohydraulicServos:
    """Electrohydraulic servos (the last model of section 3.3), driven by normalized currents u:

        M(q) q'' + H = J^T lambda + G(q) f_a,    K_h^-1 f_a' + G_p f_a + G(q)^T q' = u.

    Behind `FlexibleJoints`, q is the position of the shafts. Degrees on rigid joints: mu = 3 for
    positions and 1 for forces. The law needs positions and velocities, and the actuator forces.

    Attributes:
        stiffness: K_h of the fluid in N/m, a number or shape (p,), positive.
        leakage: G_p in m/(N s), a number, shape (p,) or (p, p), positive semidefinite.
        geometry: G of the actuated positions, a CasADi column of shape (p, 1); returns shape
            (p, p) in m. Or a number, shape (p,) or (p, p); 1 if left out.
    """

    stiffness: ArrayLike
    leakage: ArrayLike
    geometry: Callable[[ca.SX], ca.SX] | ArrayLike = 1.0

    def attach(self, links: Links) -> AttachedStage:
        names = [signal.name for signal in links.actuator_signals]
        p = len(names)
        fluid, k_h = _diagonal("hydraulics.stiffness", self.stiffness, p, "N/m", True)
        leakage, g_p = _matrix("hydraulics.leakage", self.leakage, p, "m/(N s)", definite=False)
        pressing = ca.SX.sym("fa", p)

        def geometry(position: ca.SX) -> ca.SX:
            if not callable(self.geometry):
                return ca.SX(_full("hydraulics.geometry", self.geometry, p))
            try:
                value = ca.SX(self.geometry(position))
            except (NotImplementedError, TypeError) as error:
                raise ModelError(
                    f"hydraulics.geometry must return a CasADi matrix, for example "
                    f"casadi.diag(...): {error}"
                ) from error
            if value.shape != (p, p):
                raise ModelError(f"hydraulics.geometry has shape {value.shape}, expected {(p, p)}")
            return value

        return AttachedStage(
            state=pressing,
            state_signals=tuple(Signal(f"{name}.actuator_force", "N") for name in names),
            mass=ca.diag(1 / k_h),
            drift=lambda position, velocity: (
                -ca.mtimes(g_p, pressing) - ca.mtimes(geometry(position).T, velocity)
            ),
            drive_matrix=ca.SX.eye(p),
            drive_signals=tuple(Signal(f"{name}.valve_current") for name in names),
            force=lambda position, velocity: ca.mtimes(geometry(position), pressing),
            shaft=None,
            carries_rotors=False,
            ports={"actuator_force": slice(0, p)},
            parameters=(fluid, leakage),
        )


@dataclass(frozen=True, eq=False)
class ActuationChain:
    """Stages attached to a robot, wired from the joints to the control.

    Attributes:
        stages: In this order, toward the motor; none for rigid joints.
        joint_force: tau(q, v, s), what the joints get from the stages, shape (p, 1).
        direct: What the joints get from u at once, shape (p, p): 1 for rigid joints, otherwise 0.
        state: All stages' states, shape (k, 1).
        mass, drift, drive: E s' = drift + drive u, shapes (k, k), (k, 1), (k, p).
        control_signals: Names and units of u.
    """

    stages: tuple[AttachedStage, ...]
    joint_force: ca.SX
    direct: ca.SX
    state: ca.SX
    mass: ca.SX
    drift: ca.SX
    drive: ca.SX
    control_signals: tuple[Signal, ...]


def chain(
    stages: Sequence[Stage], links: Links, position: ca.SX, velocity: ca.SX
) -> ActuationChain:
    """Wires stages: each drives the one before it, the control drives the last.

    Args:
        stages: From the joints toward the motor.
        links: The robot.
        position: Actuated positions, shape (p, 1).
        velocity: Actuated velocities, shape (p, 1).

    Raises:
        ModelError: A stage behind one that nothing can drive.
    """
    p = position.numel()
    if not stages:
        none = ca.SX(0, 1)
        return ActuationChain(
            stages=(),
            joint_force=ca.SX(p, 1),
            direct=ca.SX.eye(p),
            state=none,
            mass=ca.SX(0, 0),
            drift=none,
            drive=ca.SX(0, p),
            control_signals=tuple(links.actuator_signals),
        )
    attached = [stage.attach(links) for stage in stages]
    loads = [(position, velocity)]
    for stage, before in zip(stages[1:], attached, strict=False):
        if before.shaft is None:
            raise ModelError(
                f"{type(stage).__name__} cannot stand behind an electric or hydraulic stage, "
                "which has no shaft to drive; these come last"
            )
        if isinstance(stage, FlexibleJoints):
            raise ModelError("FlexibleJoints come once in a chain; put both springs into one")
        loads.append(before.shaft)
    delivered = [own.force(*load) for own, load in zip(attached, loads, strict=True)]
    drifts = [own.drift(*load) for own, load in zip(attached, loads, strict=True)]
    for i, force in enumerate(delivered[1:]):
        drifts[i] += ca.mtimes(attached[i].drive_matrix, force)
    idle = sum(own.state.numel() for own in attached[:-1])
    return ActuationChain(
        stages=tuple(attached),
        joint_force=delivered[0],
        direct=ca.SX(p, p),
        state=ca.vertcat(*[own.state for own in attached]),
        mass=ca.diagcat(*[own.mass for own in attached]),
        drift=ca.vertcat(*drifts),
        drive=ca.vertcat(ca.SX(idle, p), attached[-1].drive_matrix),
        control_signals=attached[-1].drive_signals,
    )


def _numbers(name: str, value: ArrayLike) -> FloatArray:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise ModelError(f"{name} must be numbers, got {value!r}") from None


def _full(name: str, value: ArrayLike, size: int) -> FloatArray:
    """A number, a diagonal or a matrix as a matrix."""
    array = _numbers(name, value)
    if array.ndim == 0:
        array = np.full(size, float(array))
    if array.ndim == 1:
        array = np.diag(array)
    if array.shape != (size, size) or not np.all(np.isfinite(array)):
        raise ModelError(
            f"{name} must be a finite number, shape ({size},) or ({size}, {size}), got {value!r}"
        )
    return array


def _diagonal(
    name: str, value: ArrayLike, size: int, unit: str, positive: bool = False
) -> tuple[Parameter, ca.SX]:
    """A parameter of one number per actuator, and its symbol."""
    array = _numbers(name, value)
    if array.ndim == 0:
        array = np.full(size, float(array))
    if array.shape != (size,) or not np.all(np.isfinite(array)):
        raise ModelError(f"{name} must be a finite number or shape ({size},), got {value!r}")
    parameter = Parameter(name, array, unit, positive)
    return parameter, parameter.symbol


def _matrix(
    name: str, value: ArrayLike, size: int, unit: str, definite: bool = True
) -> tuple[Parameter, ca.SX]:
    """A parameter that is a diagonal, or column by column a matrix, and the matrix of symbols.

    It is symmetric, and positive definite or at least semidefinite.
    """
    array = _full(name, value, size)
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
