import casadi as ca
import numpy as np
import pytest

from drake_dae.trace.lie import lie_derivative, lie_derivative_along

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


def test_linear_in_the_function_and_in_the_field():
    for (k, el), (f, g, _), state, (a, b) in cases():
        equal(
            lie_derivative(a * k + b * el, f, X),
            a * lie_derivative(k, f, X) + b * lie_derivative(el, f, X),
            state,
        )
        # Over functions, not only over numbers.
        equal(
            lie_derivative(k, el * f + b * g, X),
            el * lie_derivative(k, f, X) + b * lie_derivative(k, g, X),
            state,
        )


def test_leibniz_rule():
    for (k, el), (f, g, _), state, _ in cases():
        equal(
            lie_derivative(k * el, f, X),
            el * lie_derivative(k, f, X) + k * lie_derivative(el, f, X),
            state,
        )
        equal(
            lie_bracket(f, k * g, X),
            k * lie_bracket(f, g, X) + lie_derivative(k, f, X) * g,
            state,
        )


def test_bracket_is_bilinear_over_numbers():
    for _, (f, g, h), state, (a, b) in cases():
        equal(
            lie_bracket(a * f + b * g, h, X),
            a * lie_bracket(f, h, X) + b * lie_bracket(g, h, X),
            state,
        )


def test_chain_rule():
    for (k, el), (f, _, _), state, _ in cases():
        equal(
            lie_derivative(ca.sin(k) * ca.exp(el / 10), f, X),
            ca.cos(k) * ca.exp(el / 10) * lie_derivative(k, f, X)
            + ca.sin(k) * ca.exp(el / 10) * lie_derivative(el, f, X) / 10,
            state,
        )


def test_coordinates_do_not_matter():
    """x = T(w): derivatives of k(T(w)) along T*f are those of k along f, brackets move along."""
    # Triangular, so that the Jacobian has determinant 1 and a polynomial inverse.
    bent = ca.vertcat(X[0], X[1] + X[0] ** 2, X[2] - X[0] * X[1], X[3] + X[2] ** 2)
    jacobian = ca.jacobian(bent, X)

    def moved(expression: ca.SX) -> ca.SX:
        return ca.substitute(expression, X, bent)

    def field_in_w(field: ca.SX) -> ca.SX:
        return ca.solve(jacobian, moved(field))

    for (k, _), (f, g, _), state, _ in cases():
        equal(
            lie_derivative(moved(k), field_in_w(f), X),
            moved(lie_derivative(k, f, X)),
            state,
            # The inverse of the Jacobian, of condition 10, twice.
            1e-10,
        )
        equal(
            lie_bracket(field_in_w(f), field_in_w(g), X),
            field_in_w(lie_bracket(f, g, X)),
            state,
            1e-10,
        )


def test_bracket_is_antisymmetric():
    for _, (f, g, _), state, _ in cases():
        equal(lie_bracket(f, g, X), -lie_bracket(g, f, X), state)
        equal(lie_bracket(f, f, X), ca.SX.zeros(N), state)


def test_jacobi_identity():
    for _, (f, g, h), state, _ in cases():
        total = (
            lie_bracket(f, lie_bracket(g, h, X), X)
            + lie_bracket(g, lie_bracket(h, f, X), X)
            + lie_bracket(h, lie_bracket(f, g, X), X)
        )
        # Three terms of order 1e3 cancel.
        equal(total, ca.SX.zeros(N), state, 1e-10)


def test_bracket_is_the_commutator_of_derivatives():
    for (k, _), (f, g, _), state, _ in cases():
        commutator = lie_derivative(lie_derivative(k, g, X), f, X) - lie_derivative(
            lie_derivative(k, f, X), g, X
        )
        equal(lie_derivative(k, lie_bracket(f, g, X), X), commutator, state, 1e-10)


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


def test_bracket_by_hand():
    # Isidori 1989, 1.2: f = (x1, 0), g = (0, x0) give [f, g] = (-x0, x1).
    field, other = ca.vertcat(X[1], 0, 0, 0), ca.vertcat(0, X[0], 0, 0)
    equal(lie_bracket(field, other, X), ca.vertcat(-X[0], X[1], 0, 0), np.array([2.0, 3.0, 0, 0]))


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


def test_structural_zeros_are_kept():
    # k depends on x0 and x1 alone, the first field moves x2, the second x1, the third nothing.
    fields = ca.SX(N, 3)
    fields[2, 0], fields[1, 1] = ca.sin(X[0]), X[3]
    result = lie_derivative_along(X[0] ** 2 + X[1], fields, X)
    assert [result[0, j].nnz() for j in range(3)] == [0, 1, 0]


@pytest.mark.parametrize(("functions", "fields"), [(0, 2), (2, 0), (0, 0)])
def test_empty_systems_have_empty_derivatives(functions, fields):
    k, g = ca.SX(functions, 1), ca.SX(N, fields)
    assert lie_derivative_along(k, g, X).shape == (functions, fields)
    assert lie_derivative(k, X, X).shape == (functions, 1)


def test_constants_have_no_derivative():
    equal(lie_derivative(ca.SX([3.0, 4.0]), X, X), ca.SX.zeros(2), np.ones(N))
    equal(lie_derivative(X, ca.SX(N, 1), X), ca.SX.zeros(N), np.ones(N))
