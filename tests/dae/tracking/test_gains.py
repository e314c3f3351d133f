from math import comb, factorial

import numpy as np
import pytest
import scipy.linalg
from scipy.integrate import solve_ivp

from drake_dae.dae.tracking.gains import FeedbackGains, gain_coefficients, gain_matrices, poles
from drake_dae.errors import GainError


def sorted_poles(values) -> np.ndarray:
    return np.sort_complex(np.asarray(values, dtype=complex))


def test_one_pole_serves_all_outputs():
    gains = poles(-2.0)(["a", "b", "c"], [2, 0, 3])
    assert gains.names == ("a", "b", "c")
    assert gains.degrees == (2, 0, 3)
    # (s + 2)^2 = s^2 + 4 s + 4 and (s + 2)^3 = s^3 + 6 s^2 + 12 s + 8, lowest derivative first.
    np.testing.assert_allclose(
        gains.matrix, [[4, 4, 0, 0, 0], [0, 0, 0, 0, 0], [0, 0, 8, 12, 6]], rtol=1e-15
    )


@pytest.mark.parametrize(
    "chosen",
    [
        [-1.0, -2.0, -5.0],
        [-1.0, -2.0 + 3.0j, -2.0 - 3.0j],
        np.array([-0.5, -0.5, -0.5]),
    ],
)
@pytest.mark.equation(32)
def test_the_error_dynamics_have_the_chosen_poles(chosen):
    gains = poles(chosen)(["z"], [3])
    # A triple pole is found to the third root of machine precision, 6e-6.
    np.testing.assert_allclose(sorted_poles(gains.poles), sorted_poles(chosen), atol=1e-4)
    np.testing.assert_allclose(gains.matrix[0, ::-1], np.poly(chosen)[1:].real, rtol=1e-14)


def test_poles_per_output():
    gains = poles({"slow": -1.0, "fast": [-10.0, -20.0]})(["fast", "met", "slow"], [2, 0, 1])
    np.testing.assert_allclose(gains.matrix, [[200, 30, 0], [0, 0, 0], [0, 0, 1]], rtol=1e-15)


def test_a_star_stands_for_all_other_outputs():
    gains = poles({"a": -1.0, "*": -2.0})(["a", "met", "b", "c"], [1, 0, 1, 2])
    np.testing.assert_array_equal(np.diag(gains.matrix[[0, 2, 3]]), [1.0, 2.0, 4.0])
    assert gains.matrix[3, 3] == 4.0


def test_coefficients_stand_lowest_derivative_first():
    gains = gain_coefficients([6.0, 5.0])(["a", "b"], [2, 2])
    np.testing.assert_array_equal(gains.matrix, [[6, 5, 0, 0], [0, 0, 6, 5]])
    # s^2 + 5 s + 6 = (s + 2)(s + 3).
    np.testing.assert_allclose(sorted_poles(gains.poles), [-3, -3, -2, -2], rtol=1e-14)
    single = gain_coefficients({"a": [3.0], "c": 4.0})(["a", "b", "c"], [1, 0, 1])
    np.testing.assert_array_equal(single.matrix, [[3, 0], [0, 0], [0, 4]])


def test_error_matrix_is_the_companion_form():
    gains = gain_coefficients({"a": [1.0, 2.0, 3.0], "c": [4.0]})(["a", "b", "c"], [3, 0, 1])
    np.testing.assert_array_equal(
        gains.error_matrix, [[0, 1, 0, 0], [0, 0, 1, 0], [-1, -2, -3, 0], [0, 0, 0, -4]]
    )


LAMBDA_1 = np.array([[30.0, 4.0, 1.0], [-5.0, 25.0, 2.0], [3.0, 1.0, 20.0]])
LAMBDA_2 = np.array([[11.0, 2.0, 0.0], [1.0, 10.0, -2.0], [0.5, 1.0, 9.0]])


@pytest.mark.equation(60)
def test_matrices_couple_outputs_of_one_degree():
    """e'' + Lambda_2 e' + Lambda_1 e = 0 (60) with full matrices, against the matrix exponential.

    The check stacks (e, e') and not (e_1, e_1', e_2, ...), as the library does.
    """
    gains = gain_matrices([LAMBDA_1, LAMBDA_2])(["a", "force", "b", "c"], [2, 0, 2, 2])
    assert gains.matrix.shape == (4, 6)
    stacked = np.block([[np.zeros((3, 3)), np.eye(3)], [-LAMBDA_1, -LAMBDA_2]])
    np.testing.assert_allclose(
        sorted_poles(gains.poles), sorted_poles(np.linalg.eigvals(stacked)), rtol=1e-12
    )
    error, rate = np.array([0.3, -0.2, 0.1]), np.array([1.0, 0.5, -2.0])
    times = np.linspace(0.0, 2.0, 9)
    found = gains.error_response(times, np.column_stack([error, rate]).reshape(-1))
    expected = np.array(
        [(scipy.linalg.expm(stacked * t) @ np.concatenate([error, rate]))[:3] for t in times]
    )
    # Exponentials of matrices of norm 60.
    np.testing.assert_allclose(found[:, [0, 2, 3]], expected, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(found[:, 1], 0.0)


def test_matrices_of_several_degrees_come_highest_first():
    gains = gain_matrices(
        [np.diag([8.0, 27.0]), np.diag([12.0, 27.0]), np.diag([6.0, 9.0])],
        [[[2.0]]],
    )(["slow", "a", "b"], [1, 3, 3])
    np.testing.assert_array_equal(gains.matrix[0], [2, 0, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(gains.matrix[1], [0, 8, 12, 6, 0, 0, 0])
    np.testing.assert_array_equal(gains.matrix[2], [0, 0, 0, 0, 27, 27, 9])


def test_1_by_1_matrices_may_be_numbers():
    np.testing.assert_array_equal(gain_matrices([4.0, [[5.0]]])(["z"], [2]).matrix, [[4.0, 5.0]])


@pytest.mark.parametrize("degree", [1, 2, 4, 6])
@pytest.mark.parametrize("rate", [1e-3, 1.0, 100.0, 1e6])
def test_response_of_repeated_poles_in_closed_form(degree, rate):
    """e = (w_0 + w_1 t + ... ) exp(-a t), where the w_j are the derivatives of e exp(a t) at 0."""
    random = np.random.default_rng(degree)
    initial = random.normal(size=degree) * rate ** np.arange(degree)
    times = 20.0 / rate * np.linspace(0.0, 1.0, 41) ** 1.5
    weights = [
        sum(comb(j, i) * rate ** (j - i) * initial[i] for i in range(j + 1)) for j in range(degree)
    ]
    expected = np.exp(-rate * times) * sum(
        w * times**j / factorial(j) for j, w in enumerate(weights)
    )
    found = poles(-rate)(["z"], [degree]).error_response(times, initial)[:, 0]
    # A polynomial of degree 5 whose terms cancel.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * np.abs(expected).max())


def test_response_of_complex_poles_in_closed_form():
    # e'' + 2 e' + 10 e = 0 with e(0) = 1, e'(0) = -1: e = exp(-t) cos(3 t).
    gains = poles([-1.0 + 3.0j, -1.0 - 3.0j])(["z"], [2])
    np.testing.assert_allclose(gains.matrix, [[10.0, 2.0]], rtol=1e-15)
    times = np.linspace(0.0, 5.0, 21)
    np.testing.assert_allclose(
        gains.error_response(times, [1.0, -1.0])[:, 0],
        np.exp(-times) * np.cos(3 * times),
        rtol=0,
        atol=1e-13,  # The exponential of a matrix of norm 20.
    )


def test_response_of_any_coupling_against_an_integrator():
    """A chain of couplings between outputs of degrees 2, 1, 3, and an uncoupled one."""
    degrees, random = (2, 1, 3, 0, 2), np.random.default_rng(5)
    matrix = poles(-3.0)(list("abcde"), degrees).matrix.copy()
    matrix[0, 2], matrix[1, 4], matrix[2, 1] = 1.5, -0.7, 0.4
    gains = FeedbackGains(tuple("abcde"), degrees, matrix)
    initial = random.normal(size=8)
    times = np.linspace(0.0, 3.0, 7)

    def rates(_, e: np.ndarray) -> np.ndarray:
        highest = -matrix @ e
        return np.array([e[1], highest[0], highest[1], e[4], e[5], highest[2], e[7], highest[4]])

    solution = solve_ivp(rates, (0, 3), initial, "DOP853", times, rtol=1e-12, atol=1e-13)
    outputs = np.zeros((7, 5))
    outputs[:, [0, 1, 2, 4]] = solution.y[[0, 2, 3, 6]].T
    # The integrator's tolerance, over a hundred steps.
    np.testing.assert_allclose(gains.error_response(times, initial), outputs, rtol=0, atol=1e-10)


def test_one_output_does_not_spoil_another():
    """Fast and slow outputs are solved apart: the slow error keeps its relative precision."""
    gains = poles({"fast": -1000.0, "slow": -1e-3})(["fast", "slow"], [4, 1])
    response = gains.error_response([1000.0], [1.0, 0.0, 0.0, 0.0, 1.0])
    assert response[0, 1] == pytest.approx(np.exp(-1.0), rel=1e-14)
    assert response[0, 0] == 0.0


def test_response_starts_at_the_initial_error_and_takes_one_time():
    gains = poles(-1.0)(["a", "met", "b"], [2, 0, 1])
    np.testing.assert_array_equal(gains.error_response(0.0, [3.0, 7.0, 5.0]), [[3.0, 0.0, 5.0]])
    assert gains.error_response([], [3.0, 7.0, 5.0]).shape == (0, 3)
    nothing = poles(-1.0)(["met"], [0])
    np.testing.assert_array_equal(nothing.error_response([0.0, 1.0], []), [[0.0], [0.0]])


def test_times_may_come_in_any_order_and_number():
    """A log at 1 kHz, shuffled, with times before the start and repeated ones."""
    gains = poles(-2.0)(["z"], [2])
    times = np.concatenate([np.arange(10_001) * 1e-3, [-0.5, 0.3, 0.3, 1 / 3, np.pi]])
    times = np.random.default_rng(0).permutation(times)
    found = gains.error_response(times, [1.0, 0.0])[:, 0]
    expected = (1 + 2 * times) * np.exp(-2 * times)
    # Ten thousand products round at 1e-16 each.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)


def test_gains_cannot_be_changed():
    matrix = np.array([[1.0, 2.0]])
    gains = FeedbackGains(["z"], [2], matrix)
    matrix[0, 0] = -9.0
    assert gains.matrix[0, 0] == 1.0
    assert (gains.names, gains.degrees) == (("z",), (2,))
    with pytest.raises(ValueError, match="read-only"):
        gains.matrix[0, 0] = 5.0


NOT_HURWITZ = {
    "a positive pole": (poles(1.0), [2]),
    "a zero pole": (poles(0.0), [1]),
    "one bad pole": (poles([-1.0, 0.5]), [2]),
    "an undamped pair": (poles([1j, -1j]), [2]),
    "a missing gain": (gain_coefficients([0.0, 1.0]), [2]),
    "a negative gain": (gain_coefficients([1.0, -1.0]), [2]),
    # s^3 + s^2 + s + 2 fails Routh's test although all coefficients are positive.
    "positive coefficients": (gain_coefficients([2.0, 1.0, 1.0]), [3]),
    "a coupling": (gain_matrices([[[1.0, 5.0], [5.0, 1.0]], np.eye(2)]), [2, 2]),
}


@pytest.mark.parametrize("what", NOT_HURWITZ)
def test_gains_that_are_not_hurwitz_are_refused(what):
    design, degrees = NOT_HURWITZ[what]
    with pytest.raises(GainError, match="poles"):
        design([f"z{i}" for i in range(len(degrees))], degrees)


def test_slow_poles_beside_fast_ones_pass():
    """The eigenvalues of gains from 1e-9 to 1e15 are still told from zero."""
    chosen = [-1e5, -1e5, -1e5, -1e-3, -1e-3, -1e-3]
    assert poles(chosen)(["z"], [6]).poles.real.max() < -5e-4


REFUSED = {
    "too many poles": (poles([-1, -2, -3]), [2], r"\b3\b"),
    "no poles": (poles([]), [2], r"\b0\b"),
    "complex poles without partner": (poles([-1 + 1j, -2 - 1j]), [2], r"\ba\b"),
    "one complex pole": (poles(-1 + 1j), [3], r"\ba\b"),
    "an odd number of complex poles": (poles([-1 + 1j, -1 - 1j, -1 + 1j]), [3], r"\ba\b"),
    "too few coefficients": (gain_coefficients([1.0]), [2], "K_i1.*1"),
    "unknown outputs": (poles({"b": -1.0}), [2], "b.*a"),
    "no outputs": (gain_coefficients({}), [2], r"\ba\b"),
    "gains of an output met at once": (poles({"a": -1.0}), [0], "0.*a"),
    "too many groups": (
        gain_matrices([1, 2], [3]),
        [2],
        "1.*2",
    ),
    "a group too few": (gain_matrices(), [2], r"\[2\].*1.*0"),
    "a matrix too few": (gain_matrices([1.0]), [2], "2.*1"),
    "a wrong matrix": (
        gain_matrices([np.eye(2), 1.0]),
        [2],
        r"\(2, 2\).*\(1, 1\)",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_wrong_designs_are_refused_by_name(what):
    design, degrees, message = REFUSED[what]
    with pytest.raises(GainError, match=message):
        design(["a"], degrees)


@pytest.mark.parametrize(
    ("design", "given", "message"),
    [
        (poles, np.nan, r"values.*nan"),
        (poles, "fast", r"values.*'fast'"),
        (gain_coefficients, "ab", r"values.*'ab'"),
        (gain_coefficients, [[1.0, 2.0]], r"values\[0\]"),
        (gain_coefficients, [1.0, 2.0j], r"values\[1\].*2j"),
        (gain_coefficients, {"a": [1.0, np.inf]}, r"values\['a'\]\[1\]"),
        (gain_matrices, ["a", "b"], r"groups\[0\].*'a'"),
    ],
)
def test_what_are_no_numbers_is_refused_at_once(design, given, message):
    with pytest.raises(GainError, match=rf"{design.__name__}.*{message}"):
        design(given)


@pytest.mark.parametrize(
    ("names", "degrees", "matrix", "message"),
    [
        (["a"], [2], [[1.0]], r"\(1, 2\).*\(1, 1\)"),
        (["a"], [2], [1.0, 2.0], r"\(2,\)"),
        (["a"], [2, 1], np.ones((2, 3)), r"1.*2"),
        (["a"], [1], [[np.nan]], "nan"),
        (["a"], [1], "K", "'K'"),
        (["a", "b"], [0, 1], [[1.0], [1.0]], r"'a'.*0"),
    ],
)
def test_wrong_gains_are_refused(names, degrees, matrix, message):
    with pytest.raises(GainError, match=message):
        FeedbackGains(names, degrees, matrix)


def test_wrong_initial_errors_are_refused():
    gains = poles(-1.0)(["a", "b"], [2, 1])
    for initial in ([1.0, 2.0], [1.0, 2.0, 3.0, 4.0], [[1.0, 2.0, 3.0]]):
        with pytest.raises(GainError, match=r"\b3\b"):
            gains.error_response([0.0], initial)
