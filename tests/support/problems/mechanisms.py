"""Bodies on rods, walls and stops, and bodies that are free."""

import casadi as ca
import numpy as np

from drake_dae.dae import DaeSystem, Signal
from problems.problem import Array, Known, Problem, known, unconstrained


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
    """A two-link arm whose tip slides on a wall (McClamroch and Wang 1988), z = (force, height).

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


def aircraft() -> Problem:
    """A planar aircraft whose roll jets also push sideways (Hauser et al. 1992): e = 0.5.

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
    )


def hanging_pendulum(length: float = 1.0, **changes) -> DaeSystem:
    """A unit mass on a rod in Cartesian coordinates, pushed sideways; z = x, index 3."""
    fields = {
        "f": lambda s, p: [s[2], s[3], 0.0, -p.gravity],
        "g": lambda s, p: [0.0, 0.0, 2 * s[0], 2 * s[1]],
        "h": lambda s, p: [0.0, 0.0, 1.0, 0.0],
        "k": lambda s, p: [s[0] ** 2 + s[1] ** 2 - length**2],
        "l": lambda s, p: [s[0]],
        "m": lambda s, p: [[0.0]],
        "parameters": {"gravity": 9.81},
        "nominal_state": [0.0, -length, 0.0, 0.0],
        "name": "pendulum",
    }
    return DaeSystem.from_functions(["x", "y", "vx", "vy"], **{**fields, **changes})
