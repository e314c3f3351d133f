"""Systems made up for what no machine at hand shows, and systems in other units."""

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np

from drake_dae.dae import DaeSystem, with_disturbance
from problems.problem import Array, Known, Problem, known


def pushed_mass(mass: float, stiffness: float = 0.0, damping: float = 0.0) -> DaeSystem:
    """m q'' = u - k q - d q' + r with the disturbance r."""
    x, none = ca.SX.sym("x", 2), ca.SX(0, 1)
    system = DaeSystem(
        x,
        ca.vertcat(x[1], -stiffness * x[0] - damping * x[1]),
        ca.SX(2, 0),
        ca.vertcat(0, 1),
        none,
        x[0],
        ca.SX(1, 0),
        mass_matrix=ca.diag(ca.SX([1.0, mass])),
        state_signals=("q", "v"),
    )
    return with_disturbance(system, ["v"])


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
            [x[0] - x[3] ** 2, x[1] - 2 * x[3] * x[4], x[2] - 2 * x[4] ** 2 - 2 * x[3] * x[5]]
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


def double_integrator(**changes) -> DaeSystem:
    """q'' = u, z = q, and what a test changes."""
    fields = {
        "f": lambda x: [x[1], 0],
        "h": lambda x: [0, 1],
        "l": lambda x: x[0],
        "name": "double integrator",
    }
    return DaeSystem.from_functions(2, **{**fields, **changes})


def system_of(size: int, **fields: Callable) -> DaeSystem:
    """A system of so many states, of functions."""
    return DaeSystem.from_functions(size, **{"name": "test", **fields})


def redundant(k: Callable, **changes) -> DaeSystem:
    """Two constraints k on the point x'' = v1 + v2, beside z'' = u + v2."""
    fields = {
        "f": lambda x: [x[1], 0, x[3], 0],
        "g": lambda x: [[0, 0], [1, 1], [0, 0], [0, 1]],
        "h": lambda x: [0, 0, 0, 1],
        "k": k,
        "l": lambda x: x[2],
        "m": lambda x: [[0, 0]],
    }
    return system_of(4, **{**fields, **changes})


def early_control() -> DaeSystem:
    """x0' = x1 + u, x1' = v, k = x0: u acts on k', v on k''. Assumption (3) is violated."""
    return system_of(
        3,
        f=lambda x: [x[1], 0, 0],
        g=lambda x: [0, 1, 0],
        h=lambda x: [1, 0, 1],
        k=lambda x: x[0],
        l=lambda x: x[2],
        m=lambda x: 0,
    )


def bead() -> DaeSystem:
    """A bead with k = x2 - x1^2 / 2, forced along x1 alone: A = -x1 vanishes at x1 = 0."""
    return DaeSystem.from_functions(
        ["x1", "x2"],
        f=lambda x: [-1.0, x[0]],
        g=lambda x: [1.0, 0.0],
        h=lambda x: [0.0, 1.0],
        k=lambda x: [x[1] - x[0] ** 2 / 2],
        l=lambda x: [0.0],
        m=lambda x: [[1.0]],
        nominal_state=[1.0, 0.5],
    )


TABLE = [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)]


def plate(rows, **fields):
    """A plate (z, a, b) on legs at the corners r: heights z + a r_x + b r_y = 0, forces by J^T."""
    jacobian = np.array([[1.0, x, y] for x, y in rows])
    mass = np.diag([4.0, 0.5, 0.25])
    q, v, names = slice(0, 3), slice(3, 6), [f"leg{i}" for i in range(len(rows))]
    return DaeSystem.from_functions(
        ["z", "a", "b", "vz", "va", "vb", "s"],
        f=lambda x: ca.vertcat(x[v], -9.81 * 4.0, 0.3, -0.2, 0),
        g=lambda x: ca.vertcat(ca.SX(3, len(rows)), jacobian.T, ca.SX(1, len(rows))),
        h=lambda x: ca.vertcat(ca.SX(6, 1), 1),
        k=lambda x: ca.mtimes(ca.SX(jacobian), x[q]),
        l=lambda x: [x[6]],
        m=lambda x: ca.SX(1, len(rows)),
        mass_matrix=np.block(
            [
                [np.eye(3), np.zeros((3, 4))],
                [np.zeros((3, 3)), mass, np.zeros((3, 1))],
                [np.zeros((1, 6)), np.ones((1, 1))],
            ]
        ),
        constraint_output_signals=names,
        **fields,
    )


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
        state_scale=system.scale / state,
    )
