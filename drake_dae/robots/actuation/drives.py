"""Drives: armature-controlled DC motors, and electrohydraulic servos.        (74)-(75)"""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.dae import Signal
from drake_dae.errors import ModelError
from drake_dae.robots.actuation.stage import (
    AttachedStage,
    Stage,
    diagonal_parameter,
    full_matrix,
    matrix_parameter,
)
from drake_dae.robots.links.links import Links


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
        p = len(names)
        ratio = links.gear_ratios if self.gear_ratio is None else self.gear_ratio
        constant, k_m = diagonal_parameter(
            "dc_motors.torque_constant", self.torque_constant, p, "N m/A"
        )
        inductance, l = diagonal_parameter("dc_motors.inductance", self.inductance, p, "H", True)  # noqa: E741
        resistance, r = diagonal_parameter("dc_motors.resistance", self.resistance, p, "ohm")
        gears, n = diagonal_parameter("dc_motors.gear_ratio", ratio, p, "")
        for parameter, wrong, rule in (
            (constant, constant.value == 0, "not be zero"),
            (gears, gears.value == 0, "not be zero"),
            (resistance, resistance.value < 0, "not be negative"),
        ):
            if wrong.any():
                raise ModelError(f"{parameter.name} must {rule}, got {parameter.value}")
        current = ca.SX.sym("I", p)

        return AttachedStage(
            state=current,
            state_signals=tuple(Signal(f"{name}.current", "A") for name in names),
            mass=ca.diag(l),
            drift=lambda position, velocity: -r * current - k_m * n * velocity,  # (75)
            drive_matrix=ca.SX.eye(p),
            drive_signals=tuple(Signal(f"{name}.voltage", "V") for name in names),
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
        leakage, g_p = matrix_parameter(
            "hydraulics.leakage", self.leakage, p, "m/(N s)", definite=False
        )
        pressing = ca.SX.sym("fa", p)

        def geometry(position: ca.SX) -> ca.SX:
            if not callable(self.geometry):
                return ca.SX(full_matrix("hydraulics.geometry", self.geometry, p))
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
            ports={"actuator_force": slice(0, p)},
            parameters=(fluid, leakage),
        )
