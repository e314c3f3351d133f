"""References: values and derivatives by other routes, smoothness, and refusals."""

import math

import casadi as ca
import numpy as np
import pytest
from pydrake.math import BsplineBasis
from pydrake.trajectories import BsplineTrajectory, PiecewisePolynomial

import drake_dae as dd
from drake_dae.errors import NonFiniteError, ReferenceSignalError, SimulationError
from drake_dae.systems import TrajectoryReference


def table(signal, degree, time):
    """(outputs, derivatives) of one signal at a time."""
    generator = dd.ReferenceGenerator([signal], [degree] * signal.size)
    return generator.reference(time).reshape(signal.size, degree + 1)


def test_sums_of_sinusoids():
    t, a, w, p = 0.7, np.array([0.5, -2.0]), np.array([3.0, 0.4]), np.array([0.1, 1.0])
    found = table(dd.SinusoidReference(4.0, a, w, p), 4, t)[0]
    angle = w * t + p
    expected = [
        4.0 + np.sum(a * np.sin(angle)),
        np.sum(a * w * np.cos(angle)),
        -np.sum(a * w**2 * np.sin(angle)),
        -np.sum(a * w**3 * np.cos(angle)),
        np.sum(a * w**4 * np.sin(angle)),
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_quintic():
    """Order 2 is 10 s^3 - 15 s^4 + 6 s^5."""
    signal = dd.PointToPointReference(1.0, 3.0, 2.0, 4.0)
    for time in (2.3, 3.0, 3.9):
        s = (time - 2.0) / 2.0
        expected = [
            1.0 + 2.0 * (10 * s**3 - 15 * s**4 + 6 * s**5),
            30 * s**2 - 60 * s**3 + 30 * s**4,
            (60 * s - 180 * s**2 + 120 * s**3) / 2.0,
        ]
        np.testing.assert_allclose(table(signal, 2, time)[0], expected, rtol=1e-12)


@pytest.mark.parametrize("order", [2, 4, 6])
def test_moves_are_smooth_at_both_ends_and_held_outside(order):
    signal = dd.PointToPointReference([0.0, 5.0], [1.0, 4.0], 1.0, 2.0, order)
    for time, value in ((0.5, [0.0, 5.0]), (2.5, [1.0, 4.0])):
        found = table(signal, order, time)
        np.testing.assert_array_equal(found[:, 0], value)
        assert not found[:, 1:].any()
    # Derivatives up to `order` vanish at the ends; the next one, below 1e6, enters linearly.
    for time in (1.0 + 1e-9, 2.0 - 1e-9):
        assert np.max(np.abs(table(signal, order, time)[:, 1:])) < 1e-2
    middle = table(signal, order, 1.5)
    np.testing.assert_allclose(middle[:, 0], [0.5, 4.5], atol=1e-12)


def test_drake_trajectories():
    spline = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
        [0.0, 1.0, 2.0, 3.0],
        np.array([[0.0, 1.0, 0.0, 2.0], [1.0, 1.0, 3.0, 0.0]]),
        np.zeros((2, 1)),
        np.zeros((2, 1)),
    )
    points = list(np.arange(9.0)[:, None, None])
    for path in (spline, BsplineTrajectory(BsplineBasis(6, 9), points)):
        signal, time = TrajectoryReference(path), path.start_time() + 0.37
        found = table(signal, 2, time)
        for order in range(3):
            np.testing.assert_allclose(
                found[:, order], path.EvalDerivative(time, order)[:, 0], rtol=1e-12
            )


@pytest.mark.parametrize("symbol", [ca.SX, ca.MX])
def test_functions_of_casadi(symbol):
    time = symbol.sym("t")
    function = ca.Function("f", [time], [ca.sin(time), time**3])
    signal = dd.ExpressionReference(function)
    expected = [[np.sin(0.7), np.cos(0.7), -np.sin(0.7)], [0.343, 1.47, 4.2]]
    np.testing.assert_allclose(table(signal, 2, 0.7), expected, rtol=1e-14)


def hold(values):
    return PiecewisePolynomial.FirstOrderHold(np.arange(len(values)), [values])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dd.ReferenceGenerator([dd.ConstantReference(1.0)], [2, 2]), r"1.*2"),
        (lambda: dd.ReferenceGenerator([dd.PointToPointReference(0, 1, 0, 1)], [4]), "order=4"),
        (
            lambda: dd.ReferenceGenerator([TrajectoryReference(hold([0, 1, 0]))], [2]),
            r"row 0.*-2.*t = 1 s",
        ),
        (lambda: dd.PointToPointReference(0, 1, 1, 1), r"end_time.*1"),
        (lambda: dd.PointToPointReference([1, 2, 3], [1, 2], 0, 1), r"start.*3.*end.*2"),
        (lambda: dd.PointToPointReference(0, 1, 0, 1, order=600), "order"),
        (lambda: dd.SinusoidReference(0.0, "a", 1.0), "amplitudes"),
        (lambda: dd.SinusoidReference(0.0, [1, 2], [1, 2, 3]), r"amplitudes.*2.*frequencies.*3"),
        (lambda: dd.ExpressionReference(lambda t: ca.SX.sym("a") * t), r"\ba\b"),
        (lambda: TrajectoryReference(PiecewisePolynomial(np.eye(2))), "2 x 2"),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ReferenceSignalError, match=message):
        make()


def test_a_time_outside_a_trajectory_is_refused():
    generator = dd.ReferenceGenerator([TrajectoryReference(hold([0, 1]))], [1])
    with pytest.raises(SimulationError, match=r"t = 1\.5 s.* 0 to 1 s"):
        generator.reference(1.5)


def test_a_reference_that_is_not_finite_raises():
    generator = dd.ReferenceGenerator([dd.ExpressionReference(lambda t: ca.log(t))], [1])
    with pytest.raises(NonFiniteError, match="t = 0 s"):
        generator.GetOutputPort("reference").Eval(generator.CreateDefaultContext())


NOT_SMOOTH = {
    "fabs": lambda t: 0.3 * ca.fabs(t - 1),
    "a comparison": lambda t: ca.if_else(t < 1, 0, 0.3),
    "if_else": lambda t: ca.if_else(t, 0, 0.3),
    "floor": lambda t: ca.sin(ca.floor(t)),
}


@pytest.mark.parametrize("what", NOT_SMOOTH)
def test_kinks_and_steps_are_refused_where_derivatives_are_needed(what):
    """CasADi would take the derivatives of one side, and the error would leave its prediction."""
    signal = dd.ExpressionReference(NOT_SMOOTH[what])
    message = rf"row 0 .*{what}"
    with pytest.raises(ReferenceSignalError, match=message):
        dd.ReferenceGenerator([dd.ConstantReference(0.0), signal], [0, 1])
    # A force that is met at once may jump.
    generator = dd.ReferenceGenerator([signal], [0])
    assert np.isfinite(generator.reference(0.5)).all()


def test_the_function_of_the_real_numbers_is_no_reference():
    signal = dd.ExpressionReference(lambda t: math.sin(t))
    with pytest.raises(ReferenceSignalError, match=r"nan.*casadi\.sin"):
        dd.ReferenceGenerator([signal], [2])


@pytest.mark.parametrize("value", [None, "a", [None], {}])
def test_what_is_no_expression_is_refused(value):
    with pytest.raises(ReferenceSignalError, match="expression"):
        dd.ExpressionReference(lambda t: value)


def test_what_is_no_reference_is_refused():
    with pytest.raises(ReferenceSignalError, match=r"values.*'a'"):
        dd.ConstantReference("a")
    message = r"references\[1\].*0\.5"
    with pytest.raises(ReferenceSignalError, match=message):
        dd.ReferenceGenerator([dd.ConstantReference(0.3), 0.5], [0, 0])
