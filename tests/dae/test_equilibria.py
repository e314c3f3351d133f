"""Equilibria of zero dynamics: where they are, which are none, and what is said of those."""

import warnings

import casadi as ca
import numpy as np
import pytest
from actuated import OFFSET, actuated, at_rest, start_position
from problems import (
    PROBLEMS,
)
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

from drake_dae import ConstantReference, DaePlant, analyze, make_closed_loop
from drake_dae.dae import DaeSystem, TrackingLaw, Verdict, ZeroDynamics, find_structure, poles
from drake_dae.errors import (
    InconsistentStateError,
    NonMinimumPhaseWarning,
)


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


def slider() -> DaeSystem:
    """On a floor that pushes with v, and beside it xi' = xi (v - 40); z = (place, v)."""
    return DaeSystem.from_functions(
        ["x", "y", "vx", "vy", "xi"],
        f=lambda s: [s[2], s[3], 0, -9.81, -40 * s[4]],
        g=lambda s: [0, 0, 0, 1, s[4]],
        h=lambda s: [[0, 0], [0, 0], [1, 0], [0, 1], [0, 0]],
        k=lambda s: [s[1]],
        l=lambda s: [s[0], 0],
        m=lambda s: [[0], [1]],
        name="slider",
    )


@pytest.mark.slow
@pytest.mark.parametrize(("force", "rate"), [(20.0, -20.0), (80.0, 40.0)])
def test_the_force_that_is_asked_for_decides(force, rate):
    """The force is met at once, so that no state tells it: the eigenvalue is v - 40."""
    system = slider()
    structure = find_structure(system)
    dynamics = ZeroDynamics(structure.system, structure=structure)
    outputs = [0.0, force]
    rest = dynamics.equilibrium(outputs)
    assert dynamics.eigenvalues(rest, outputs=outputs) == pytest.approx([rate], rel=1e-9)
    verdict = dynamics.stability(outputs=outputs).verdict
    assert verdict is (Verdict.UNSTABLE if rate > 0 else Verdict.STABLE)
    told = analyze(
        system, reference=lambda t: np.array([0.0, 0.0, 0.0, force]), times=np.linspace(0, 0.1, 5)
    )
    assert told.zero_dynamics.verdict is verdict
    law = TrackingLaw(system, poles(-3.0), structure=structure)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make_closed_loop(
            DaePlant(structure.system, structure=structure), law, [ConstantReference(outputs)]
        )
    assert [w.category for w in caught] == [NonMinimumPhaseWarning] * (rate > 0)


@pytest.mark.parametrize(
    ("rate", "nominal"),
    [(lambda x: -(x**2), 0.1), (lambda x: ca.cos(x) - 1, 0.3), (lambda x: 0 * x, 0.2)],
)
def test_an_equilibrium_that_is_found_slowly_decides_nothing(rate, nominal):
    """Its eigenvalue is 0, and Newton's method ends where it is only near 0."""
    system = DaeSystem.from_functions(
        ["y", "xi"],
        f=lambda x: [0, rate(x[1])],
        h=lambda x: [1, 0],
        l=lambda x: [x[0]],
        nominal_state=[0.0, nominal],
    )
    assert ZeroDynamics(system).stability().verdict is Verdict.UNDECIDED


def test_rest_does_not_depend_on_the_unit_of_time():
    """An electrostatic actuator with its voltage held: a plate on a spring, modes of 2e4 1/s.

    Place, speed and charge in units of the gap, 0.1 m/s and q. What is left of x' where Newton's
    method ends is round-off of these, times the rates. At a voltage V the force is
    e V^2 / (2 (gap - x)^2), so that m s^2 + b s + k - e V^2 / (gap - x)^3 = 0.
    """
    mass, damping, stiffness, gap, e, resistance = 1e-9, 1e-6, 1.0, 2e-6, 8.85e-20, 1e3
    q = np.sqrt(2 * e * stiffness * 0.4 * gap)

    def force(x: ca.SX) -> ca.SX:
        return (q * x[2]) ** 2 / (2 * e) - 0.1 * damping * x[1] - stiffness * gap * x[0]

    system = DaeSystem.from_functions(
        3,
        f=lambda x: [
            0.1 * x[1] / gap,
            force(x) / mass / 0.1,
            -gap * x[2] * (1 - x[0]) / e / resistance,
        ],
        h=lambda x: [0, 0, 1 / resistance / q],
        l=lambda x: [q * gap * x[2] * (1 - x[0]) / e],
        nominal_state=[0.42, 0.0, 1.0],
    )
    stability = ZeroDynamics(
        find_structure(system, spread=[0.02, 0.01, 0.02]).system,
        structure=find_structure(system, spread=[0.02, 0.01, 0.02]),
    ).stability()
    assert stability.verdict is Verdict.UNSTABLE
    place, _, charge = stability.state
    voltage = q * gap * charge * (1 - place) / e
    softened = stiffness - e * voltage**2 / (gap * (1 - place)) ** 3
    expected = np.roots([mass, damping, softened])
    # The place is known to 1e-9 of the gap.
    np.testing.assert_allclose(np.sort(stability.eigenvalues.real), np.sort(expected), rtol=1e-8)


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
