"""Newton's method against roots that are known, and shortest steps against least squares."""

import numpy as np
import pytest

from drake_dae.trace.numerics import newton, shortest_steps

Array = np.ndarray


def solve(residual, gradients, start) -> tuple[Array, bool]:
    return newton(np.array(start, float), lambda x: shortest_steps(gradients(x), residual))


def test_a_root_is_found_to_round_off():
    """Kepler's equation, solved by a fixed-point iteration that contracts by 1/5."""
    expected = 1.0
    for _ in range(40):
        expected = 1.0 + 0.2 * np.sin(expected)
    found, converged = solve(
        lambda x: x - 0.2 * np.sin(x) - 1.0, lambda x: np.array([1 - 0.2 * np.cos(x)]), [0.0]
    )
    assert converged
    # A rounding of each.
    np.testing.assert_allclose(found, expected, rtol=4e-16)


def test_convergence_is_quadratic():
    """From 10% off a circle: errors 1e-1, 1e-2, 1e-4, 1e-8, 1e-16, so that four steps do."""
    iterates = []

    def gradients(x: Array) -> Array:
        iterates.append(x)
        return 2 * x[None]

    found, converged = solve(lambda x: np.array([x @ x - 4]), gradients, [2.2, 0.3])
    assert converged
    np.testing.assert_allclose(np.hypot(*found), 2.0, rtol=4e-16)
    assert len(iterates) <= 4


@pytest.mark.parametrize("scales", [(1.0, 1.0), (1e-9, 1e7)])
def test_the_equations_may_be_in_any_units(scales):
    """x^2 + y^2 = 1 and y = x^3 from (1, 1), against the root of x^2 + x^6 = 1."""

    def residual(x: Array) -> Array:
        return np.array([x @ x - 1, x[1] - x[0] ** 3]) * scales

    def gradients(x: Array) -> Array:
        return np.array([2 * x, [-3 * x[0] ** 2, 1]]) * np.array(scales)[:, None]

    found, converged = solve(residual, gradients, [1.0, 1.0])
    roots = np.roots([1, 0, 0, 0, 1, 0, -1])
    x = roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real[0]
    assert converged
    # The eigenvalues of the companion matrix are good to some roundings.
    np.testing.assert_allclose(found, [x, x**3], rtol=1e-13)


def test_a_missing_root_is_reported():
    """x^2 + 1; and a double root, which is found, but is not regular."""
    _, converged = solve(lambda x: x**2 + 1, lambda x: np.array([2 * x]), [0.7])
    assert not converged

    def double(x: Array) -> Array:
        return np.array([x[0] ** 2 + x[1], x[1]])

    found, converged = solve(double, lambda x: np.array([[2 * x[0], 1], [0, 1]]), [0.5, 0.2])
    assert not converged
    # Gradients whose angle is below 1e-9 count as dependent.
    np.testing.assert_allclose(found, 0.0, atol=1e-8)


def test_steps_are_the_shortest():
    random = np.random.default_rng(0)
    gradients, residual, x = (
        random.normal(size=(3, 6)),
        random.normal(size=3),
        random.normal(size=6),
    )
    step, regular, _ = shortest_steps(gradients, lambda at: residual)
    assert regular
    expected = -np.linalg.pinv(gradients) @ residual
    # Numbers of order 1, well conditioned.
    np.testing.assert_allclose(step(x), expected, atol=1e-14)
    step, regular, _ = shortest_steps(np.zeros((0, 6)), lambda at: np.zeros(0))
    np.testing.assert_array_equal(step(x), np.zeros(6))
    assert regular
