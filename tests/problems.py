"""Systems with known answers, and helpers that the tests of drake_dae.dae share.

Every problem is worked out by hand: degrees, A, alpha, beta, a and B are written in NumPy, from the
derivation in its docstring, and share no code with the library.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

from drake_dae.dae.signals import Signal
from drake_dae.dae.system import DaeSystem
from drake_dae.dae.tracking import TrackingLaw

Array = np.ndarray


class Known(NamedTuple):
    """What (2), (13), (14), (16) and (28) are at a state."""

    constraint_matrix: Array  # A, (m, m)
    alpha: Array  # (m,)
    beta: Array  # (m, p)
    drift: Array  # a, (p,)
    control_matrix: Array  # B, (p, p)


@dataclass(frozen=True)
class Problem:
    """A system and what is known of it.

    Attributes:
        system: The system.
        constraint_degrees, output_degrees: r and mu.
        index: Of the DAE; 0 without constraints.
        zero_dynamics: dim xi (22).
        output_order: The outputs in the paper's order (15).
        known: x -> the closed forms.
        consistent: Random generator -> a state on N*, found without the library.
        reference: Per output start, slope and amplitude of a signal that can be followed.
        derivatives: x -> k and its derivatives, constraint-major, shape (sum r_i,).
        horizon: How long it can be followed, in s.
        source: Where degrees or index are published; "" if made up for the tests.
        minimum_phase: Whether the zero dynamics are exponentially stable at the equilibrium next to
            the nominal state; None if they are trivial, or have no such equilibrium.
    """

    system: DaeSystem
    constraint_degrees: tuple[int, ...]
    output_degrees: tuple[int, ...]
    index: int
    zero_dynamics: int
    output_order: tuple[int, ...]
    known: Callable[[Array], Known]
    consistent: Callable[[np.random.Generator], Array]
    reference: Sequence[tuple[float, float, float]]
    derivatives: Callable[[Array], Array] = field(default=lambda x: np.zeros(0))
    horizon: float = 1.5
    source: str = ""
    minimum_phase: bool | None = None

    @property
    def manifold_dimension(self) -> int:
        return self.system.num_states - sum(self.constraint_degrees)


def known(constraint_matrix, alpha, beta, drift, control_matrix) -> Known:
    """From numbers and nested lists."""
    return Known(
        np.atleast_2d(np.asarray(constraint_matrix, dtype=float)),
        np.atleast_1d(np.asarray(alpha, dtype=float)),
        np.atleast_2d(np.asarray(beta, dtype=float)),
        np.atleast_1d(np.asarray(drift, dtype=float)),
        np.atleast_2d(np.asarray(control_matrix, dtype=float)),
    )


def unconstrained(controls: int, drift, control_matrix) -> Known:
    return Known(
        np.zeros((0, 0)),
        np.zeros(0),
        np.zeros((0, controls)),
        np.atleast_1d(np.asarray(drift, dtype=float)),
        np.atleast_2d(np.asarray(control_matrix, dtype=float)),
    )


def _pendulum(tension: bool) -> DaeSystem:
    return DaeSystem.from_functions(
        ["x", "y", "vx", "vy"],
        f=lambda x, p: [x[2], x[3], 0.0, -p.gravity],
        g=lambda x, p: [0.0, 0.0, x[0] / p.mass, x[1] / p.mass],
        h=lambda x, p: [0.0, 0.0, 1.0 / p.mass, 0.0],
        k=lambda x, p: (x[0] ** 2 + x[1] ** 2 - p.length**2) / 2.0,
        l=lambda x, p: 0.0 if tension else x[0],
        m=lambda x, p: 1.0 if tension else 0.0,
        parameters={"mass": 2.0, "length": 0.8, "gravity": 9.81},
        output_signals=(Signal("tension", "N/m") if tension else Signal("x", "m"),),
        nominal_state=[0.4, -0.6, 0.1, 0.1],
        name="pendulum",
    )


def _pendulum_state(random: np.random.Generator) -> Array:
    angle, rate = random.uniform(0.4, 0.9), random.uniform(-1.0, 1.0)
    s, c = np.sin(angle), np.cos(angle)
    return 0.8 * np.array([s, -c, rate * c, rate * s])


def pendulum_known(x: Array, tension: bool, mass: float, gravity: float) -> Known:
    radius2 = x[0] ** 2 + x[1] ** 2
    alpha = -mass * (x[2] ** 2 + x[3] ** 2 - gravity * x[1]) / radius2
    beta = -x[0] / radius2
    if tension:
        return known(radius2 / mass, alpha, beta, alpha, beta)
    return known(radius2 / mass, alpha, beta, x[0] * alpha / mass, x[1] ** 2 / (mass * radius2))


def _pendulum_derivatives(x: Array) -> Array:
    return np.array([(x[0] ** 2 + x[1] ** 2 - 0.8**2) / 2.0, x[0] * x[2] + x[1] * x[3]])


def pendulum() -> Problem:
    """The pendulum in Cartesian coordinates, pushed horizontally (Brenan et al., 1989: index 3).

    k'' = vx^2 + vy^2 - g y + (x^2 + y^2)/m v + x/m u, so r = 2, and z = x has x'' = (x v + u)/m,
    which is y^2/(m L^2) u after elimination: mu = 2 as long as y is not 0. s = p.
    """
    return Problem(
        system=_pendulum(tension=False),
        constraint_degrees=(2,),
        output_degrees=(2,),
        index=3,
        zero_dynamics=0,
        output_order=(0,),
        known=lambda x: pendulum_known(x, False, 2.0, 9.81),
        consistent=_pendulum_state,
        reference=[(0.45, 0.0, 0.1)],
        derivatives=_pendulum_derivatives,
        source="Hairer and Wanner, Solving Ordinary Differential Equations II, 1996, VII.1",
    )


def pendulum_tension() -> Problem:
    """The same pendulum with z = v, its rod force: beta = -x/(x^2 + y^2), mu = 0, s = 0."""
    return Problem(
        system=_pendulum(tension=True),
        constraint_degrees=(2,),
        output_degrees=(0,),
        index=3,
        zero_dynamics=2,
        output_order=(0,),
        known=lambda x: pendulum_known(x, True, 2.0, 9.81),
        consistent=_pendulum_state,
        reference=[(-25.0, 0.0, 1.0)],
        derivatives=_pendulum_derivatives,
        horizon=0.1,  # Later it comes to x = 0, where u does not act on the tension.
        source="Hairer and Wanner, Solving Ordinary Differential Equations II, 1996, VII.1",
    )


LENGTHS, MASSES, GRAVITY, WALL = (1.0, 0.9), (3.0, 2.0), 9.81, 1.2


def _arm_matrices(q, qd, sin, cos):
    """Entries of M, H, of phi = WALL - x_tip and of y_tip: point masses at the ends of two links.

    M = J1' m1 J1 + J2' m2 J2; H holds the Coriolis and gravity terms (Murray, Li and Sastry, 4.3).
    """
    (l1, l2), (m1, m2) = LENGTHS, MASSES
    s1, c1, s12, c12 = sin(q[0]), cos(q[0]), sin(q[0] + q[1]), cos(q[0] + q[1])
    s2, c2 = sin(q[1]), cos(q[1])
    inertia = [
        [(m1 + m2) * l1**2 + m2 * l2**2 + 2 * m2 * l1 * l2 * c2, m2 * l2**2 + m2 * l1 * l2 * c2],
        [m2 * l2**2 + m2 * l1 * l2 * c2, m2 * l2**2],
    ]
    bias = [
        -m2 * l1 * l2 * s2 * (2 * qd[0] * qd[1] + qd[1] ** 2)
        + (m1 + m2) * GRAVITY * l1 * c1
        + m2 * GRAVITY * l2 * c12,
        m2 * l1 * l2 * s2 * qd[0] ** 2 + m2 * GRAVITY * l2 * c12,
    ]
    tip = [l1 * c1 + l2 * c12, l1 * s1 + l2 * s12]
    tip_jacobian = [[-l1 * s1 - l2 * s12, -l2 * s12], [l1 * c1 + l2 * c12, l2 * c12]]
    total = qd[0] + qd[1]
    tip_curvature = [
        -l1 * c1 * qd[0] ** 2 - l2 * c12 * total**2,
        -l1 * s1 * qd[0] ** 2 - l2 * s12 * total**2,
    ]
    return inertia, bias, tip, tip_jacobian, tip_curvature


def _arm_known(x: Array) -> Known:
    inertia, bias, _, jacobian, curvature = (
        np.array(e) for e in _arm_matrices(x[:2], x[2:], np.sin, np.cos)
    )
    phi_row, phi_rate, y_row = -jacobian[:1], -curvature[0], jacobian[1]
    free = np.linalg.solve(inertia, -bias)
    a = phi_row @ np.linalg.solve(inertia, phi_row.T)
    alpha = -np.linalg.solve(a, [phi_row[0] @ free + phi_rate])
    beta = -np.linalg.solve(a, phi_row @ np.linalg.inv(inertia))
    y_drift = curvature[1] + y_row @ np.linalg.solve(inertia, phi_row.T @ alpha - bias)
    y_control = y_row @ np.linalg.solve(inertia, np.eye(2) + phi_row.T @ beta)
    return known(a, alpha, beta, [alpha[0], y_drift], [beta[0], y_control])


def _arm_state(random: np.random.Generator) -> Array:
    """On the wall: l1 cos q1 + l2 cos(q1 + q2) = R cos(q1 + delta) = WALL, and J qd = 0."""
    (l1, l2), elbow = LENGTHS, -random.uniform(0.9, 1.6)
    radius = np.hypot(l1 + l2 * np.cos(elbow), l2 * np.sin(elbow))
    delta = np.arctan2(l2 * np.sin(elbow), l1 + l2 * np.cos(elbow))
    shoulder = np.arccos(WALL / radius) - delta
    jacobian = np.array(_arm_matrices([shoulder, elbow], [0.0, 0.0], np.sin, np.cos)[3])[0]
    rate = random.uniform(-0.5, 0.5)
    return np.array([shoulder, elbow, rate * jacobian[1], -rate * jacobian[0]])


def _arm_derivatives(x: Array) -> Array:
    _, _, tip, jacobian, _ = _arm_matrices(x[:2], x[2:], np.sin, np.cos)
    return np.array([WALL - tip[0], -np.dot(jacobian[0], x[2:])])


def two_link_arm() -> Problem:
    """A two-link arm whose tip slides on a wall (section 3.1 of the paper), z = (force, height).

    (37)-(38) with phi = WALL - x_tip: A = J M^-1 J', alpha = -A^-1 (-J M^-1 H + Jdot qd),
    beta = -A^-1 J M^-1. The force comes first, so (15) must permute; 0 < s = 1 < p.
    """
    q, qd = ca.SX.sym("q", 2), ca.SX.sym("qd", 2)
    inertia, bias, tip, _, _ = _arm_matrices([q[0], q[1]], [qd[0], qd[1]], ca.sin, ca.cos)
    inertia = ca.vertcat(*[ca.horzcat(*row) for row in inertia])
    phi = WALL - tip[0]
    inverse = ca.inv(inertia)
    system = DaeSystem(
        state=ca.vertcat(q, qd),
        f=ca.vertcat(qd, -ca.mtimes(inverse, ca.vertcat(*bias))),
        g=ca.vertcat(ca.SX(2, 1), ca.mtimes(inverse, ca.jacobian(phi, q).T)),
        h=ca.vertcat(ca.SX(2, 2), inverse),
        k=phi,
        l=ca.vertcat(0.0, tip[1]),
        m=[1.0, 0.0],
        output_signals=(Signal("force", "N"), Signal("height", "m")),
        nominal_state=[1.0, -1.3, 0.0, 0.0],
        name="two-link arm",
    )
    return Problem(
        system=system,
        constraint_degrees=(2,),
        output_degrees=(0, 2),
        index=3,
        zero_dynamics=0,
        output_order=(1, 0),
        known=_arm_known,
        consistent=_arm_state,
        reference=[(20.0, 0.0, 5.0), (0.5, 0.0, 0.1)],
        derivatives=_arm_derivatives,
        source="McClamroch and Wang, IEEE Transactions on Automatic Control 33(5), 1988: r = 2",
    )


def circuit() -> Problem:
    """Two coils in series behind a source u, then a capacitor: an inductor cutset, index 2.

    The node between the coils carries no current away, k = i1 - i2, and its voltage is v:
    L1 i1' = u - R1 i1 - v, L2 i2' = v - R2 i2 - e, C e' = i2. With z = e, e'' = i2'/C and
    i2' = (u - R1 i1 - R2 i2 - e)/(L1 + L2) on N*: r = 1, mu = 2.
    """
    l1, l2, r1, r2, c = 0.2, 0.3, 1.5, 2.0, 0.05
    system = DaeSystem.from_functions(
        [Signal("i1", "A"), Signal("i2", "A"), Signal("e", "V")],
        f=lambda x, p: [-p.r1 * x[0] / p.l1, (-p.r2 * x[1] - x[2]) / p.l2, x[1] / p.c],
        g=lambda x, p: [-1.0 / p.l1, 1.0 / p.l2, 0.0],
        h=lambda x, p: [1.0 / p.l1, 0.0, 0.0],
        k=lambda x, p: x[0] - x[1],
        l=lambda x, p: x[2],
        m=lambda x, p: 0.0,
        parameters={"l1": l1, "l2": l2, "r1": r1, "r2": r2, "c": c},
        name="circuit",
    )

    def closed_form(x: Array) -> Known:
        conductance = 1.0 / l1 + 1.0 / l2
        difference = -r1 * x[0] / l1 - (-r2 * x[1] - x[2]) / l2
        alpha = difference / conductance
        return known(
            -conductance,
            alpha,
            l2 / (l1 + l2),
            (alpha - r2 * x[1] - x[2]) / (l2 * c),
            1.0 / ((l1 + l2) * c),
        )

    def consistent(random: np.random.Generator) -> Array:
        current, voltage = random.standard_normal(2)
        return np.array([current, current, voltage])

    return Problem(
        system=system,
        constraint_degrees=(1,),
        output_degrees=(2,),
        index=2,
        zero_dynamics=0,
        output_order=(0,),
        known=closed_form,
        consistent=consistent,
        reference=[(0.0, 0.0, 1.0)],
        derivatives=lambda x: np.array([x[0] - x[1]]),
        source="Tischendorf, Surveys on Mathematics for Industry 8, 1999: L-I cutsets",
    )


def linear() -> Problem:
    """x' = F x + G v + H u, 0 = K x, z = L x + M v with numbers that have no structure.

    Krishnan and McClamroch (1992): r = 1 as K G is regular, v = -(K G)^-1 K (F x + H u); z1 = L1 x
    has mu = 1, z2 = L2 x + M2 v has mu = 0.
    """
    random = np.random.default_rng(4)
    n, m, p = 6, 2, 2
    f, g, h = random.normal(size=(n, n)), random.normal(size=(n, m)), random.normal(size=(n, p))
    k, el = random.normal(size=(m, n)), random.normal(size=(p, n))
    em = np.vstack([np.zeros(m), random.normal(size=m)])
    x = ca.SX.sym("x", n)
    system = DaeSystem(state=x, f=f @ x, g=g, h=h, k=k @ x, l=el @ x, m=em, name="linear system")

    def closed_form(state: Array) -> Known:
        a = k @ g
        alpha, beta = -np.linalg.solve(a, k @ f @ state), -np.linalg.solve(a, k @ h)
        rate, control = f @ state + g @ alpha, h + g @ beta
        return known(
            a,
            alpha,
            beta,
            [el[0] @ rate, el[1] @ state + em[1] @ alpha],
            [el[0] @ control, em[1] @ beta],
        )

    null = np.linalg.svd(k)[2][m:].T
    return Problem(
        system=system,
        constraint_degrees=(1, 1),
        output_degrees=(1, 0),
        index=2,
        zero_dynamics=3,
        output_order=(0, 1),
        known=closed_form,
        consistent=lambda random: null @ random.standard_normal(n - m),
        reference=[(0.0, 0.0, 1.0), (0.5, 0.0, 1.0)],
        derivatives=lambda state: k @ state,
        horizon=0.5,  # One of its zeros is -134 1/s: SciPy takes small steps.
        source="Krishnan and McClamroch 1992; by matrices: Dai, Singular Control Systems, 1989",
        minimum_phase=True,
    )


def third_order() -> Problem:
    """r = 3: x0' = x1, x1' = x2, x2' = -x2 + (2 + cos x1) v must follow x0 = x3^2.

    x3''' = -x4^3 + u. So k''' = -x2 + (2 + cos x1) v - 2 x3 (-x4^3 + u) - 6 x4 x5: the control acts
    at the same order as v, which Assumption (3) allows. z = x3, mu = 3.
    """
    system = DaeSystem.from_functions(
        6,
        f=lambda x: [x[1], x[2], -x[2], x[4], x[5], -(x[4] ** 3)],
        g=lambda x: [0, 0, 2 + ca.cos(x[1]), 0, 0, 0],
        h=lambda x: [0, 0, 0, 0, 0, 1],
        k=lambda x: x[0] - x[3] ** 2,
        l=lambda x: x[3],
        m=lambda x: 0,
        nominal_state=[0.25, 0.0, 0.0, 0.5, 0.0, 0.0],
        name="third order",
    )

    def closed_form(x: Array) -> Known:
        a = 2.0 + np.cos(x[1])
        alpha = (x[2] - 2.0 * x[3] * x[4] ** 3 + 6.0 * x[4] * x[5]) / a
        return known(a, alpha, 2.0 * x[3] / a, -(x[4] ** 3), 1.0)

    def consistent(random: np.random.Generator) -> Array:
        a, b, c = random.uniform(-1.0, 1.0, 3)
        return np.array([a**2, 2 * a * b, 2 * b**2 + 2 * a * c, a, b, c])

    def derivatives(x: Array) -> Array:
        return np.array(
            [
                x[0] - x[3] ** 2,
                x[1] - 2 * x[3] * x[4],
                x[2] - 2 * x[4] ** 2 - 2 * x[3] * x[5],
            ]
        )

    return Problem(
        system=system,
        constraint_degrees=(3,),
        output_degrees=(3,),
        index=4,
        zero_dynamics=0,
        output_order=(0,),
        known=closed_form,
        consistent=consistent,
        reference=[(0.5, 0.0, 0.4)],
        derivatives=derivatives,
    )


def mixed_degrees() -> Problem:
    """r = (1, 2), and a constraint input as an output of degree 1 (n* is zero in every row).

    k1 = x0 - x2^2 with x0' = x1 x2 + v1; k2 = x3 - x2 with x3' = x4, x4' = x0 v1 + v2; x1' = -x1 +
    u2, x2' = x5, x5' = u1. So k1' = a + v1 with a = x1 x2 - 2 x2 x5, k2'' = x0 v1 + v2 - u1. The
    outputs are z1 = x2 (mu = 2) and z2 = v1 = -a, which u acts on after one derivative, as long as
    x2 is not 0: z2' = 2 x5^2 + 2 x2 u1 - (-x1 + u2) x2 - x1 x5.
    """
    system = DaeSystem.from_functions(
        6,
        f=lambda x: [x[1] * x[2], -x[1], x[5], x[4], 0, 0],
        g=lambda x: [[1, 0], [0, 0], [0, 0], [0, 0], [x[0], 1], [0, 0]],
        h=lambda x: [[0, 0], [0, 1], [0, 0], [0, 0], [0, 0], [1, 0]],
        k=lambda x: [x[0] - x[2] ** 2, x[3] - x[2]],
        l=lambda x: [x[2], 0],
        m=lambda x: [[0, 0], [1, 0]],
        nominal_state=[1.0, 0.0, 1.0, 1.0, 0.0, 0.0],
        name="mixed degrees",
    )

    def closed_form(x: Array) -> Known:
        a = x[1] * x[2] - 2 * x[2] * x[5]
        return known(
            [[1, 0], [x[0], 1]],
            [-a, x[0] * a],
            [[0, 0], [1, 0]],
            [0, 2 * x[5] ** 2 + x[1] * x[2] - x[1] * x[5]],
            [[1, 0], [2 * x[2], -x[2]]],
        )

    def consistent(random: np.random.Generator) -> Array:
        a, b, c = random.uniform(0.6, 1.4), *random.uniform(-0.5, 0.5, 2)
        return np.array([a**2, b, a, a, c, c])

    return Problem(
        system=system,
        constraint_degrees=(1, 2),
        output_degrees=(2, 1),
        index=3,
        zero_dynamics=0,
        output_order=(0, 1),
        known=closed_form,
        consistent=consistent,
        reference=[(1.0, 0.0, 0.2), (0.1, 0.0, 0.2)],
        derivatives=lambda x: np.array([x[0] - x[2] ** 2, x[3] - x[2], x[4] - x[5]]),
    )


def cart() -> Problem:
    """m = 0: a cart x'' = (u - c x')/mass, plain feedback linearization with mu = 2."""
    system = DaeSystem.from_functions(
        ["position", "speed"],
        f=lambda x, p: [x[1], -p.damping * x[1] / p.mass],
        h=lambda x, p: [0.0, 1.0 / p.mass],
        l=lambda x, p: x[0],
        parameters={"mass": 4.0, "damping": 0.3},
        name="cart",
    )
    return Problem(
        system=system,
        constraint_degrees=(),
        output_degrees=(2,),
        index=0,
        zero_dynamics=0,
        output_order=(0,),
        known=lambda x: unconstrained(1, -0.3 * x[1] / 4.0, 1.0 / 4.0),
        consistent=lambda random: random.standard_normal(2),
        reference=[(0.0, 0.0, 1.0)],
    )


def flexible_pendulum() -> Problem:
    """m = 0, mu = 4: a link behind a flexible joint (Spong, 1987; Isidori 1989, 4.10).

    I q'' = -w sin q - K (q - t), J t'' = K (q - t) + u, z = q. Then
    q^(4) = -(w (cos q q'' - sin q q'^2) + K (q'' - t''))/I, and B = K/(I J).
    """
    i, j, k, w = 0.5, 0.1, 20.0, 4.0
    system = DaeSystem.from_functions(
        ["q", "qd", "t", "td"],
        f=lambda x: [
            x[1],
            (-w * ca.sin(x[0]) - k * (x[0] - x[2])) / i,
            x[3],
            k * (x[0] - x[2]) / j,
        ],
        h=lambda x: [0, 0, 0, 1 / j],
        l=lambda x: x[0],
        name="flexible pendulum",
    )

    def closed_form(x: Array) -> Known:
        qdd = (-w * np.sin(x[0]) - k * (x[0] - x[2])) / i
        tdd = k * (x[0] - x[2]) / j
        fourth = -(w * (np.cos(x[0]) * qdd - np.sin(x[0]) * x[1] ** 2) + k * (qdd - tdd)) / i
        return unconstrained(1, fourth, k / (i * j))

    return Problem(
        system=system,
        constraint_degrees=(),
        output_degrees=(4,),
        index=0,
        zero_dynamics=0,
        output_order=(0,),
        known=closed_form,
        consistent=lambda random: random.uniform(-0.3, 0.3, 4),
        reference=[(0.1, 0.0, 0.3)],
        source="Spong, Journal of Dynamic Systems, Measurement, and Control 109(4), 1987: mu = 4",
    )


def _sleigh(outputs, matrix, names: Sequence[str]) -> DaeSystem:
    mass, inertia = 3.0, 0.4
    return DaeSystem.from_functions(
        ["x", "y", "heading", "vx", "vy", "w"],
        f=lambda x: [x[3], x[4], x[5], 0, 0, 0],
        g=lambda x: [0, 0, 0, -ca.sin(x[2]) / mass, ca.cos(x[2]) / mass, 0],
        h=lambda x: [
            [0, 0],
            [0, 0],
            [0, 0],
            [ca.cos(x[2]) / mass, 0],
            [ca.sin(x[2]) / mass, 0],
            [0, 1 / inertia],
        ],
        k=lambda x: -ca.sin(x[2]) * x[3] + ca.cos(x[2]) * x[4],
        l=outputs,
        m=lambda x: matrix,
        output_signals=names,
        nominal_state=[0.0, 0.0, 0.3, 0.8 * np.cos(0.3), 0.8 * np.sin(0.3), 1.0],
        name="knife edge",
    )


def _sleigh_state(random: np.random.Generator) -> Array:
    x, y, heading, speed, rate = random.uniform(0.5, 1.5, 5)
    return np.array([x, y, heading, speed * np.cos(heading), speed * np.sin(heading), rate])


def _sleigh_derivatives(x: Array) -> Array:
    return np.array([-np.sin(x[2]) * x[3] + np.cos(x[2]) * x[4]])


def knife_edge() -> Problem:
    """A knife edge on ice (Bloch, 1.7): a nonholonomic constraint, r = 1, v is the lateral force.

    k = -s vx + c vy, k' = -w V + v/m with the forward speed V = c vx + s vy: alpha = m w V. Neither
    the thrust u1 nor the torque u2 acts on k': beta is zero, though not by its structure, since
    -s c + c s is left. z = (heading, V), mu = (2, 1); V' = u1/m + w k. Position is left as xi.
    """
    mass, inertia = 3.0, 0.4

    def closed_form(x: Array) -> Known:
        speed = np.cos(x[2]) * x[3] + np.sin(x[2]) * x[4]
        return known(
            1 / mass,
            mass * x[5] * speed,
            [[0, 0]],
            [0, x[5] * _sleigh_derivatives(x)[0]],
            [[0, 1 / inertia], [1 / mass, 0]],
        )

    return Problem(
        system=_sleigh(
            lambda x: [x[2], ca.cos(x[2]) * x[3] + ca.sin(x[2]) * x[4]], [0, 0], ["heading", "V"]
        ),
        constraint_degrees=(1,),
        output_degrees=(2, 1),
        index=2,
        zero_dynamics=2,
        output_order=(0, 1),
        known=closed_form,
        consistent=_sleigh_state,
        reference=[(0.5, 0.0, 0.5), (1.0, 0.0, 0.3)],
        derivatives=_sleigh_derivatives,
        source="Bloch, Nonholonomic Mechanics and Control, 2003, chapter 1: the knife edge",
    )


def knife_edge_force() -> Problem:
    """The knife edge with z = (lateral force, heading).

    z1 = v = m w V is met at once only in appearance: n* = beta is zero but for round-off. So
    mu = (1, 2): (m w V)' = m V u2/I + w u1 (+ m w^2 k off N*), regular while w is not 0.
    """
    mass, inertia = 3.0, 0.4

    def closed_form(x: Array) -> Known:
        speed = np.cos(x[2]) * x[3] + np.sin(x[2]) * x[4]
        return known(
            1 / mass,
            mass * x[5] * speed,
            [[0, 0]],
            [mass * x[5] ** 2 * _sleigh_derivatives(x)[0], 0],
            [[x[5], mass * speed / inertia], [0, 1 / inertia]],
        )

    return Problem(
        system=_sleigh(lambda x: [0, x[2]], [1, 0], ["force", "heading"]),
        constraint_degrees=(1,),
        output_degrees=(1, 2),
        index=2,
        zero_dynamics=2,
        output_order=(0, 1),
        known=closed_form,
        consistent=_sleigh_state,
        reference=[(3.0, 0.0, 0.5), (0.5, 1.0, 0.1)],
        derivatives=_sleigh_derivatives,
    )


def chaplygin_sleigh() -> Problem:
    """A sleigh with its centre of mass a distance a ahead of the blade; v is the blade's force.

    k = -s vx + c vy - a w with (vx, vy) of the centre of mass. On N*, V' = a w^2 + u1/m and
    (I + m a^2) w' = -m a w V + u2, as Bloch has them. k' = -w V + (1/m + a^2/I) v - a u2/I.
    """
    m, inertia, a = 3.0, 0.4, 0.3
    system = DaeSystem.from_functions(
        ["x", "y", "heading", "vx", "vy", "w"],
        f=lambda x: [x[3], x[4], x[5], 0, 0, 0],
        g=lambda x: [0, 0, 0, -ca.sin(x[2]) / m, ca.cos(x[2]) / m, -a / inertia],
        h=lambda x: [
            *[[0, 0]] * 3,
            [ca.cos(x[2]) / m, 0],
            [ca.sin(x[2]) / m, 0],
            [0, 1 / inertia],
        ],
        k=lambda x: -ca.sin(x[2]) * x[3] + ca.cos(x[2]) * x[4] - a * x[5],
        l=lambda x: [x[2], ca.cos(x[2]) * x[3] + ca.sin(x[2]) * x[4]],
        m=lambda x: [0, 0],
        output_signals=["heading", "V"],
        nominal_state=[0.0, 0.0, 0.3, 0.5, 0.4, 1.0],
        name="Chaplygin sleigh",
    )

    def derivatives(x: Array) -> Array:
        return np.array([-np.sin(x[2]) * x[3] + np.cos(x[2]) * x[4] - a * x[5]])

    def closed_form(x: Array) -> Known:
        speed, whole = np.cos(x[2]) * x[3] + np.sin(x[2]) * x[4], inertia + m * a**2
        return known(
            1 / m + a**2 / inertia,
            x[5] * speed * m * inertia / whole,
            [[0, a * m / whole]],
            [-m * a * x[5] * speed / whole, x[5] * (a * x[5] + derivatives(x)[0])],
            [[0, 1 / whole], [1 / m, 0]],
        )

    def consistent(random: np.random.Generator) -> Array:
        x, y, heading, speed, rate = random.uniform(0.5, 1.5, 5)
        s, c = np.sin(heading), np.cos(heading)
        across = a * rate
        return np.array([x, y, heading, c * speed - s * across, s * speed + c * across, rate])

    return Problem(
        system=system,
        constraint_degrees=(1,),
        output_degrees=(2, 1),
        index=2,
        zero_dynamics=2,
        output_order=(0, 1),
        known=closed_form,
        consistent=consistent,
        reference=[(0.5, 0.0, 0.5), (1.0, 0.0, 0.3)],
        derivatives=derivatives,
        source="Bloch, Nonholonomic Mechanics and Control, 2003, 1.7: the Chaplygin sleigh",
    )


def rolling_disk() -> Problem:
    """An upright disk that rolls without slipping: two nonholonomic constraints, r = (1, 1).

    k = (vx - R c W, vy - R s W), v is the force on the rim. d(k)/dt = R w W (s, -c) + A v - R u1/I
    (c, s) with A = 1/m + R^2/I (c, s) (c, s)', which has the eigenvectors (s, -c) and (c, s). So
    alpha = -m R w W (s, -c), beta = m R/(I + m R^2) (c, s), and (I + m R^2) W' = u1, J w' = u2.
    """
    m, inertia, spin, radius = 2.0, 0.09, 0.05, 0.3
    whole = inertia + m * radius**2
    system = DaeSystem.from_functions(
        ["x", "y", "heading", "roll", "vx", "vy", "w", "W"],
        f=lambda x: [x[4], x[5], x[6], x[7], 0, 0, 0, 0],
        g=lambda x: [
            *[[0, 0]] * 4,
            [1 / m, 0],
            [0, 1 / m],
            [0, 0],
            [-radius * ca.cos(x[2]) / inertia, -radius * ca.sin(x[2]) / inertia],
        ],
        h=lambda x: [*[[0, 0]] * 6, [0, 1 / spin], [1 / inertia, 0]],
        k=lambda x: [
            x[4] - radius * ca.cos(x[2]) * x[7],
            x[5] - radius * ca.sin(x[2]) * x[7],
        ],
        l=lambda x: [x[2], x[3]],
        m=lambda x: [[0, 0], [0, 0]],
        output_signals=["heading", "roll"],
        name="rolling disk",
    )

    def closed_form(x: Array) -> Known:
        s, c = np.sin(x[2]), np.cos(x[2])
        along, across = np.array([c, s]), np.array([s, -c])
        return known(
            np.eye(2) / m + radius**2 / inertia * np.outer(along, along),
            -m * radius * x[6] * x[7] * across,
            np.column_stack([m * radius / whole * along, [0, 0]]),
            [0, 0],
            [[0, 1 / spin], [1 / whole, 0]],
        )

    def consistent(random: np.random.Generator) -> Array:
        x, y, heading, roll, w, spun = random.uniform(-1.0, 1.0, 6)
        speed = radius * spun
        return np.array(
            [x, y, heading, roll, speed * np.cos(heading), speed * np.sin(heading), w, spun]
        )

    def derivatives(x: Array) -> Array:
        speed = radius * x[7]
        return np.array([x[4] - np.cos(x[2]) * speed, x[5] - np.sin(x[2]) * speed])

    return Problem(
        system=system,
        constraint_degrees=(1, 1),
        output_degrees=(2, 2),
        index=2,
        zero_dynamics=2,
        output_order=(0, 1),
        known=closed_form,
        consistent=consistent,
        reference=[(0.5, 0.0, 0.5), (0.0, 1.0, 0.5)],
        derivatives=derivatives,
        source="Bloch, Nonholonomic Mechanics and Control, 2003, 1.4: the vertical rolling disk",
    )


def swing_network() -> Problem:
    """Two generators and a load without inertia: power flow as an algebraic constraint.

    d_i' = w_i, M_i w_i' = P_i - D_i w_i - b_i sin(d_i - t) (+ u for the first), and the load bus
    takes k = sum b_i sin(d_i - t) - P = 0. Its angle t is an algebraic variable of an index 1
    system; as a state with t' = v it has r = 1, and A = -sum b_i cos(d_i - t) is the power flow
    Jacobian. With z = d_1 the second generator is left: it swings and is damped.
    """
    inertia, damping, power, load = (0.1, 0.15), (0.2, 0.4), (0.7, 0.6), 1.3
    links = (2.0, 1.5)
    system = DaeSystem.from_functions(
        [Signal("d1", "rad"), "w1", Signal("d2", "rad"), "w2", Signal("t", "rad")],
        f=lambda x: [
            x[1],
            (power[0] - damping[0] * x[1] - links[0] * ca.sin(x[0] - x[4])) / inertia[0],
            x[3],
            (power[1] - damping[1] * x[3] - links[1] * ca.sin(x[2] - x[4])) / inertia[1],
            0,
        ],
        g=lambda x: [0, 0, 0, 0, 1],
        h=lambda x: [0, 1 / inertia[0], 0, 0, 0],
        k=lambda x: links[0] * ca.sin(x[0] - x[4]) + links[1] * ca.sin(x[2] - x[4]) - load,
        l=lambda x: x[0],
        m=lambda x: 0,
        nominal_state=[0.1, 0.0, 0.1, 0.0, -0.3],
        name="swing network",
    )

    def closed_form(x: Array) -> Known:
        stiff = np.array(links) * np.cos([x[0] - x[4], x[2] - x[4]])
        drift = power[0] - damping[0] * x[1] - links[0] * np.sin(x[0] - x[4])
        return known(
            -stiff.sum(),
            stiff @ [x[1], x[3]] / stiff.sum(),
            0,
            drift / inertia[0],
            1 / inertia[0],
        )

    def consistent(random: np.random.Generator) -> Array:
        """From the flows, which are given: b_1 sin(d1 - t) = P - b_2 sin(d2 - t)."""
        first, angle = random.uniform(0.5, 0.8), random.uniform(-0.4, 0.0)
        d1 = angle + np.arcsin(first / links[0])
        d2 = angle + np.arcsin((load - first) / links[1])
        return np.array([d1, random.uniform(-0.3, 0.3), d2, random.uniform(-0.3, 0.3), angle])

    return Problem(
        system=system,
        constraint_degrees=(1,),
        output_degrees=(2,),
        index=2,
        zero_dynamics=2,
        output_order=(0,),
        known=closed_form,
        consistent=consistent,
        reference=[(0.1, 0.0, 0.2)],
        derivatives=lambda x: np.array(
            [links[0] * np.sin(x[0] - x[4]) + links[1] * np.sin(x[2] - x[4]) - load]
        ),
        source="Hill and Mareels, IEEE Transactions on Circuits and Systems 37(11), 1990: index 1 "
        "where the power flow Jacobian is regular, so 2 with t' = v; network: Bergen and Hill, "
        "IEEE Transactions on Power Apparatus and Systems 100(1), 1981",
        minimum_phase=True,
    )


def _tanks(levels, gains, splits, name: str, minimum_phase: bool) -> Problem:
    """Four tanks, two pumps: levels in cm, pump voltages in V, the numbers of Johansson 2000.

    A_1 h_1' = -a_1 s_1 + a_3 s_3 + g_1 k_1 u_1,  A_3 h_3' = -a_3 s_3 + (1 - g_2) k_2 u_2, and with
    1, 2 and 3, 4 exchanged, where s_i = sqrt(2 g h_i). z = (h_1, h_2), mu = (1, 1). The zeros solve
    (1 + s T_3)(1 + s T_4) = (1 - g_1)(1 - g_2)/(g_1 g_2): both negative where g_1 + g_2 > 1.
    """
    area, hole = np.array([28.0, 32.0, 28.0, 32.0]), np.array([0.071, 0.057, 0.071, 0.057])
    (k1, k2), (g1, g2), gravity = gains, splits, 981.0

    def f(x: ca.SX) -> list[ca.SX]:
        out = [hole[i] * ca.sqrt(2 * gravity * x[i]) for i in range(4)]
        return [
            (out[2] - out[0]) / area[0],
            (out[3] - out[1]) / area[1],
            -out[2] / area[2],
            -out[3] / area[3],
        ]

    system = DaeSystem.from_functions(
        [Signal(f"h{i + 1}", "cm") for i in range(4)],
        f=f,
        h=lambda x: [
            [g1 * k1 / area[0], 0],
            [0, g2 * k2 / area[1]],
            [0, (1 - g2) * k2 / area[2]],
            [(1 - g1) * k1 / area[3], 0],
        ],
        l=lambda x: [x[0], x[1]],
        control_signals=[Signal("pump1", "V"), Signal("pump2", "V")],
        output_signals=[Signal("h1", "cm"), Signal("h2", "cm")],
        nominal_state=levels,
        name=name,
    )

    def closed_form(x: Array) -> Known:
        out = hole * np.sqrt(2 * gravity * x)
        return unconstrained(
            2, (out[2:] - out[:2]) / area[:2], np.diag([g1 * k1, g2 * k2] / area[:2])
        )

    return Problem(
        system=system,
        constraint_degrees=(),
        output_degrees=(1, 1),
        index=0,
        zero_dynamics=2,
        output_order=(0, 1),
        known=closed_form,
        consistent=lambda random: np.array(levels) + random.uniform(-0.2, 0.2, 4),
        reference=[(levels[0], 0.0, 0.1), (levels[1], 0.0, 0.1)],
        source="Johansson, IEEE Transactions on Control Systems Technology 8(3), 2000",
        minimum_phase=minimum_phase,
    )


def quadruple_tank() -> Problem:
    """The minimum phase setting, P-: most of each pump goes to its lower tank. See `_tanks`."""
    return _tanks([12.4, 12.7, 1.8, 1.4], (3.33, 3.35), (0.70, 0.60), "quadruple tank", True)


def quadruple_tank_crossed() -> Problem:
    """The nonminimum phase setting, P+: most of each pump goes to the upper tank across."""
    return _tanks(
        [12.6, 13.0, 4.8, 4.9], (3.14, 3.29), (0.43, 0.34), "crossed quadruple tank", False
    )


def aircraft() -> Problem:
    """A planar vertical takeoff aircraft whose roll jets also push sideways: e = 0.5.

    x'' = -s u1 + e c u2, y'' = c u1 + e s u2 - 1, roll'' = u2: mu = (2, 2), det B = -e. With z at
    rest e roll'' = sin roll is left, an inverted pendulum.
    """
    e = 0.5
    system = DaeSystem.from_functions(
        ["x", "y", "roll", "vx", "vy", "rate"],
        f=lambda x: [x[3], x[4], x[5], 0, -1, 0],
        h=lambda x: [
            *[[0, 0]] * 3,
            [-ca.sin(x[2]), e * ca.cos(x[2])],
            [ca.cos(x[2]), e * ca.sin(x[2])],
            [0, 1],
        ],
        l=lambda x: [x[0], x[1]],
        name="aircraft",
    )

    def closed_form(x: Array) -> Known:
        s, c = np.sin(x[2]), np.cos(x[2])
        return unconstrained(2, [0, -1], [[-s, e * c], [c, e * s]])

    return Problem(
        system=system,
        constraint_degrees=(),
        output_degrees=(2, 2),
        index=0,
        zero_dynamics=2,
        output_order=(0, 1),
        known=closed_form,
        consistent=lambda random: random.uniform(-0.3, 0.3, 6),
        reference=[(0.0, 0.0, 0.2), (0.0, 0.0, 0.2)],
        horizon=1.0,  # Its zero dynamics are not stable.
        source="Hauser, Sastry and Meyer, Automatica 28(4), 1992",
        minimum_phase=False,
    )


def dc_motor() -> Problem:
    """A motor controlled by its field: field and armature currents i, j and speed w.

    i' = -a i + u, j' = -b j + c - d i w, w' = e i j, z = w. So w'' = e ((-a i + u) j + i j') and
    B = e j: mu = 2 as long as j is not 0. At constant speed i = 0, and j' = -b j + c is left.
    """
    a, b, c, d, e = 1.2, 0.8, 1.6, 0.7, 1.5
    system = DaeSystem.from_functions(
        ["i", "j", "w"],
        f=lambda x: [-a * x[0], -b * x[1] + c - d * x[0] * x[2], e * x[0] * x[1]],
        h=lambda x: [1, 0, 0],
        l=lambda x: x[2],
        nominal_state=[0.0, 2.0, 1.0],
        name="DC motor",
    )

    def closed_form(x: Array) -> Known:
        armature = -b * x[1] + c - d * x[0] * x[2]
        return unconstrained(1, e * (-a * x[0] * x[1] + x[0] * armature), e * x[1])

    return Problem(
        system=system,
        constraint_degrees=(),
        output_degrees=(2,),
        index=0,
        zero_dynamics=1,
        output_order=(0,),
        known=closed_form,
        consistent=lambda random: np.array([0, 2, 1]) + random.uniform(-0.3, 0.3, 3),
        reference=[(1.0, 0.0, 0.2)],
        source="Khalil, Nonlinear Systems, 2002, chapter 13: the field-controlled DC motor",
        minimum_phase=True,
    )


def gantry() -> Problem:
    """Four masses m_i q'' = -c q^3 + v + u; two rest against stops, z = (v1, q3, v2, q4).

    The forces stand between the positions: (15) must permute to (q3, q4, v1, v2), mu = 2, 2, 0, 0.
    """
    masses, c = np.array([1.0, 2.0, 3.0, 4.0]), 2.0
    q, qd = ca.SX.sym("q", 4), ca.SX.sym("qd", 4)
    stops = np.vstack([np.eye(2), np.zeros((2, 2))])
    inverse = np.diag(1 / masses)
    system = DaeSystem(
        state=ca.vertcat(q, qd),
        f=ca.vertcat(qd, -c * q**3 / masses),
        g=np.vstack([np.zeros((4, 2)), inverse @ stops]),
        h=np.vstack([np.zeros((4, 4)), inverse]),
        k=q[:2] - 1.0,
        l=[0, q[2], 0, q[3]],
        m=[[1, 0], [0, 0], [0, 1], [0, 0]],
        output_signals=["v1", "q3", "v2", "q4"],
        nominal_state=[1.0] * 4 + [0.0] * 4,
        name="gantry",
    )

    def closed_form(x: Array) -> Known:
        force = c * x[:4] ** 3
        unit = np.eye(4)
        return known(
            np.diag(1 / masses[:2]),
            force[:2],
            -unit[:2],
            [force[0], -force[2] / masses[2], force[1], -force[3] / masses[3]],
            [-unit[0], unit[2] / masses[2], -unit[1], unit[3] / masses[3]],
        )

    def consistent(random: np.random.Generator) -> Array:
        return np.concatenate(
            [[1, 1], random.standard_normal(2), [0, 0], random.standard_normal(2)]
        )

    return Problem(
        system=system,
        constraint_degrees=(2, 2),
        output_degrees=(0, 2, 0, 2),
        index=3,
        zero_dynamics=0,
        output_order=(1, 3, 0, 2),
        known=closed_form,
        consistent=consistent,
        reference=[(3.0, 0.0, 1.0), (1.0, 0.0, 0.4), (2.0, 0.0, 1.0), (1.0, 0.0, 0.3)],
        derivatives=lambda x: np.array([x[0] - 1, x[4], x[1] - 1, x[5]]),
    )


def scalar() -> Problem:
    """n = 1, m = 0: x' = -x^3 + u, z = x, mu = 1. All matrices are 1 x 1."""
    system = DaeSystem.from_functions(
        1, f=lambda x: -(x[0] ** 3), h=lambda x: 2, l=lambda x: x, name="scalar"
    )
    return Problem(
        system=system,
        constraint_degrees=(),
        output_degrees=(1,),
        index=0,
        zero_dynamics=0,
        output_order=(0,),
        known=lambda x: unconstrained(1, -(x[0] ** 3), 2),
        consistent=lambda random: random.standard_normal(1),
        reference=[(0.0, 0.0, 1.0)],
    )


def held_point() -> Problem:
    """n = m = p = 1: x' = -x + 3 v + u is held at x = 2, so N* is a point.

    k' = -x + 3 v + u, so v = (x - u)/3 and z = x + v has mu = 0. No state is free.
    """
    system = DaeSystem.from_functions(
        1,
        f=lambda x: -x,
        g=lambda x: 3,
        h=lambda x: 1,
        k=lambda x: x - 2,
        l=lambda x: x,
        m=lambda x: 1,
        name="held point",
    )
    return Problem(
        system=system,
        constraint_degrees=(1,),
        output_degrees=(0,),
        index=2,
        zero_dynamics=0,
        output_order=(0,),
        known=lambda x: known(3, x[0] / 3, -1 / 3, x[0] + x[0] / 3, -1 / 3),
        consistent=lambda random: np.array([2.0]),
        reference=[(1.0, 0.0, 1.0)],
        derivatives=lambda x: x - 2,
    )


PROBLEMS: dict[str, Callable[[], Problem]] = {
    function.__name__: function
    for function in (
        pendulum,
        pendulum_tension,
        two_link_arm,
        circuit,
        linear,
        third_order,
        mixed_degrees,
        cart,
        flexible_pendulum,
        knife_edge,
        knife_edge_force,
        chaplygin_sleigh,
        rolling_disk,
        swing_network,
        quadruple_tank,
        quadruple_tank_crossed,
        aircraft,
        dc_motor,
        gantry,
        scalar,
        held_point,
    )
}


def double_integrator(**changes) -> DaeSystem:
    """q'' = u, z = q, and what a test changes."""
    fields = {
        "f": lambda x: [x[1], 0],
        "h": lambda x: [0, 1],
        "l": lambda x: x[0],
        "name": "double integrator",
    }
    return DaeSystem.from_functions(2, **{**fields, **changes})


def reference_at(problem: Problem, time: float) -> Array:
    """R(t) of start + slope t + amplitude sin(1.3 t + i), with derivatives, output-major."""
    values = []
    for i, ((start, slope, amplitude), degree) in enumerate(
        zip(problem.reference, problem.output_degrees, strict=True)
    ):
        for order in range(degree + 1):
            line = (start + slope * time, slope)[order] if order < 2 else 0.0
            phase = 1.3 * time + i + order * np.pi / 2
            values.append(line + amplitude * 1.3**order * np.sin(phase))
    return np.array(values)


def wanted_outputs(problem: Problem, times: Array) -> Array:
    """r_i(t) without derivatives, shape (k, p)."""
    starts = np.cumsum([0, *(degree + 1 for degree in problem.output_degrees[:-1])])
    return np.array([reference_at(problem, time)[starts] for time in times])


def closed_loop_outputs(
    problem: Problem, law: TrackingLaw, start: Array, times: Array
) -> tuple[Array, Array]:
    """Outputs and states of x' = f + g v + h u with v = alpha + beta u by hand and u of the law.

    SciPy's DOP853 with tolerances of 1e-11: an integrator and an elimination that the library does
    not know.

    Returns:
        z, shape (k, p), and x, shape (k, n).
    """
    system = problem.system
    numbers = ca.Function(
        "numbers",
        [system.state, system.parameter_symbol],
        [ca.densify(e) for e in (system.f, system.g, system.h, system.l, system.m)],
    )

    def at(time: float, x: Array) -> tuple[Array, Array]:
        f, g, h, el, em = (np.array(e) for e in numbers(x, system.parameter_values))
        closed_form = problem.known(x)
        u = law.control(x, reference_at(problem, time))
        v = closed_form.alpha + closed_form.beta @ u
        return f[:, 0] + g @ v + h @ u, el[:, 0] + em @ v

    solution = solve_ivp(
        lambda t, x: at(t, x)[0],
        (times[0], times[-1]),
        start,
        method="DOP853",
        t_eval=times,
        rtol=1e-11,
        atol=1e-12,
    )
    assert solution.success, solution.message
    states = solution.y.T
    return np.array([at(t, x)[1] for t, x in zip(times, states, strict=True)]), states


class Hidden(NamedTuple):
    """A random system made from its normal form, and the degrees that it was made with."""

    system: DaeSystem
    constraint_degrees: tuple[int, ...]
    output_degrees: tuple[int, ...]
    zero_dynamics: int


def hidden_normal_form(seed: int) -> Hidden:
    """A system whose normal form (26) is drawn first and then hidden.

    In coordinates w the constraints and the outputs with mu_i > 0 are heads of chains of
    integrators, which v and u enter at the end:

        c^(r)  = A(w) (v - beta(w) u - a(w)),    z^(mu) = b(w) + D v + (B1 - D beta(w)) u,

    so that v = a + beta u and z^(mu) = ... + B1 u. An output of degree 0 is l(w) + m v with the
    rows m beta of B. An output of degree mu > 0 may also be a constraint input v_j: then the row
    beta_j is zero and a_j is the head of its chain. A constraint may have others of at least its
    degree added. Other coordinates are moved by everything. Then a regular feedback u -> gamma(x) +
    sigma u, a change of basis of v, a polynomial diffeomorphism x = T(w), which is triangular and
    so inverted exactly, and a rotation hide all that. None changes a degree.
    """
    random = np.random.default_rng(seed)
    while True:
        m, p = int(random.integers(0, 4)), int(random.integers(1, 5))
        r = tuple(int(i) for i in random.integers(1, 4, m))
        # Of m constraint inputs at most m are outputs: m beta has as many rows as are met at once,
        # and no column of a beta_j that is zero.
        met = int(random.integers(0, min(m, p) + 1))
        felt = int(random.integers(0, min(m, p) - met + 1))
        mu = [0] * met + [int(i) for i in random.integers(1, 4, p - met)]
        free = int(random.integers(0, 4))
        n = sum(r) + sum(mu) + free
        if 1 <= n <= 8 and m < n:
            break
    w = ca.SX.sym("w", n)

    def smooth(rows: int, columns: int = 1, size: float = 0.5) -> ca.SX:
        """Random quadratic polynomials of w."""
        basis = ca.vertcat(1, w, w**2, w[0] * w[-1])
        return ca.reshape(
            ca.mtimes(size * random.normal(size=(rows * columns, basis.numel())), basis),
            rows,
            columns,
        )

    while True:
        beta = random.normal(size=(m, p)) + smooth(m, p, 0.1)
        beta[m - felt :, :] = 0
        b1, rows = random.normal(size=(p - met, p)), random.normal(size=(met, m))
        nominal_beta = np.array(ca.Function("beta", [w], [ca.densify(beta)])(np.zeros(n)))
        b = np.vstack([rows @ nominal_beta.reshape(m, p), b1])
        if np.linalg.svd(b, compute_uv=False)[-1] > 0.3:
            break
    a = np.linalg.qr(random.normal(size=(m, m)))[0] + smooth(m, m, 0.1)
    by_force = random.normal(size=(p - met, m))

    starts = np.cumsum([0, *r, *mu[met:]])
    heads = [w[int(start)] for start in starts[:-1]]
    force_drift, output_drift = smooth(m), smooth(p - met)
    for j in range(felt):
        force_drift[m - felt + j] = heads[m + j]
    f, g, h = ca.SX(n, 1), ca.SX(n, m), ca.SX(n, p)
    for i, (start, end) in enumerate(pairwise(starts)):
        for j in range(start, end - 1):
            f[j] = w[j + 1]
        last = int(end) - 1
        if i < m:
            f[last] = -ca.mtimes(a[i, :], force_drift)
            g[last, :] = a[i, :]
            h[last, :] = -ca.mtimes(a[i, :], beta)
        else:
            f[last] = output_drift[i - m]
            g[last, :] = by_force[i - m : i - m + 1]
            h[last, :] = b1[i - m : i - m + 1] - ca.mtimes(by_force[i - m : i - m + 1], beta)
    row = int(starts[-1])
    f[row:], g[row:, :], h[row:, :] = smooth(free), smooth(free, m), smooth(free, p)
    output = ca.vertcat(ca.SX(0, 1), smooth(met), ca.SX(felt, 1), *heads[m + felt :])
    force = ca.vertcat(ca.SX(rows), ca.SX(p - met, m))
    for j in range(felt):
        force[met + j, m - felt + j] = 1
    constraint = ca.vertcat(ca.SX(0, 1), *heads[:m])
    added = 0.5 * random.normal(size=(m, m))
    for i in range(m):
        # By one way only, so that the rows stay independent.
        others = [j for j in range(m) if (r[j], j) > (r[i], i)]
        constraint[i] += sum(added[i, j] * heads[j] for j in others)

    # A regular feedback and a change of basis.
    f += ca.mtimes(h, smooth(p))
    h = ca.mtimes(h, np.eye(p) + smooth(p, p, 0.1))
    basis = np.eye(m) + 0.3 * random.normal(size=(m, m))
    g, force = ca.mtimes(g, basis), ca.mtimes(force, basis)

    # x = Q T(w), with T_i = w_i + a polynomial of the w_j before it.
    rotation = np.linalg.qr(random.normal(size=(n, n)))[0]
    x = ca.SX.sym("x", n)
    straight = ca.mtimes(rotation.T, x)
    forward, inverse = ca.SX(w), ca.SX(n, 1)
    inverse[0] = straight[0]
    for i in range(1, n):
        c = 0.2 * random.normal(size=(2, i))
        bend = ca.dot(c[0], w[:i] ** 2) + w[0] * ca.dot(c[1], w[:i])
        forward[i] += bend
        inverse[i] = straight[i] - ca.substitute(bend, w[:i], inverse[:i])
    jacobian = ca.mtimes(rotation, ca.jacobian(forward, w))

    def hidden(expression: ca.SX) -> ca.SX:
        return ca.substitute(expression, w, inverse)

    order = random.permutation(p)
    system = DaeSystem(
        state=x,
        f=hidden(ca.mtimes(jacobian, f)),
        g=hidden(ca.mtimes(jacobian, g)),
        h=hidden(ca.mtimes(jacobian, h)),
        k=hidden(constraint),
        l=hidden(output[[int(i) for i in order]]),
        m=force[[int(i) for i in order], :],
        name=f"hidden {seed}",
    )
    return Hidden(system, r, tuple(mu[i] for i in order), free)


def changed(system: DaeSystem, **fields) -> DaeSystem:
    """The system with other expressions or labels."""
    return replace(system, **fields)


def in_other_units(system: DaeSystem, state, force, control, constraint, output) -> DaeSystem:
    """The same system with x, v, u, y, z measured in other units: factors per entry."""
    x = ca.SX.sym("x", system.num_states)

    def moved(expression: ca.SX) -> ca.SX:
        return ca.substitute(expression, system.state, state * x)

    return replace(
        system,
        state=x,
        f=moved(system.f) / state,
        g=ca.mtimes(np.diag(1 / state), ca.mtimes(moved(system.g), np.diag(force))),
        h=ca.mtimes(np.diag(1 / state), ca.mtimes(moved(system.h), np.diag(control))),
        k=moved(system.k) / constraint,
        l=moved(system.l) / output,
        m=ca.mtimes(np.diag(1 / output), ca.mtimes(moved(system.m), np.diag(force))),
        nominal_state=system.nominal_state / state,
    )
