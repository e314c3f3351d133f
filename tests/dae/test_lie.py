import casadi as ca
import numpy as np

from drake_dae.dae.derivatives import lie_derivative, lie_derivative_along

N = 4
X = ca.SX.sym("x", N)

# Functions of order one evaluated near zero: a few roundings of numbers of order 10.
ROUND_OFF = 1e-12


def numbers(expression: ca.SX, state: np.ndarray) -> np.ndarray:
    return np.array(ca.Function("value", [X], [ca.densify(expression)])(state))


def lie_bracket(first: ca.SX, second: ca.SX, state: ca.SX) -> ca.SX:
    """[f, g] = (dg/dx) f - (df/dx) g."""
    return lie_derivative(second, first, state) - lie_derivative(first, second, state)


def random_functions(random: np.random.Generator, count: int) -> ca.SX:
    """Polynomials with some sines: smooth, and with all derivatives."""
    terms = ca.vertcat(1, X, X**2, X[0] * X[1], X[2] * X[3] * X[0], ca.sin(X[1] + 2 * X[2]))
    return ca.mtimes(random.normal(size=(count, terms.numel())), terms)


def cases():
    for seed in range(5):
        random = np.random.default_rng(seed)
        functions = [random_functions(random, 1) for _ in range(2)]
        fields = [random_functions(random, N) for _ in range(3)]
        yield functions, fields, random.uniform(-1.0, 1.0, N), random.normal(size=2)


def equal(left: ca.SX, right: ca.SX, state: np.ndarray, tolerance: float = ROUND_OFF) -> None:
    one, two = numbers(left, state), numbers(right, state)
    assert one.shape == two.shape
    np.testing.assert_allclose(one, two, rtol=tolerance, atol=tolerance)


def test_repeated_derivatives_by_hand():
    # A pendulum x0'' = -sin x0 with k = x0^2: k' = 2 x0 x1, k'' = 2 x1^2 - 2 x0 sin x0, ...
    field = ca.vertcat(X[1], -ca.sin(X[0]), 0, 0)
    a, b = X[0], X[1]
    by_hand = [
        a**2,
        2 * a * b,
        2 * b**2 - 2 * a * ca.sin(a),
        -6 * b * ca.sin(a) - 2 * a * b * ca.cos(a),
    ]
    found = X[0] ** 2
    for wanted in by_hand:
        equal(found, wanted, np.array([0.7, -1.3, 0.0, 0.0]))
        found = lie_derivative(found, field, X)


def test_against_finite_differences():
    step = 1e-5
    for (k, _), (f, g, _), state, _ in cases():
        direction = numbers(f, state)[:, 0]
        slope = (numbers(k, state + step * direction) - numbers(k, state - step * direction)) / (
            2 * step
        )
        # Central differences: step^2 times a third derivative of order 100, round-off 1e-16/step.
        np.testing.assert_allclose(
            numbers(lie_derivative(k, f, X), state), slope, rtol=1e-6, atol=1e-6
        )
        other = numbers(g, state)[:, 0]
        bracket = (
            numbers(g, state + step * direction)
            - numbers(g, state - step * direction)
            - numbers(f, state + step * other)
            + numbers(f, state - step * other)
        ) / (2 * step)
        np.testing.assert_allclose(
            numbers(lie_bracket(f, g, X), state), bracket, rtol=1e-6, atol=1e-6
        )


def test_along_several_fields_at_once():
    for (k, el), fields, state, _ in cases():
        found = lie_derivative_along(ca.vertcat(k, el), ca.horzcat(*fields), X)
        one_by_one = ca.vertcat(
            *[ca.horzcat(*[lie_derivative(e, field, X) for field in fields]) for e in (k, el)]
        )
        equal(found, one_by_one, state)
