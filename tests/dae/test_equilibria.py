"""Equilibria of zero dynamics: where they are, which are none, and what is said of those."""

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
    zero_dynamics,
)

from drake_dae.dae import DaeSystem, Verdict, ZeroDynamics
from drake_dae.errors import InconsistentStateError


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
    dynamics = zero_dynamics(quadruple_tank(**plant))
    levels, _ = tanks_at_rest(**plant)
    t3, t4 = (TANK_AREAS / HOLES * np.sqrt(2 * levels / TANK_GRAVITY))[2:]
    g1, g2 = plant["valves"]
    expected = np.roots([t3 * t4, t3 + t4, 1 - (1 - g1) * (1 - g2) / (g1 * g2)])
    found = dynamics.eigenvalues(dynamics.equilibrium(plant["levels"]))
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
    found = ZeroDynamics(robot.structure.system, structure=robot.structure).equilibrium(
        [*OFFSET[name], 25.0]
    )
    # The plant and the library differ by round-off of forces of 100 N over stiffnesses of 5e3.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


def test_no_equilibrium_is_reported():
    """s' = 1 + s^2 has none, nor has a blade pinned to a speed; with speed 0 it has many."""
    dynamics = zero_dynamics(internal(lambda s, z: 1 + s**2))
    with pytest.raises(InconsistentStateError, match=r"z = 0 .*s' = ") as e:
        dynamics.equilibrium([0.0])
    assert e.value.residual[1] >= 1.0
    growing = dynamics.stability()
    assert growing.verdict is Verdict.UNDECIDED
    assert (growing.state, growing.eigenvalues.shape) == (None, (0,))

    blade = zero_dynamics(PROBLEMS["knife_edge"]().system)
    with pytest.raises(InconsistentStateError, match=r"V = 0\.8"):
        blade.equilibrium([0.3, 0.8])
    assert blade.stability().verdict is Verdict.UNDECIDED
    # Of the continuum (x, y) none is isolated; what is judged is at the guess.
    rest = np.array([2.0, -1.0, 0.3, 0.0, 0.0, 0.0])
    with pytest.raises(InconsistentStateError):
        blade.equilibrium([0.3, 0.0], rest)
    still = blade.stability(rest)
    assert still.verdict is Verdict.UNDECIDED
    np.testing.assert_allclose(still.state, rest, rtol=0, atol=1e-12)
    np.testing.assert_allclose(still.eigenvalues, [0.0, 0.0], atol=1e-12)


def test_a_clock_among_the_states_is_reported():
    """A force beside c' = 1, held through a matrix whose round-off was divided by: z1 = 3e13."""
    system = DaeSystem.from_functions(
        ["x", "y", "vx", "vy", "c"],
        f=lambda s: [s[2], s[3], 0, 0, 1],
        g=lambda s: [0, 0, 0, 1, 0],
        h=lambda s: [[0, 0], [0, 0], [1, 0], [0, 1], [0, 0]],
        k=lambda s: [s[1] - ca.sin(s[4])],
        l=lambda s: [s[0], 0],
        m=lambda s: [[0], [1]],
        name="moved",
    )
    dynamics = ZeroDynamics(system)
    for outputs in (None, [0.0, 10.0]):
        stability = dynamics.stability(dynamics.structure.states[0], outputs=outputs)
        assert stability.verdict is Verdict.UNDECIDED
        assert "c' = 1" in stability.reason
        assert "z1" not in stability.reason
