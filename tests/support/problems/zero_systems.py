"""Systems with zero dynamics that are known by hand, and pinned motions of problems."""

from collections.abc import Callable

import casadi as ca
import numpy as np

from drake_dae.dae import DaeSystem

Array = np.ndarray


def derivatives(function: Callable[[ca.SX], list], degrees: tuple[int, ...]):
    """t -> R(t) of functions of time, differentiated by CasADi."""
    t = ca.SX.sym("t")
    entries = []
    for value, degree in zip(function(t), degrees, strict=True):
        entries.append(ca.SX(value))
        for _ in range(degree):
            entries.append(ca.jacobian(entries[-1], t))
    traced = ca.Function("reference", [t], [ca.densify(ca.vertcat(*entries))])
    return lambda time: np.array(traced(time))[:, 0]


GRAVITY = 9.81


def cart_pendulum(damping: float = 0.0, angle: float = 0.0) -> DaeSystem:
    """A cart s with a pendulum (x, y) on a rigid rod of length 0.7, pushed; z = s.

    In Cartesian coordinates: m s'' = u - v (x - s), M (x'', y'') = v (x - s, y) - (0, M g), on
    (x - s)^2 + y^2 = L^2. With the cart on s(t) and x - s = L sin a, y = L cos a is left
    L a'' = g sin a - s'' cos a - d L a', with `damping` d as a drag relative to the cart.
    """
    length = 0.7
    s, c = length * np.sin(angle), length * np.cos(angle)

    def drag(x):
        return [-damping * (x[4] - x[3]), -damping * x[5]]

    return DaeSystem.from_functions(
        ["s", "x", "y", "s'", "x'", "y'"],
        f=lambda x: [x[3], x[4], x[5], 0, drag(x)[0], drag(x)[1] - GRAVITY],
        g=lambda x: [0, 0, 0, -(x[1] - x[0]) / 2.0, (x[1] - x[0]) / 0.5, x[2] / 0.5],
        h=lambda x: [0, 0, 0, 1 / 2.0, 0, 0],
        k=lambda x: ((x[1] - x[0]) ** 2 + x[2] ** 2 - length**2) / 2.0,
        l=lambda x: x[0],
        m=lambda x: 0,
        nominal_state=[0.3, 0.3 + s, c, 0.0, 0.0, 0.0],
        output_signals=["s"],
        name="cart with pendulum",
    )


TANK_AREAS, HOLES = np.array([28.0, 32.0, 28.0, 32.0]), np.array([0.071, 0.057, 0.071, 0.057])


TANK_GRAVITY = 981.0


MINIMUM_PHASE = {"pumps": (3.33, 3.35), "valves": (0.70, 0.60), "levels": (12.4, 12.7)}


NON_MINIMUM_PHASE = {"pumps": (3.14, 3.29), "valves": (0.43, 0.34), "levels": (12.6, 13.0)}


def quadruple_tank(pumps, valves, levels) -> DaeSystem:
    """The four tanks of Johansson (2000), in cm and s, z = (h1, h2), u the pumps' voltages.

    Pump i sends the part g_i of k_i u_i to tank i and the rest across to an upper tank, which
    drains into the lower one below it: tank 3 into 1, tank 4 into 2.
    """
    (k1, k2), (g1, g2) = pumps, valves

    def f(x):
        out = [HOLES[i] * ca.sqrt(2 * TANK_GRAVITY * x[i]) for i in range(4)]
        flows = [out[2] - out[0], out[3] - out[1], -out[2], -out[3]]
        return [flow / area for flow, area in zip(flows, TANK_AREAS, strict=True)]

    return DaeSystem.from_functions(
        ["h1", "h2", "h3", "h4"],
        f=f,
        h=lambda x: (
            np.diag(1 / TANK_AREAS)
            @ [[g1 * k1, 0], [0, g2 * k2], [0, (1 - g2) * k2], [(1 - g1) * k1, 0]]
        ),
        l=lambda x: [x[0], x[1]],
        nominal_state=[*levels, 3.0, 3.0],
        output_signals=["h1", "h2"],
        name="four tanks",
    )


def spring_masses(damping: float) -> DaeSystem:
    """Two masses and a spring, the first pushed and pinned: m q2'' = -k (q2 - q1) - d q2'."""
    return DaeSystem.from_functions(
        ["q1", "q2", "v1", "v2"],
        f=lambda x: [
            x[2],
            x[3],
            8.0 * (x[1] - x[0]),
            (-8.0 * (x[1] - x[0]) - damping * x[3]) / 2.0,
        ],
        h=lambda x: [0, 0, 1, 0],
        l=lambda x: x[0],
        output_signals=["q1"],
        name="two masses",
    )


def internal(rate: Callable) -> DaeSystem:
    """z' = u and an internal state s' = rate(s, z)."""
    return DaeSystem.from_functions(
        ["z", "s"],
        f=lambda x: [0, rate(x[1], x[0])],
        h=lambda x: [1, 0],
        l=lambda x: x[0],
        nominal_state=[0.0, 1.0],
        output_signals=["z"],
        name="internal",
    )


def free_arm() -> DaeSystem:
    """A planar arm with links 1.0 and 0.8 and unit inertias, z the position of its tip."""

    def tip(q):
        return [ca.cos(q[0]) + 0.8 * ca.cos(q[0] + q[1]), ca.sin(q[0]) + 0.8 * ca.sin(q[0] + q[1])]

    return DaeSystem.from_functions(
        ["q1", "q2", "v1", "v2"],
        f=lambda x: [x[2], x[3], 0, 0],
        h=lambda x: np.vstack([np.zeros((2, 2)), np.eye(2)]),
        l=tip,
        nominal_state=[0.5, 1.0, 0.0, 0.0],
        output_signals=["x", "y"],
        name="free arm",
    )


def assert_same_numbers(found: Array, expected: Array, **tolerance) -> None:
    """Complex numbers, in any order."""
    assert found.shape == expected.shape
    left = list(expected)
    for number in found:
        left_index = int(np.argmin(np.abs(np.array(left) - number)))
        np.testing.assert_allclose(number, left.pop(left_index), **tolerance)
