"""Direct collocation of a DAE, with its constraint forces among the unknowns.

The states of an element of length h are a polynomial through x_0, at its beginning, and x_1, ...,
x_s at the points of Radau. With the constraint y = k(x) of degree r, at each of these points

    x'(t_i) = f(x_i) + g(x_i) v_i + h(x_i) u_i + D_i^T w_i,
    0 = (k, k', ..., k^(r-1))(x_i),    0 = k^(r)(x_i, v_i, u_i),

where D is the gradient of (k, ..., k^(r-1)): the last equation makes v_i the true constraint
force, those before it hold the state on N*, and w_i, which vanishes with h, makes room for them. So
the constraint holds at each level at every point, and nothing drifts from element to element.

It is the stabilization of Gear, Gupta and Leimkuhler (1985) at all levels, on Radau IIA of order
2 s - 1; see also Bordalba, Schoels, Ros, Porta and Diehl, Direct collocation methods for trajectory
optimization in constrained robotic systems, IEEE Trans. Robotics 39, 2023.
"""

import time

import casadi as ca
import numpy as np
from task import DURATION, LEAST, MOST, Plan

import drake_dae as dd

ELEMENTS, POINTS = 10, 5


def plan(model: dd.RobotModel, first: np.ndarray, last: np.ndarray) -> Plan:
    """From rest to rest with the least integral of u'u, always in contact."""
    begun = time.perf_counter()
    dae = model.dae.explicit
    rate, levels, forced = equations(dae)
    n, m, p = dae.num_states, dae.num_constraints, dae.num_controls
    points = np.array(ca.collocation_points(POINTS, "radau"))
    slopes, weights = tables(points)
    step = DURATION / ELEMENTS
    problem = ca.Opti()
    knots = [problem.variable(n) for _ in range(ELEMENTS + 1)]
    x, u, v, w = (
        [[problem.variable(size) for _ in range(POINTS)] for _ in range(ELEMENTS)]
        for size in (n, p, m, levels.numel_out(0))
    )
    cost = 0.0
    problem.subject_to(knots[0] == first)
    # The end is on N*: one joint says where, and the other follows.
    problem.subject_to(knots[-1][[0, 2]] == last[[0, 2]])
    for k in range(ELEMENTS):
        states = ca.horzcat(knots[k], *x[k])
        for i in range(POINTS):
            wanted = ca.mtimes(states, slopes[:, i]) / step
            problem.subject_to(wanted == rate(x[k][i], v[k][i], u[k][i], w[k][i]))
            problem.subject_to(levels(x[k][i]) == 0)
            problem.subject_to(forced(x[k][i], v[k][i], u[k][i]) == 0)
            problem.subject_to(problem.bounded(LEAST, v[k][i], MOST))
            cost += step * weights[i] * ca.sumsqr(u[k][i])
            problem.set_initial(x[k][i], first + (last - first) * (k + points[i]) / ELEMENTS)
            problem.set_initial(v[k][i], 0.5 * (LEAST + MOST))
        problem.set_initial(knots[k], first + (last - first) * k / ELEMENTS)
        problem.subject_to(knots[k + 1] == x[k][-1])
    problem.set_initial(knots[-1], last)
    problem.minimize(cost)
    quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    problem.solver("ipopt", {"expand": True, **quiet})
    found = problem.solve()
    seconds = time.perf_counter() - begun

    def value(columns: list[list[ca.MX]]) -> np.ndarray:
        stacked = ca.horzcat(*(each for element in columns for each in element))
        return np.array(found.value(stacked)).reshape(-1, ELEMENTS, POINTS)

    starts = np.array(found.value(ca.horzcat(*knots[:-1]))).reshape(n, ELEMENTS, 1)
    states, controls, forces = np.concatenate([starts, value(x)], axis=2), value(u), value(v)
    with_begin, breaks = np.append(0.0, points), np.linspace(0.0, DURATION, ELEMENTS + 1)

    def through(values: np.ndarray, nodes: np.ndarray, t: float) -> np.ndarray:
        """The polynomials of an element through its values."""
        k = min(int(np.searchsorted(breaks, t, side="right")), ELEMENTS) - 1
        at = (t - breaks[k]) / step
        basis = [
            np.prod((at - np.delete(nodes, i)) / (a - np.delete(nodes, i)))
            for i, a in enumerate(nodes)
        ]
        return values[:, k] @ np.array(basis)

    return Plan(
        f"DAE, {ELEMENTS} elements of Radau IIA of order {2 * POINTS - 1}",
        seconds,
        lambda t: through(states, with_begin, t),
        lambda t: through(controls, points, t),
        lambda t: float(through(forces, points, t)[0]),
        breaks,
        bool(found.stats()["success"]),
    )


def equations(dae: dd.DaeSystem) -> tuple[ca.Function, ca.Function, ca.Function]:
    """x' with the correction w, the levels (k, ..., k^(r-1)), and k^(r) by the control."""
    (degree,) = set(dd.find_constraint_structure(dae).constraint_degrees)
    u, v = ca.SX.sym("u", dae.num_controls), ca.SX.sym("v", dae.num_constraints)
    values = ca.DM(dae.parameter_values)
    moved = dae.f + ca.mtimes(dae.g, v) + ca.mtimes(dae.h, u)
    chain = [dae.k]
    for _ in range(degree - 1):
        chain.append(ca.jtimes(chain[-1], dae.state, dae.f))
    levels = ca.vertcat(*chain)
    w = ca.SX.sym("w", levels.numel())
    rate = moved + ca.mtimes(ca.jacobian(levels, dae.state).T, w)
    forced = ca.jtimes(chain[-1], dae.state, moved)
    given = {"rate": ([dae.state, v, u, w], rate), "levels": ([dae.state], levels)}
    given["forced"] = ([dae.state, v, u], forced)
    return tuple(
        ca.Function(name, arguments, [ca.substitute(value, dae.parameter_symbol, values)])
        for name, (arguments, value) in given.items()
    )


def tables(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives at the points of the polynomials through 0 and the points, and weights."""
    slopes, _, _ = ca.collocation_coeff(points.tolist())
    powers = np.vander(points, increasing=True).T
    weights = np.linalg.solve(powers, 1.0 / np.arange(1, points.size + 1))
    return np.array(slopes), weights
