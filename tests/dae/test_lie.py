import casadi as ca
import numpy as np

from drake_dae.dae.derivatives import lie_derivative

N = 4
X = ca.SX.sym("x", N)

# Functions of order one evaluated near zero: a few roundings of numbers of order 10.


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
