"""Zero dynamics along references, and motions that do not rest, against other integrators."""

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from problems import in_other_units
from runs import some
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from drake_dae import analyze
from drake_dae.analysis.findings import Finding
from drake_dae.dae.references import ExpressionReference
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.zero_dynamics.along import StabilityAlong
from drake_dae.dae.zero_dynamics.stability import Verdict
from drake_dae.dae.zero_dynamics.zero_dynamics import ZeroDynamics
from drake_dae.errors import ModelError

Array = np.ndarray


def oscillator(
    acceleration: Callable, start: tuple[float, float] = (0.01, 0.0), name: str = "oscillator"
) -> DaeSystem:
    """z' = u, and internal states with s'' = acceleration(s, s', z)."""
    return DaeSystem.from_functions(
        ["z", "s", "w"],
        f=lambda x: [0, x[2], acceleration(x[1], x[2], x[0])],
        h=lambda x: [1, 0, 0],
        l=lambda x: x[0],
        nominal_state=[0.0, *start],
        output_signals=["z"],
        name=name,
    )


def mathieu(s, w, z):
    return -(1 + 0.9 * z) * s - 0.02 * w


def van_der_pol(s, w, z):
    return (1 - s**2) * w - s


def sinusoid(rate: float, size: float = 1.0) -> Callable[[float], Array]:
    """R = (r, r') of r = size cos(rate t)."""
    return lambda t: size * np.array([np.cos(rate * t), -rate * np.sin(rate * t)])


def two_tones(t: float) -> Array:
    """cos 2t + 0.1 cos(3^(1/2) t) and its derivative: no period."""
    other = np.sqrt(3.0)
    return sinusoid(2.0)(t) + sinusoid(other, 0.1)(t)


def along(system: DaeSystem, reference: Callable, end: float, count: int = 61) -> StabilityAlong:
    dynamics = ZeroDynamics(system)
    motion = dynamics.motion(reference, np.linspace(0.0, end, count))
    return dynamics.stability_along(reference, motion)


def monodromy(slopes: Callable[[float], Array], period: float, begin: float = 0.0) -> Array:
    """The matrix of delta' = slopes(t) delta over a period, by Dormand and Prince of order 8."""
    size = len(slopes(0.0))

    def rate(t: float, columns: Array) -> Array:
        return (slopes(t) @ columns.reshape(size, size)).reshape(-1)

    found = solve_ivp(
        rate,
        (begin, begin + period),
        np.eye(size).reshape(-1),
        method="DOP853",
        rtol=1e-12,
        atol=1e-13,
    )
    return found.y[:, -1].reshape(size, size)


def by_size(values: Array) -> Array:
    return np.array(sorted(values + 0j, key=lambda v: (-round(abs(v), 6), round(v.imag, 6))))


# Along a reference with a period.


@pytest.mark.slow
def test_growth_by_a_parameter_that_oscillates():
    """s'' = -(1 + 0.9 cos 2t) s - 0.02 s': each frozen system is stable, and it grows.

    By Liouville the multipliers have the product exp(-0.02 pi).
    """
    found = along(oscillator(mathieu), sinusoid(2.0), 60.0)
    matrix = monodromy(lambda t: np.array([[0.0, 1.0], [-(1 + 0.9 * np.cos(2 * t)), -0.02]]), np.pi)
    # The error of integration, 1e-9 a step, in some fifty steps a period.
    expected = by_size(np.linalg.eigvals(matrix))
    np.testing.assert_allclose(found.multipliers, expected, rtol=1e-7)
    assert abs(found.period - np.pi) < 1e-9
    product = np.prod(found.multipliers)
    np.testing.assert_allclose(product, np.exp(-0.02 * np.pi), rtol=1e-7)
    np.testing.assert_allclose(found.exponents, np.log(np.abs(expected)) / np.pi, rtol=0, atol=1e-7)
    assert found.verdict is Verdict.UNSTABLE
    assert "the largest Floquet multiplier is 1.934 over 3.14159 s" in found.reason
    # At rest nothing is wrong.
    assert ZeroDynamics(oscillator(mathieu)).stability().verdict is Verdict.STABLE


@pytest.mark.thorough
def test_growth_by_an_exogenous_signal():
    """The same oscillator, pumped by a known signal while its output stands still."""
    system = DaeSystem.from_functions(
        ["z", "s", "w"],
        f=lambda x, p: [0, x[2], mathieu(x[1], x[2], p.pump)],
        h=lambda x, p: [1, 0, 0],
        l=lambda x, p: x[0],
        parameters={"pump": 1.0},
        exogenous=["pump"],
        nominal_state=[0.0, 0.01, 0.0],
        name="pumped",
    )
    pump, still = ExpressionReference(lambda t: ca.cos(2 * t)), lambda t: np.zeros(2)
    times = np.linspace(0.0, 60.0, 61)
    dynamics = ZeroDynamics(system)
    motion = dynamics.motion(still, times, exogenous=[pump])
    found = dynamics.stability_along(still, motion, exogenous=[pump])
    matrix = monodromy(lambda t: np.array([[0.0, 1.0], [-(1 + 0.9 * np.cos(2 * t)), -0.02]]), np.pi)
    np.testing.assert_allclose(found.multipliers, by_size(np.linalg.eigvals(matrix)), rtol=1e-7)
    assert abs(found.period - np.pi) < 1e-9
    # Nobody pumps: it is at rest, with the pump where its parameter is.
    alone = dynamics.stability_along(still, dynamics.motion(still, times))
    assert alone.verdict is Verdict.STABLE
    report = analyze(system, reference=still, times=times, exogenous=[pump])
    assert any("Floquet multiplier is 1.934" in problem for problem in report.problems)


@pytest.mark.slow
@pytest.mark.parametrize("damping", some([0.5, 0.02]))
def test_multipliers_of_a_stable_motion(damping):
    """s'' = -(1 + 0.1 sin 3t) s - d s' + 0.2 sin 3t: multipliers of size exp(-d P / 2)."""
    system = oscillator(lambda s, w, z: -(1 + 0.1 * z) * s - damping * w + 0.2 * z)

    def reference(t):
        return np.array([np.sin(3 * t), 3 * np.cos(3 * t)])

    found, period = along(system, reference, 40.0), 2 * np.pi / 3

    def slopes(t):
        return np.array([[0.0, 1.0], [-(1 + 0.1 * np.sin(3 * t)), -damping]])

    expected = by_size(np.linalg.eigvals(monodromy(slopes, period)))
    np.testing.assert_allclose(by_size(found.multipliers), expected, rtol=1e-7)
    np.testing.assert_allclose(np.abs(found.multipliers), np.exp(-damping * period / 2), rtol=1e-7)
    assert found.verdict is Verdict.STABLE


@pytest.mark.slow
def test_multipliers_of_a_motion_that_must_be_found():
    """A damped spring that hardens, driven: s'' = -s - s^3 - 0.4 s' + 0.5 cos 1.2t.

    The periodic motion is found by another shooting, and its monodromy matrix by its slopes.
    """
    system = oscillator(lambda s, w, z: -s - s**3 - 0.4 * w + z)
    rate, size = 1.2, 0.5
    period = 2 * np.pi / rate
    found = along(system, sinusoid(rate, size), 12 * period, 200)

    def orbit(start):
        def moved(t, x):
            return [x[1], -x[0] - x[0] ** 3 - 0.4 * x[1] + size * np.cos(rate * t)]

        return solve_ivp(
            moved, (0, period), start, method="DOP853", rtol=1e-12, atol=1e-13, dense_output=True
        )

    settled = np.array([0.3, 0.0])
    for _ in range(30):
        settled = orbit(settled).y[:, -1]
    start = fsolve(lambda x: orbit(x).y[:, -1] - x, settled, xtol=1e-13)
    closed = orbit(start).sol

    def slopes(t):
        return np.array([[0.0, 1.0], [-1 - 3 * closed(t)[0] ** 2, -0.4]])

    expected = by_size(np.linalg.eigvals(monodromy(slopes, period)))
    # The motion closes to 1e-7.
    np.testing.assert_allclose(by_size(found.multipliers), expected, rtol=1e-6)
    assert found.verdict is Verdict.STABLE
    assert found.state.shape == (3,)


@pytest.mark.slow
def test_multipliers_with_a_constraint():
    """A swing on a rod whose pivot is pushed up and down, hanging, with its mass on a circle.

    With the pivot at height r(t) and the angle a from below: L a'' = -(g + r'') sin a - d L a'.
    """
    length, gravity, damping, rate, size = 0.5, 9.81, 0.05, 8.9, 0.04

    system = DaeSystem.from_functions(
        ["h", "x", "y", "h'", "x'", "y'"],
        f=lambda s: [
            s[3],
            s[4],
            s[5],
            0,
            -damping * s[4],
            -damping * (s[5] - s[3]) - gravity,
        ],
        g=lambda s: [0, 0, 0, -(s[2] - s[0]), s[1], s[2] - s[0]],
        h=lambda s: [0, 0, 0, 1, 0, 0],
        k=lambda s: (s[1] ** 2 + (s[2] - s[0]) ** 2 - length**2) / 2,
        l=lambda s: s[0],
        m=lambda s: 0,
        nominal_state=[0.0, 0.01, -np.sqrt(length**2 - 1e-4), 0.0, 0.0, 0.0],
        name="swing",
    )

    def reference(t):
        c, s = np.cos(rate * t), np.sin(rate * t)
        return size * np.array([c, -rate * s, -(rate**2) * c])

    period = 2 * np.pi / rate
    found = along(system, reference, 10 * period)

    def slopes(t):
        stiffness = (gravity - size * rate**2 * np.cos(rate * t)) / length
        return np.array([[0.0, 1.0], [-stiffness, -damping]])

    expected = by_size(np.linalg.eigvals(monodromy(slopes, period)))
    np.testing.assert_allclose(by_size(found.multipliers), expected, rtol=1e-6)
    # It is pushed at twice its own rate, 4.4 1/s.
    assert found.verdict is Verdict.UNSTABLE


@pytest.mark.thorough
def test_multipliers_do_not_depend_on_units():
    system = oscillator(lambda s, w, z: -(1 + 0.9 * z) * s - 0.02 * w - s**3)
    first = along(system, sinusoid(2.0, 0.1), 40.0)
    unit = np.array([1e-3, 1e4, 1e-2])
    second = along(
        in_other_units(system, unit, np.ones(0), np.ones(1), np.ones(0), np.array([1e-3])),
        lambda t: sinusoid(2.0, 0.1)(t) * 1e3,
        40.0,
    )
    np.testing.assert_allclose(first.multipliers, second.multipliers, rtol=1e-6)
    assert first.verdict is second.verdict


# Along a reference without one.


@pytest.mark.slow
def test_exponents_without_a_period():
    """The largest singular value of the transition matrix from 30 to 60 s."""
    alike = replace(oscillator(mathieu), state_scale=np.ones(3))
    found = along(alike, two_tones, 60.0)
    matrix = monodromy(
        lambda t: np.array([[0.0, 1.0], [-(1 + 0.9 * two_tones(t)[0]), -0.02]]), 30.0, 30.0
    )
    sizes = np.log(np.linalg.svd(matrix, compute_uv=False)) / 30.0
    # The sizes of both states differ by the random part of their samples alone.
    np.testing.assert_allclose(found.exponents, sizes, rtol=0, atol=0.02)
    np.testing.assert_allclose(np.sum(found.exponents), -0.02, rtol=0, atol=1e-6)
    assert (found.verdict, found.period) == (Verdict.UNSTABLE, None)
    stable = along(oscillator(lambda s, w, z: -(1 + 0.1 * z) * s - 0.5 * w), two_tones, 60.0)
    assert stable.verdict is Verdict.STABLE
    short = along(oscillator(lambda s, w, z: -(1 + 0.1 * z) * s - 0.5 * w), two_tones, 2.0)
    assert short.verdict is Verdict.UNDECIDED
    assert "too short" in short.reason


@pytest.mark.slow
def test_neighbours_that_lag_are_not_unstable():
    """A pendulum that swings freely: those that swing less are faster, and their distance grows."""
    system = oscillator(lambda s, w, z: -ca.sin(s) + 0 * z, start=(2.0, 0.0))
    assert along(system, two_tones, 120.0).verdict is Verdict.UNDECIDED


@pytest.mark.thorough
def test_a_limit_cycle_beside_a_reference_that_never_returns_is_undecided():
    """Van der Pol driven weakly and off its own rate; the periodic motion is unstable."""
    system = oscillator(lambda s, w, z: van_der_pol(s, w, z) + z)
    found = along(system, sinusoid(3.3, 0.3), 60.0)
    assert found.verdict is Verdict.UNDECIDED
    assert np.abs(found.multipliers[0]) > 2.0
    assert "did not return" in found.reason
    without_period = along(
        oscillator(lambda s, w, z: van_der_pol(s, w, z) + 0.01 * z), two_tones, 120.0
    )
    assert without_period.verdict is Verdict.UNDECIDED
    assert "did not return" in without_period.reason


def test_a_motion_that_ends_is_reported():
    system = oscillator(lambda s, w, z: 10 * s + 0 * z)
    grown = along(system, sinusoid(2.0), 60.0)
    assert (grown.verdict, grown.multipliers.size) == (Verdict.UNSTABLE, 0)
    assert "grow without bound" in grown.reason

    def jumping(t):
        return np.array([np.cos(t) if t < 3.0 else np.nan, 0.0])

    ended = along(system, jumping, 5.0)
    assert ended.verdict is Verdict.UNDECIDED
    one = ZeroDynamics(system)
    at_once = one.stability_along(sinusoid(2.0), one.motion(sinusoid(2.0), [0.0]))
    assert at_once.verdict is Verdict.UNDECIDED


def test_arguments_that_do_not_fit_are_refused():
    dynamics = ZeroDynamics(oscillator(mathieu))
    motion = dynamics.motion(sinusoid(2.0), [0.0, 1.0])
    with pytest.raises(ModelError, match=r"reference\(0\)"):
        dynamics.stability_along(lambda t: np.zeros(3), motion)
    other = DaeSystem.from_functions(2, f=lambda x: [0, x[1]], h=lambda x: [1, 0], l=lambda x: x[0])
    with pytest.raises(ModelError, match="another system"):
        ZeroDynamics(other).stability_along(sinusoid(2.0), motion)


@pytest.mark.slow
def test_a_constant_reference_is_judged_at_rest():
    found = along(oscillator(van_der_pol), lambda t: np.zeros(2), 10.0)
    assert (found.verdict, found.period) == (Verdict.BOUNDED, 0.0)
    np.testing.assert_allclose(found.exponents, [0.5, 0.5], rtol=1e-9)


def test_without_zero_dynamics():
    system = DaeSystem.from_functions(
        2, f=lambda x: [x[1], 0], h=lambda x: [0, 1], l=lambda x: x[0]
    )
    dynamics = ZeroDynamics(system)

    def reference(t):
        return np.array([np.sin(t), np.cos(t), -np.sin(t)])

    found = dynamics.stability_along(reference, dynamics.motion(reference, [0.0, 1.0]))
    assert found.verdict is Verdict.STABLE
    assert dynamics.equilibria(outputs=[0.3]).shape == (1, 2)


# Away from equilibria, and between them.


@pytest.mark.slow
@pytest.mark.parametrize("strength", some([0.3, 1.0, 5.0]))
def test_a_limit_cycle_is_bounded(strength):
    """Van der Pol: s = 0 has the eigenvalues of l^2 - e l + 1, and the cycle is about 2 wide."""
    system = oscillator(lambda s, w, z: strength * (1 - s**2) * w - s)
    found = ZeroDynamics(system).stability()
    assert found.verdict is Verdict.BOUNDED
    np.testing.assert_allclose(
        by_size(found.eigenvalues), by_size(np.roots([1.0, -strength, 1.0])), rtol=1e-9
    )
    assert "limit cycle" in found.reason


def test_growth_is_not_bounded():
    """The van der Pol oscillator backward in time leaves its cycle for infinity; s'' = s' - s."""
    assert ZeroDynamics(oscillator(lambda s, w, z: w - s)).stability().verdict is Verdict.UNSTABLE
    outside = oscillator(lambda s, w, z: -(1 - s**2) * w - s, start=(3.0, 0.0))
    dynamics = ZeroDynamics(outside)
    assert dynamics.stability().verdict is Verdict.STABLE  # At rest, which is found from there.
    # s'' = s' - s + s^5 circles nowhere.
    blown = oscillator(lambda s, w, z: w - s + s**5)
    assert ZeroDynamics(blown).stability().verdict is Verdict.UNSTABLE


@pytest.mark.slow
def test_where_nothing_rests_the_motion_is_examined():
    """A rotor that a torque turns on, s'' = 1 + 0.5 cos s - s': its angle grows, like time alone.

    A spring that pushes with 1 + s^2 has no rest either; s is infinite at a finite time.
    """
    turning = ZeroDynamics(oscillator(lambda s, w, z: 1.0 - w + 0.5 * ca.cos(s)))
    assert turning.stability().verdict is Verdict.UNDECIDED
    runaway = ZeroDynamics(oscillator(lambda s, w, z: 1.0 + s**2 - 0.1 * w, start=(1.0, 0.0)))
    found = runaway.stability()
    assert found.verdict is Verdict.UNSTABLE
    assert "grows without bound" in found.reason


@pytest.mark.slow
def test_several_equilibria():
    """s'' = s - s^3 - s': at rest at 0, with l^2 + l - 1, and at +-1, with l^2 + l + 2."""
    system = oscillator(lambda s, w, z: s - s**3 - w)
    dynamics = ZeroDynamics(system)
    guesses = np.array([[0, s, 0] for s in (0.1, 0.9, -1.2, 1.1, 0.05)], dtype=float)
    found = dynamics.equilibria(guesses)
    np.testing.assert_allclose(np.sort(found[:, 1]), [-1.0, 0.0, 1.0], rtol=0, atol=1e-9)
    told = analyze(system, region={"s": (-2.0, 2.0)})
    assert [one.verdict for one in told.equilibria] == [
        Verdict.UNSTABLE,
        Verdict.STABLE,
        Verdict.STABLE,
    ]
    np.testing.assert_allclose(
        sorted(one.state[1] for one in told.equilibria), [-1.0, 0.0, 1.0], rtol=0, atol=1e-9
    )
    assert "At rest at z=0, s=1, s" not in str(told)
    assert "At rest at z=0, s=1, w=0: exponentially stable." in str(told)
    assert "converges to another stable motion" in told.problems[0]
    with pytest.raises(ModelError, match="guesses"):
        dynamics.equilibria([0.0, 0.0, 0.0])


def test_a_continuum_of_equilibria_is_one():
    """s' = 0 wherever it is."""
    system = DaeSystem.from_functions(
        2, f=lambda x: [0, 0], h=lambda x: [1, 0], l=lambda x: x[0], nominal_state=[0.0, 0.3]
    )
    assert len(ZeroDynamics(system).equilibria()) == 1


# What analyze tells.


@pytest.mark.slow
def test_analyze_reports_growth_along_a_reference():
    told = analyze(oscillator(mathieu), reference=sinusoid(2.0), times=np.linspace(0.0, 60.0, 61))
    assert told.zero_dynamics.verdict is Verdict.STABLE
    assert told.zero_dynamics_along.verdict is Verdict.UNSTABLE
    assert told.decisive is told.zero_dynamics_along
    assert len(told.problems) == 1
    assert told.problems[0].startswith("Assumption 2.2: along the reference small disturbances")
    assert "Floquet multipliers -1.934, -0.4856." in str(told)
    data = told.to_dict()["zero_dynamics_along"]
    np.testing.assert_allclose(data["multipliers"], [[-1.93398, 0], [-0.48558, 0]], atol=1e-5)
    assert data["verdict"] == "unstable"


@pytest.mark.slow
def test_a_limit_cycle_is_no_problem():
    told = analyze(oscillator(van_der_pol))
    assert told.problems == ()
    assert "Zero dynamics bounded, not asymptotically stable" in str(told)
    (row,) = (line for line in str(told).splitlines() if line.startswith("2.2 "))
    assert str(Finding.SATISFIED) in row


# Linearization.


@pytest.mark.slow
@pytest.mark.parametrize("small", [-1e-3, 1e-3])
def test_eigenvalues_eleven_orders_apart_are_decided(small):
    """Triangular: s1' = -1e8 s1 + 3e4 s2, s2' = small s2."""
    system = DaeSystem.from_functions(
        3,
        f=lambda x: [0, -1e8 * x[1] + 3e4 * x[2], small * x[2]],
        h=lambda x: [1, 2, 3],
        l=lambda x: x[0],
    )
    found = ZeroDynamics(system).stability()
    values = sorted(found.eigenvalues.real)
    np.testing.assert_allclose(values, [-1e8, small], rtol=1e-9)
    assert found.verdict is (Verdict.STABLE if small < 0 else Verdict.UNSTABLE)
