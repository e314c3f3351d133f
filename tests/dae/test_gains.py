from math import comb, factorial

import numpy as np
import pytest
import scipy.linalg

from drake_dae.dae import FeedbackGains, gain_coefficients, gain_matrices, poles
from drake_dae.errors import GainError


def sorted_poles(values) -> np.ndarray:
    return np.sort_complex(np.asarray(values, dtype=complex))


@pytest.mark.parametrize(
    "chosen", [[-1.0, -2.0, -5.0], [-1.0, -2.0 + 3.0j, -2.0 - 3.0j], np.array([-0.5, -0.5, -0.5])]
)
@pytest.mark.equation(32)
def test_the_error_dynamics_have_the_chosen_poles(chosen):
    gains = poles(chosen)(["z"], [3])
    # A triple pole is found to the third root of machine precision, 6e-6.
    np.testing.assert_allclose(sorted_poles(gains.poles), sorted_poles(chosen), atol=1e-4)
    np.testing.assert_allclose(gains.matrix[0, ::-1], np.poly(chosen)[1:].real, rtol=1e-14)


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


NOT_HURWITZ = {
    "one bad pole": (poles([-1.0, 0.5]), [2]),
    "an undamped pair": (poles([1j, -1j]), [2]),
    "a missing gain": (gain_coefficients([0.0, 1.0]), [2]),
    # s^3 + s^2 + s + 2 fails Routh's test although all coefficients are positive.
    "positive coefficients": (gain_coefficients([2.0, 1.0, 1.0]), [3]),
    "a coupling": (gain_matrices([[[1.0, 5.0], [5.0, 1.0]], np.eye(2)]), [2, 2]),
}


@pytest.mark.parametrize("what", NOT_HURWITZ)
def test_gains_that_are_not_hurwitz_are_refused(what):
    design, degrees = NOT_HURWITZ[what]
    with pytest.raises(GainError, match="poles"):
        design([f"z{i}" for i in range(len(degrees))], degrees)


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
