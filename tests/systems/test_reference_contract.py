"""The rules of `Reference`, run on every member: a new one is a line in MEMBERS."""

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from members import subclasses
from pydrake.trajectories import PiecewisePolynomial
from runs import some

import drake_dae as dd
from drake_dae.errors import ReferenceSignalError
from drake_dae.references import PathLimits, ReferenceRows
from drake_dae.systems import TrajectoryReference

PATH = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
    [0.0, 1.0, 2.0], [[0.0, 1.0, 0.5], [1.0, -1.0, 2.0]], np.zeros((2, 1)), np.zeros((2, 1))
)

LIMITS = PathLimits(1.0, 2.0, 20.0)
EDGES = [[0.0, 0.0], [0.5, 0.0], [0.5, 0.5]]


MEMBERS = {
    "constant": dd.ConstantReference([0.3, -2.0]),
    "sinusoids": dd.SinusoidReference(1.0, [0.5, -0.2], [1.3, 2.1], [0.1, 0.7]),
    "point to point": dd.PointToPointReference([0.0, 2.0], [1.0, -1.0], 0.3, 1.7, order=3),
    "expression": dd.ExpressionReference(lambda t: [ca.exp(-t) * ca.cos(2 * t), t**3]),
    "trajectory": TrajectoryReference(PATH),
    "line": dd.LineReference([0.0, 1.0], [0.8, 0.4], LIMITS, 0.2),
    "circle": dd.CircleReference([0.0, 1.0], 0.3, period=2.0),
    "turn": dd.CircleReference([0.0, 1.0], 0.1, limits=LIMITS),
    "polyline": dd.PolylineReference(EDGES, LIMITS, 0.2),
    "polyline of many pieces": dd.PolylineReference(EDGES, LIMITS, 0.01),
    "waypoints": dd.WaypointsReference([[0.0, 0.0], [0.3, 0.2], [0.5, 0.0]], [0.1, 0.8, 1.9]),
    "file": dd.CsvReference(
        str(Path(__file__).parent / "steps.csv"), ["x"], smoothing=0.3, tolerance=0.2
    ),
    "rows": ReferenceRows(
        dd.ExpressionReference(lambda t: [t**3, ca.sin(3 * t), ca.cos(t)]), (2, 0)
    ),
    "rows of a trajectory": ReferenceRows(TrajectoryReference(PATH), (1,)),
}

TIMES = (0.41, 0.93, 1.62)

ROUGH = {
    "waypoints": dd.WaypointsReference([[0.0], [1.0]], [0.0, 1.0], order=2),
    "line": dd.LineReference(0.0, 1.0, LIMITS, order=2),
    "polyline": dd.PolylineReference([[0.0], [1.0]], LIMITS, 0.1, order=2),
    "rows": ReferenceRows(dd.ExpressionReference(lambda t: [t, ca.fabs(t - 1.0)]), (1,)),
    "point to point": dd.PointToPointReference(0.0, 1.0, 0.0, 1.0, order=1),
    "expression": dd.ExpressionReference(lambda t: ca.fabs(t - 1.0)),
    "trajectory": TrajectoryReference(PiecewisePolynomial.FirstOrderHold([0, 1, 2], [[0, 1, 0]])),
}


def table(reference, degree, time):
    """Row per output: value, first derivative, ..."""
    value = reference.derivatives([degree] * reference.size)(time)
    return np.array(value).reshape(reference.size, degree + 1)


def test_no_member_is_left_out():
    assert subclasses(dd.Reference) <= {type(member) for member in MEMBERS.values()}


def rules_1_and_2_size_and_layout(reference):
    assert reference.size >= 1
    degrees = [2, 0, 1][: reference.size]
    value = reference.derivatives(degrees)(0.5)
    assert value.shape == (sum(degrees) + len(degrees),)
    ends = np.cumsum([degree + 1 for degree in degrees])
    rows = np.split(np.array(value), ends[:-1])
    for row, full in zip(rows, table(reference, 2, 0.5), strict=True):
        np.testing.assert_allclose(row, full[: row.size], rtol=1e-14, atol=1e-14)


def rule_3_each_derivative_is_that_of_the_one_before(reference):
    """Central differences over h = 1e-4 s are off by h^2 / 6 of the third derivative after.

    With derivatives below 1e3, of the move of 1.4 s, that is 2e-6; round-off adds 1e-16 / h.
    """
    h = 1e-4
    for time in TIMES:
        found = table(reference, 2, time)
        slope = (table(reference, 2, time + h) - table(reference, 2, time - h)) / (2 * h)
        np.testing.assert_allclose(found[:, 1:], slope[:, :-1], rtol=0, atol=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", some(MEMBERS, of=3))
def test_rule_3_what_the_law_integrates_is_continuous(name):
    """Across 2 us, values and first derivatives change by less than their slopes allow."""
    for time in [*np.linspace(0.01, 1.99, 67).tolist(), 0.3, 1.0, 1.7]:
        change = table(MEMBERS[name], 2, time + 1e-6) - table(MEMBERS[name], 2, time - 1e-6)
        assert np.abs(change[:, :-1]).max() < 1e-3


def rule_4_a_value_depends_on_the_time_alone(reference):
    function = reference.derivatives([1] * reference.size)
    first = [function(time) for time in TIMES]
    again = [function(time) for time in reversed(TIMES)]
    np.testing.assert_array_equal(first, again[::-1])


@pytest.mark.parametrize("name", ROUGH)
def test_rule_5_what_is_too_rough_is_refused_before_it_is_used(name):
    size = ROUGH[name].size
    ROUGH[name].derivatives([0] * size)
    with pytest.raises(ReferenceSignalError, match=r"\b3\b"):
        ROUGH[name].derivatives([3] * size)


def rule_6_traced_together_the_values_are_the_same(reference):
    """Beside another, all as one function or one after the other; and as an expression."""
    degrees = [2] * reference.size
    time = ca.SX.sym("t")
    traced = ca.Function("rows", [time], [reference.expression(degrees, time)])
    generator = dd.ReferenceGenerator([dd.ConstantReference(7.0), reference], [1, *degrees])
    for moment in TIMES:
        stacked = generator.reference(moment)
        np.testing.assert_array_equal(stacked[:2], [7.0, 0.0])
        own = reference.derivatives(degrees)(moment)
        np.testing.assert_allclose(stacked[2:], own, rtol=1e-14, atol=1e-14)
        # Derivatives of a polynomial of a short piece are divided by its length.
        np.testing.assert_allclose(traced(moment).full()[:, 0], own, rtol=1e-12, atol=1e-12)


RULES = (
    rules_1_and_2_size_and_layout,
    rule_3_each_derivative_is_that_of_the_one_before,
    rule_4_a_value_depends_on_the_time_alone,
    rule_6_traced_together_the_values_are_the_same,
)


@pytest.mark.parametrize("name", MEMBERS)
def test_each_rule(name):
    for rule in RULES:
        rule(MEMBERS[name])
