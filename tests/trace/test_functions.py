"""Traced functions, factorizations and Newton steps against NumPy, fractions and known roots."""

from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from threading import Barrier
from time import sleep

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from drake_dae.errors import ModelError
from drake_dae.trace.expressions import find_flaw
from drake_dae.trace.factorization import Factorization, PositiveDefiniteFactorization
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.numerics import newton, shortest_steps


def traced(**outputs) -> TracedFunction:
    """A function of x, shape (3,), and p, shape (2,), with outputs made from them by name."""
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p", 2)
    made = {name: make(x, p) for name, make in outputs.items()}
    return TracedFunction("test", {"x": x, "p": p}, made)


X, P = np.array([1.0, 2.0, 3.0]), np.array([10.0, 20.0])


def test_evaluate_reuses_its_arrays_and_a_call_makes_new_ones():
    function = traced(y=lambda x, p: x * p[0], z=lambda x, p: ca.mtimes(x, p.T))
    first = function.evaluate(X, P)
    second = function.evaluate(2 * X, P)
    assert all(one is two for one, two in zip(first, second, strict=True))
    np.testing.assert_array_equal(first[0], 20 * X)
    kept = function(X, P)
    function(3 * X, P)
    np.testing.assert_array_equal(kept[0], 10 * X)
    np.testing.assert_array_equal(kept[1], np.outer(X, P))
    x = X.copy()
    function.evaluate(x, P)
    np.testing.assert_array_equal(x, X)


def test_wrong_arguments_are_refused_by_name():
    function = traced(y=lambda x, p: x + p[0])
    with pytest.raises(ModelError, match=r"x, p"):
        function(X)
    for x, p, name in ((X, X, "'p'"), (X[None], P, "'x'"), (1.0, P, "'x'")):
        with pytest.raises(ModelError, match=name):
            function(x, p)
    with pytest.raises(TypeError, match="'x', 'p'"):
        function.evaluate(X)


def test_finite_outputs_are_reported_from_others():
    function = traced(
        y=lambda x, p: ca.sqrt(x), z=lambda x, p: 1 / p, none=lambda x, p: ca.SX(0, 1)
    )
    function(X, P)
    assert function.is_finite
    for x, p in (([1, -1, 1], P), (X, [1, 0]), ([np.nan, 1, 1], P), (X, [np.inf, np.nan])):
        function(x, p)
        assert not function.is_finite
    # Infinities of both signs do not cancel to a number.
    function(X, [0.0, -0.0])
    assert not function.is_finite
    function(X, P)
    assert function.is_finite


def test_a_flaw_is_a_kink_in_the_variable_or_a_constant_that_is_not_finite():
    x, other = ca.SX.sym("x"), ca.SX.sym("other")
    assert "fabs" in find_flaw(x * ca.fabs(x + other), x, other)
    assert not find_flaw(x * ca.fabs(other), x, other)
    assert "inf" in find_flaw(x + other + ca.inf, x, other)


def solve(a: ca.SX, b: ca.SX) -> tuple[ca.SX, ca.SX]:
    factors = Factorization(a)
    return factors.solve(b), factors.pivot


def solved(size: int, columns: int) -> TracedFunction:
    a, b = ca.SX.sym("a", size, size), ca.SX.sym("b", size, columns)
    solution, pivot = solve(a, b)
    return TracedFunction(
        "solve", {"a": ca.vec(a), "b": ca.vec(b)}, {"x": ca.vec(solution), "pivot": pivot}
    )


def solved_numbers(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, float]:
    x, pivot = solved(a.shape[0], b.shape[1])(a.reshape(-1, order="F"), b.reshape(-1, order="F"))
    return x.reshape(b.shape, order="F"), float(pivot[0])


@pytest.mark.parametrize("size", [1, 2, 5])
def test_solve_against_numpy(size):
    random = np.random.default_rng(size)
    for _ in range(5):
        a, b = random.normal(size=(size, size)), random.normal(size=(size, 3))
        x, pivot = solved_numbers(a, b)
        # Condition numbers of such matrices reach 1e3.
        np.testing.assert_allclose(x, np.linalg.solve(a, b), rtol=1e-11, atol=1e-11)
        assert 0.0 < pivot <= 1.0 + 1e-15


@pytest.mark.parametrize("condition", [1e4, 1e8])
def test_the_error_of_solve_grows_with_the_condition_and_not_its_square(condition):
    random = np.random.default_rng(0)
    left, right = (np.linalg.qr(random.normal(size=(5, 5)))[0] for _ in range(2))
    a = left @ np.diag(np.geomspace(1.0, 1.0 / condition, 5)) @ right
    x = random.normal(size=(5, 1))
    # Ten times machine precision per step and condition; the square would be 1e-8 and 1.
    assert np.abs(solved_numbers(a, a @ x)[0] - x).max() < 1e-15 * 100 * condition


@pytest.mark.parametrize(
    "matrix",
    [
        [[0.0]],
        [[0.0, 1.0], [0.0, 2.0]],
        [[1.0, 2.0], [2.0, 4.0]],
        [[1.0, 1.0, 0.3], [1.0, 1.0, 0.5], [1.0, 1.0, 0.9]],
    ],
)
def test_the_pivot_of_a_singular_matrix_is_zero(matrix):
    a = np.array(matrix)
    assert solved_numbers(a, np.ones((len(a), 1)))[1] < 1e-15


@pytest.mark.parametrize("size", [1, 3, 6])
def test_the_pivot_of_a_positive_definite_matrix_is_an_angle(size):
    """A = G^T G holds the products of the columns of G, whose angles its QR factors show."""
    matrix = ca.SX.sym("a", size, size)
    factors = PositiveDefiniteFactorization(matrix)
    b = ca.SX.sym("b", size)
    function = TracedFunction(
        "pivot",
        {"a": ca.vec(matrix), "b": b},
        {
            "pivot": factors.pivot,
            "lengths": ca.vertcat(*factors.lengths),
            "square": ca.dot(factors.forward(b), factors.scaled(factors.forward(b))),
        },
    )
    random = np.random.default_rng(size)
    columns, right = random.normal(size=(size + 2, size)), random.normal(size=size)
    triangle = np.linalg.qr(columns)[1]
    sines = np.abs(np.diag(triangle)) / np.linalg.norm(columns, axis=0)
    pivot, lengths, square = function((columns.T @ columns).ravel(), right)
    np.testing.assert_allclose(lengths, np.abs(np.diag(triangle)), rtol=1e-9)
    assert pivot[0] == pytest.approx(sines.min() ** 2, rel=1e-9)
    wanted = right @ np.linalg.solve(columns.T @ columns, right)
    assert square[0] == pytest.approx(wanted, rel=1e-9)
    if size > 1:
        columns[:, 1] = 2.0 * columns[:, 0]
        assert function((columns.T @ columns).ravel(), right)[0][0] < 1e-14
        columns[:, 0] = 0.0
        assert function((columns.T @ columns).ravel(), right)[0][0] == 0.0


def test_threads_do_not_share_arrays():
    """Each thread reads the values of its own call: the switch comes between call and reading."""
    x = ca.SX.sym("x", 2)
    function = TracedFunction("square", {"x": x}, {"y": x**2}, compiled=False)
    barrier = Barrier(4, timeout=60.0)

    def values(number: int) -> bool:
        right = True
        for count in range(200):
            (y,) = function.evaluate(np.array([number, count], dtype=float))
            if count < 3:
                barrier.wait()
            sleep(0.0)
            right &= y.tolist() == [number**2, count**2] and function.is_valid
        return right

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(values, range(4)))


def test_long_functions_of_equal_expressions_are_made_once():
    """And those that differ in one constant are two."""

    def made(last):
        x = ca.SX.sym("x", 3)
        value = x
        for k in range(1000):
            value = ca.sin(value) + (last if k == 999 else 1.0) * x
        return TracedFunction("long", {"x": x}, {"value": value})

    one, again, other = made(1.0), made(1.0), made(1.5)
    assert one.function is again.function
    at = np.array([0.1, 0.2, 0.3])
    np.testing.assert_array_equal(one(at)[0], again(at)[0])
    np.testing.assert_allclose(other(at)[0], one(at)[0] + 0.5 * at, rtol=1e-12)


@pytest.mark.parametrize("small", [1.0, 1e-3, 1e-5, 1e-7])
def test_shortest_solution_of_rows_that_are_nearly_parallel(small):
    """A^T x = b for Lauchli's A, which has ones above a diagonal D, by fractions: x = A y.

    (1 1^T + D^2) y = b, as Sherman and Morrison solve it. Directions are orthogonal to 1e-16 over
    small alone. The error is that of the condition, with room, and A^T x = b holds to round-off.
    """
    diagonal = small * np.array([1.0, 2.0, -1.0])
    A = np.vstack([np.ones(3), np.diag(diagonal)])
    b = np.array([1.0, 1.0 + small, 1.0 - 3.0 * small])
    weights = [1 / Fraction(d) ** 2 for d in diagonal]
    known = [w * Fraction(value) for w, value in zip(weights, b, strict=True)]
    shared = sum(known) / (1 + sum(weights))
    y = [own - w * shared for own, w in zip(known, weights, strict=True)]
    x = np.array(
        [float(sum(y)), *(float(Fraction(d) * v) for d, v in zip(diagonal, y, strict=True))]
    )
    matrix = ca.SX.sym("A", 4, 3)
    function = ca.Function("shortest", [matrix], [Factorization(matrix).shortest(ca.SX(b))])
    found = function(A).full()[:, 0]
    assert_allclose(found, x, rtol=0.0, atol=1e-15 / small * np.abs(x).max())
    assert_allclose(A.T @ found, b, rtol=0.0, atol=1e-14 * np.abs(x).max())


Array = np.ndarray


def root(residual, gradients, start) -> tuple[Array, bool]:
    return newton(np.array(start, float), lambda x: shortest_steps(gradients(x), residual))


def test_a_missing_root_is_reported():
    """x^2 + 1; and a double root, which is found, but is not regular."""
    _, converged = root(lambda x: x**2 + 1, lambda x: np.array([2 * x]), [0.7])
    assert not converged

    def double(x: Array) -> Array:
        return np.array([x[0] ** 2 + x[1], x[1]])

    found, converged = root(double, lambda x: np.array([[2 * x[0], 1], [0, 1]]), [0.5, 0.2])
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
    step, regular = shortest_steps(gradients, lambda at: residual)
    assert regular
    expected = -np.linalg.pinv(gradients) @ residual
    # Numbers of order 1, well conditioned.
    np.testing.assert_allclose(step(x), expected, atol=1e-14)
    step, regular = shortest_steps(np.zeros((0, 6)), lambda at: np.zeros(0))
    np.testing.assert_array_equal(step(x), np.zeros(6))
    assert regular
