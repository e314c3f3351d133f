"""Equilibria of zero dynamics, and verdicts at rest: by eigenvalues, at what is an equilibrium."""

import re

import casadi as ca
import numpy as np
import pytest
from actuated import OFFSET, actuated, at_rest, start_position
from problems import PROBLEMS
from problems.zero_systems import (
    HOLES,
    MINIMUM_PHASE,
    NON_MINIMUM_PHASE,
    TANK_AREAS,
    TANK_GRAVITY,
    Array,
    internal,
    quadruple_tank,
)
from runs import some

from drake_dae.dae import DaeSystem, Verdict, ZeroDynamics


def tanks_at_rest(pumps, valves, levels) -> tuple[Array, Array]:
    """Levels and voltages: outflow = inflow of tanks 1 and 2, hence u; then tanks 3 and 4."""
    k, g = np.array(pumps), np.array(valves)
    inflow = np.array([[g[0] * k[0], (1 - g[1]) * k[1]], [(1 - g[0]) * k[0], g[1] * k[1]]])
    out = HOLES[:2] * np.sqrt(2 * TANK_GRAVITY * np.array(levels))
    u = np.linalg.solve(inflow, out)
    upper = np.array([(1 - g[1]) * k[1] * u[1], (1 - g[0]) * k[0] * u[0]])
    return np.concatenate([levels, (upper / HOLES[2:]) ** 2 / (2 * TANK_GRAVITY)]), u


@pytest.mark.parametrize("plant", [MINIMUM_PHASE, NON_MINIMUM_PHASE])
def test_zeros_of_the_four_tanks(plant):
    """(1 + s T3)(1 + s T4) = (1 - g1)(1 - g2)/(g1 g2), T_i = A_i/a_i sqrt(2 h_i/g)."""
    dynamics = ZeroDynamics(quadruple_tank(**plant))
    levels, _ = tanks_at_rest(**plant)
    t3, t4 = (TANK_AREAS / HOLES * np.sqrt(2 * levels / TANK_GRAVITY))[2:]
    g1, g2 = plant["valves"]
    expected = np.roots([t3 * t4, t3 + t4, 1 - (1 - g1) * (1 - g2) / (g1 * g2)])
    found = dynamics.stability(outputs=plant["levels"]).eigenvalues
    # An equilibrium to 1e-12.
    np.testing.assert_allclose(found, np.sort(expected)[::-1], rtol=1e-9)
    stability = dynamics.stability()
    np.testing.assert_allclose(stability.eigenvalues, found, rtol=1e-9)
    np.testing.assert_allclose(stability.state, levels, rtol=1e-9)
    if plant is MINIMUM_PHASE:
        assert (stability.verdict, g1 + g2 > 1) == (Verdict.STABLE, True)
        published = (-0.018, -0.060)
    else:
        assert (stability.verdict, g1 + g2 < 1) == (Verdict.UNSTABLE, True)
        assert stability.reason.startswith("non-minimum phase")
        published = (0.013, -0.057)
    # As published, for the measured levels.
    np.testing.assert_allclose(found, published, atol=2e-3)


def test_equilibrium_of_a_robot_against_multibody_plant():
    name, kind = "two_link", "damped"
    robot = actuated(name, kind)
    expected, _ = at_rest(name, kind, start_position(name), 25.0)
    dynamics = ZeroDynamics(robot.structure.system, structure=robot.structure)
    guess = robot.structure.system.nominal_state[None]
    (found,) = dynamics.equilibria(guess, outputs=[*OFFSET[name], 25.0])
    # The plant and the library differ by round-off of forces of 100 N over stiffnesses of 5e3.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


def test_no_equilibrium_is_reported():
    """s' = 1 + s^2 has none, nor has a blade pinned to a speed; with speed 0 it has many."""
    dynamics = ZeroDynamics(internal(lambda s, z: 1 + s**2))
    assert not len(dynamics.equilibria(outputs=[0.0]))
    growing = dynamics.stability(outputs=[0.0])
    assert re.search(r"z = 0 .*s' = ", growing.reason)
    assert growing.verdict is Verdict.UNDECIDED
    assert (growing.state, growing.eigenvalues.shape) == (None, (0,))

    blade = ZeroDynamics(PROBLEMS["knife_edge"]().system)
    assert not len(blade.equilibria(outputs=[0.3, 0.8]))
    assert "V = 0.8" in blade.stability(outputs=[0.3, 0.8]).reason
    assert blade.stability().verdict is Verdict.UNDECIDED
    # Of the continuum (x, y) none is isolated; what is judged is at the guess.
    rest = np.array([2.0, -1.0, 0.3, 0.0, 0.0, 0.0])
    assert not len(blade.equilibria(rest, outputs=[0.3, 0.0]))
    still = blade.stability(rest)
    assert still.verdict is Verdict.UNDECIDED
    np.testing.assert_allclose(still.state, rest, rtol=0, atol=1e-12)
    np.testing.assert_allclose(still.eigenvalues, [0.0, 0.0], atol=1e-12)


def beside(rates, count, start=0.1):
    """z' = u, and internal states with given rates, which are functions of these and of z."""
    return DaeSystem.from_functions(
        ["z", *[f"s{i}" for i in range(count)]],
        f=lambda x: [0, *rates(*ca.vertsplit(x)[1:], x[0])],
        h=lambda x: [1] + [0] * count,
        l=lambda x: x[0],
        nominal_state=[0.0, *[start] * count],
    )


def test_a_pole_on_a_cart_that_rests_anywhere_is_unstable():
    """The Jacobian is singular, since the second cart may be anywhere; its pole falls over."""
    told = ZeroDynamics(
        beside(lambda s, v, a, w, z: [v, -v, w, 9.81 * ca.sin(a)], 4, 0.0)
    ).stability()
    assert told.verdict is Verdict.UNSTABLE
    np.testing.assert_allclose(
        np.sort(told.eigenvalues.real), [-(9.81**0.5), -1.0, 0.0, 9.81**0.5], atol=1e-9
    )
    hanging = beside(lambda s, v, a, w, z: [v, -v, w, -9.81 * ca.sin(a) - w], 4, 0.0)
    assert ZeroDynamics(hanging).stability().verdict is Verdict.UNDECIDED


AT_INFINITY = {
    "bell": lambda a: ca.exp(-(a**2)),
    "arc tangent": lambda a: ca.pi / 2 - ca.atan(a),
    "small": lambda a: 1e-3 * ca.exp(-2 * a),
    "falling": lambda a: -1 / (1 + a**2),
}
"""Rates that fall to zero far away, and are zero nowhere."""


@pytest.mark.slow
@pytest.mark.parametrize("name", some(AT_INFINITY, of=3))
@pytest.mark.parametrize("others", some([0, 1, 2], of=3))
def test_what_only_falls_is_no_equilibrium(name, others):
    """Alone, beside a state that decays, and beside an oscillation that does."""
    rate = AT_INFINITY[name]
    more = [lambda *_: [], lambda a, b, z: [-b], lambda a, b, c, z: [c, -b - c]][others]
    dynamics = ZeroDynamics(beside(lambda *x: [rate(x[0]), *more(*x)], 1 + others))
    random = np.random.default_rng(0)
    guesses = random.uniform(-3.0, 60.0, (6, 2 + others))
    assert not len(dynamics.equilibria(guesses, outputs=[0.0]))
    assert dynamics.stability().verdict is not Verdict.STABLE


DEFECTIVE = {
    "two": [[-0.1, 1.0], [0.0, -0.1]],
    "two of 1e-3": [[-1e-3, 1.0], [0.0, -1e-3]],
    "three": [[-0.1, 1.0, 0.0], [0.0, -0.1, 1.0], [0.0, 0.0, -0.1]],
    "four": -0.5 * np.eye(4) + np.diag([1.0] * 3, 1),
    "spirals": np.kron(np.eye(2), [[-0.1, 1.0], [-1.0, -0.1]]) + np.diag([1.0, 1.0], 2),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", some(DEFECTIVE))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_defective_matrix_is_decided(name, sign):
    """Its eigenvalues are known to the root of round-off alone, and far from the axis."""
    matrix = np.array(DEFECTIVE[name], dtype=float)
    if sign < 0.0:
        matrix = -matrix.T
    # In coordinates in which it is not triangular.
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=matrix.shape))[0]
    mixed = ca.DM(turn @ matrix @ turn.T)
    system = beside(
        lambda *x: ca.vertsplit(ca.mtimes(mixed, ca.vertcat(*x[:-1]))), len(matrix), 0.0
    )
    told = ZeroDynamics(system).stability()
    assert told.verdict is (Verdict.STABLE if sign > 0.0 else Verdict.UNSTABLE)
