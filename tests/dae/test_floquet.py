"""Floquet multipliers along periodic references, against other integrators and closed forms."""

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from runs import some
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from drake_dae import analyze
from drake_dae.analysis.report import Finding
from drake_dae.dae import DaeSystem, StabilityAlong, Verdict, ZeroDynamics
from drake_dae.errors import ModelError
from drake_dae.references import (
    CircleReference,
    ConstantReference,
    ExpressionReference,
    SinusoidReference,
)
from drake_dae.references.reference import common_period

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


def sinusoid(rate: float, size: float = 1.0) -> Callable[[float], Array]:
    """R = (r, r') of r = size cos(rate t)."""
    return lambda t: size * np.array([np.cos(rate * t), -rate * np.sin(rate * t)])


def along(
    system: DaeSystem, reference: Callable, period: float, periods: float = 12, count: int = 61
) -> StabilityAlong:
    dynamics = ZeroDynamics(system)
    motion = dynamics.motion(reference, np.linspace(0.0, periods * period, count))
    return dynamics.stability_along(reference, motion, period)


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


@pytest.mark.slow
def test_growth_by_a_parameter_that_oscillates():
    """s'' = -(1 + 0.9 cos 2t) s - 0.02 s': each frozen system is stable, and it grows.

    By Liouville the multipliers have the product exp(-0.02 pi).
    """
    found = along(oscillator(mathieu), sinusoid(2.0), np.pi)
    matrix = monodromy(lambda t: np.array([[0.0, 1.0], [-(1 + 0.9 * np.cos(2 * t)), -0.02]]), np.pi)
    # The error of integration, 1e-9 a step, in some fifty steps a period.
    expected = by_size(np.linalg.eigvals(matrix))
    np.testing.assert_allclose(found.multipliers, expected, rtol=1e-7)
    product = np.prod(found.multipliers)
    np.testing.assert_allclose(product, np.exp(-0.02 * np.pi), rtol=1e-7)
    assert found.verdict is Verdict.UNSTABLE
    # At rest nothing is wrong.
    assert ZeroDynamics(oscillator(mathieu)).stability().verdict is Verdict.STABLE


@pytest.mark.slow
@pytest.mark.parametrize("damping", some([0.5, 0.02]))
def test_multipliers_of_a_stable_motion(damping):
    """s'' = -(1 + 0.1 sin 3t) s - d s' + 0.2 sin 3t: multipliers of size exp(-d P / 2)."""
    system = oscillator(lambda s, w, z: -(1 + 0.1 * z) * s - damping * w + 0.2 * z)

    def reference(t):
        return np.array([np.sin(3 * t), 3 * np.cos(3 * t)])

    period = 2 * np.pi / 3
    found = along(system, reference, period)

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
    found = along(system, sinusoid(rate, size), period, count=200)

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
    found = along(system, reference, period)

    def slopes(t):
        stiffness = (gravity - size * rate**2 * np.cos(rate * t)) / length
        return np.array([[0.0, 1.0], [-stiffness, -damping]])

    expected = by_size(np.linalg.eigvals(monodromy(slopes, period)))
    np.testing.assert_allclose(by_size(found.multipliers), expected, rtol=1e-6)
    # It is pushed at twice its own rate, 4.4 1/s.
    assert found.verdict is Verdict.UNSTABLE


def test_a_multiplier_of_a_thousand_is_unstable():
    """s' = a(t) s with the mean 4.5: the multiplier is exp(4.5 P) = 1195 over P = 1.574 s."""
    period = np.log(1195.0) / 4.5
    rate = 2 * np.pi / period
    system = DaeSystem.from_functions(
        ["z", "s"],
        f=lambda x: [0, (4.5 + 3.0 * x[0]) * x[1]],
        h=lambda x: [1, 0],
        l=lambda x: x[0],
        nominal_state=[0.0, 0.01],
    )
    found = along(system, sinusoid(rate), period, periods=1.5)
    np.testing.assert_allclose(found.multipliers, [1195.0], rtol=1e-6)
    assert found.verdict is Verdict.UNSTABLE
    # The motion itself ends on the way, since it has grown by 1e8.
    ended = along(system, sinusoid(rate), period, periods=6)
    np.testing.assert_allclose(ended.multipliers, [1195.0], rtol=1e-6)
    told = analyze(system, reference=sinusoid(rate), times=np.linspace(0, period, 9), period=period)
    assert told.zero_dynamics_along.verdict is Verdict.UNSTABLE
    assert any("1195" in problem for problem in told.problems)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "size"), [(3.3, 0.3), (2.0, 0.0)])
def test_a_limit_cycle_without_the_period_of_the_reference_is_not_called_stable(rate, size):
    """The oscillator of FitzHugh and Nagumo, weakly driven; near it only its focus repeats.

    The multipliers at the focus, without a drive, are exp(P l) with its eigenvalues l.
    """
    system = oscillator(
        lambda s, w, z: 3.0 * (1 - s**2) * w - s + 0.9 + z,
        start=(2.0, 0.0),
    )
    found = along(system, sinusoid(rate, size), 2 * np.pi / rate, count=241)
    assert found.verdict is not Verdict.STABLE
    if found.multipliers.size and not size:
        slopes = np.array([[0.0, 1.0], [-1.0, 3.0 * (1 - 0.9**2)]])
        expected = np.exp(2 * np.pi / rate * np.linalg.eigvals(slopes))
        np.testing.assert_allclose(by_size(found.multipliers), by_size(expected), rtol=1e-5)


def test_multipliers_on_the_unit_circle_do_not_decide():
    """s'' = -s + z at rate 2: an oscillator without damping, multipliers exp(+- i pi)."""
    found = along(oscillator(lambda s, w, z: -2.0 * s + z), sinusoid(2.0), np.pi)
    np.testing.assert_allclose(np.abs(found.multipliers), 1.0, rtol=1e-7)
    assert found.verdict is Verdict.UNDECIDED


@pytest.mark.parametrize(
    ("references", "period"),
    [
        ([ConstantReference([1.0, 2.0])], 0.0),
        ([SinusoidReference(0.0, 1.0, 2.0), ConstantReference(1.0)], np.pi),
        ([CircleReference([0, 0], 1.0, period=-6.0), SinusoidReference(0.0, 1.0, np.pi)], 6.0),
        ([SinusoidReference(0.0, [1.0, 0.5], [2.0, 3.0])], 2.0 * np.pi),
        ([SinusoidReference(0.0, [1.0, 0.5], [2.0, np.sqrt(3.0)])], None),
        ([SinusoidReference(0.0, 1.0, 2.0), ExpressionReference(lambda t: [ca.sin(2 * t)])], None),
    ],
)
def test_the_period_of_references_together(references, period):
    found = common_period([reference.repeats for reference in references])
    assert found == (None if period is None else pytest.approx(period, rel=1e-12))


def test_arguments_that_do_not_fit_are_refused():
    dynamics = ZeroDynamics(oscillator(mathieu))
    motion = dynamics.motion(sinusoid(2.0), [0.0, 1.0])
    with pytest.raises(ModelError, match=r"reference\(0\)"):
        dynamics.stability_along(lambda t: np.zeros(3), motion, 1.0)
    other = DaeSystem.from_functions(2, f=lambda x: [0, x[1]], h=lambda x: [1, 0], l=lambda x: x[0])
    with pytest.raises(ModelError, match=r"\(2, 3\)"):
        ZeroDynamics(other).stability_along(sinusoid(2.0), motion, 1.0)
    for period in (3.0, 0.0, -1.0, np.nan):
        with pytest.raises(ModelError, match=f"{period:g}"):
            dynamics.stability_along(sinusoid(2.0), motion, period)


@pytest.mark.slow
def test_analyze_reports_growth_along_a_reference():
    told = analyze(
        oscillator(mathieu),
        reference=sinusoid(2.0),
        times=np.linspace(0.0, 60.0, 61),
        period=np.pi,
    )
    assert told.zero_dynamics.verdict is Verdict.STABLE
    assert told.zero_dynamics_along.verdict is Verdict.UNSTABLE
    assert told.zero_dynamics_finding is Finding.VIOLATED
    assert len(told.problems) == 1
    data = told.to_dict()["zero_dynamics_along"]
    np.testing.assert_allclose(data["multipliers"], [[-1.93398, 0], [-0.48558, 0]], atol=1e-5)
    assert data["verdict"] == "unstable"
