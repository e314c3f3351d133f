"""Elastic transmissions.                                                   (64)-(65)"""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.dae import Parameter, Signal
from drake_dae.errors import ModelError
from drake_dae.robots.actuation.stage import AttachedStage, Stage, full_matrix, matrix_parameter
from drake_dae.robots.links.links import Links


@checked(ModelError)
@dataclass(frozen=True, eq=False)
class FlexibleJoints(Stage):
    """Elastic transmissions (64)-(65), with joint damping D beside the paper's stiffness K_2:

        M(q_1) q_1'' + H = J^T lambda + K_2 (q_2 - q_1) + D (q_2' - q_1'),
        M_2 q_2'' + K_2 (q_2 - q_1) + D (q_2' - q_1') = u.

    A law with the total delay tau (its delay and half a sample) compensates the springs late. For a
    single joint with the natural frequency W_0^2 = K_2 (1 / M + 1 / M_2), two poles at -w and two
    at -W are stable if 2 (W + w) (W^2 + 3 W w + w^2) > W_0^2 tau W w: four equal ones if 20 w >
    W_0^2 tau. The law takes accelerations of the links from its model. If friction holds a tool,
    the model has an acceleration a that the tool does not have, with a'' + K_i4 a' + (K_i3 - kappa)
    a = 0, the gains of (32) and the eigenvalues kappa of P M^-1 K_2 M^-1 P^T (P M^-1 P^T)^-1 for
    the Jacobian P of the held directions; so K_i3 = W^2 + 4 W w + w^2 must be above kappa. Model
    springs that are too stiff for the sample time as rigid joints.

    The rotor inertia that the URDF declares moves from the links to the shafts. Degrees: mu = 4 for
    positions and 2 for forces; 3 and 1 with damping. Damping adds zero dynamics of dimension p,
    which the law does not change: K_2 d + D d' = tau for the deflections d, with the rates of D^-1
    K_2. They are stable, but limit the step of an explicit integrator. The law needs positions and
    velocities of links and shafts. The plant has the port `motor_state`, (q_2, q_2'), shape (2p,).

    Attributes:
        stiffness: K_2 in N m/rad (N/m), a number, shape (p,) or (p, p), positive definite. All are
            finite: with rigid joints among flexible ones B(x) of Assumption (5) is singular, since
            the control reaches the outputs at different orders. Use a high stiffness instead.
        inertia: M_2 in kg m^2 (kg), likewise; that of the URDF if None.
        damping: D in N m s/rad (N s/m), likewise positive definite; 0 for none.
        friction: Coulomb friction of the motors, F_c in N m (N), not negative, a number or shape
            (p,): u less F_c s drives the shafts, with s_i = q_2i' / sqrt(q_2i'^2 + v_s^2), which
            creeps below v_s. None for none and no such parameters; 0 for motors whose friction the
            law does not know, so that a plant may have other values. The law (28) differentiates s
            if F_c is not 0 in its model.
        stiction_tolerance: v_s in rad/s (m/s), positive; only with friction.
    """

    stiffness: ArrayLike
    inertia: ArrayLike | None = None
    damping: ArrayLike = 0.0
    friction: ArrayLike | None = None
    stiction_tolerance: float = 0.01

    def attach(self, links: Links) -> AttachedStage:
        names = [signal.name for signal in links.actuator_signals]
        p = len(names)
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
        stiffness, k = matrix_parameter("flexible_joints.stiffness", self.stiffness, p, units[0])
        rotors, m_2 = matrix_parameter("flexible_joints.inertia", inertia, p, units[1])
        parameters = [stiffness, rotors]
        d = ca.SX(p, p)
        if np.any(full_matrix("flexible_joints.damping", self.damping, p)):
            try:
                damping, d = matrix_parameter("flexible_joints.damping", self.damping, p, units[2])
            except ModelError as error:
                raise ModelError(
                    f"{error}. Damp all flexible joints or none: where only some are damped, the "
                    "control reaches the outputs at different orders"
                ) from None
            parameters.append(damping)
        q_2, rate = ca.SX.sym("q2", p), ca.SX.sym("q2'", p)
        drag = ca.SX(p, 1)
        if self.friction is not None:
            given = np.asarray(self.friction, dtype=float)
            if given.shape not in ((), (p,)) or not np.all(given >= 0):
                raise ModelError(
                    f"flexible_joints.friction must be 0 or more, a number or shape ({p},), got "
                    f"{self.friction!r}"
                )
            coefficients = Parameter(
                "flexible_joints.friction",
                np.broadcast_to(given, (p,)).copy(),
                "N m" if rotary else "",
                nonnegative=True,
            )
            slow = np.array([self.stiction_tolerance])
            creep = Parameter("flexible_joints.stiction_tolerance", slow, positive=True)
            parameters += [coefficients, creep]
            drag = coefficients.symbol * rate / ca.sqrt(rate**2 + creep.symbol**2)

        def force(position: ca.SX, velocity: ca.SX) -> ca.SX:
            return ca.mtimes(k, q_2 - position) + ca.mtimes(d, rate - velocity)  # (64)

        kinds = ["m" if signal.unit == "N" else "rad" for signal in links.actuator_signals]
        positions = [Signal(f"{n}.position", unit) for n, unit in zip(names, kinds, strict=True)]
        rates = [Signal(f"{n}.velocity", f"{unit}/s") for n, unit in zip(names, kinds, strict=True)]
        return AttachedStage(
            state=ca.vertcat(q_2, rate),
            state_signals=(*positions, *rates),
            mass=ca.diagcat(ca.SX.eye(p), m_2),
            drift=lambda position, velocity: ca.vertcat(  # (65)
                rate, -force(position, velocity) - drag
            ),
            drive_matrix=ca.vertcat(ca.SX(p, p), ca.SX.eye(p)),
            drive_signals=tuple(links.actuator_signals),
            force=force,
            shaft=(q_2, rate),
            carries_rotors=True,
            ports={"motor_state": slice(0, 2 * p)},
            parameters=tuple(parameters),
        )
