"""Floquet multipliers along periodic references, against other integrators and closed forms."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from drake_dae.dae import DaeSystem, StabilityAlong, Verdict, ZeroDynamics

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
        f=lambda s: [s[3], s[4], s[5], 0, -damping * s[4], -damping * (s[5] - s[3]) - gravity],
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


def test_multipliers_on_the_unit_circle_do_not_decide():
    """s'' = -s + z at rate 2: an oscillator without damping, multipliers exp(+- i pi)."""
    found = along(oscillator(lambda s, w, z: -2.0 * s + z), sinusoid(2.0), np.pi)
    np.testing.assert_allclose(np.abs(found.multipliers), 1.0, rtol=1e-7)
    assert found.verdict is Verdict.UNDECIDED
