"""References by name: which outputs a name means, and that rows arrive where they belong."""

import casadi as ca
import numpy as np
import pytest
from pydrake.trajectories import PiecewisePolynomial

from drake_dae import ConstantReference, ExpressionReference, PointToPointReference
from drake_dae.errors import ReferenceSignalError
from drake_dae.references import references_by_name, stack_references
from drake_dae.references.reference import FormulaReference, Reference
from drake_dae.systems import TrajectoryReference

OUTPUTS = ["tool.x", "tool.y", "tool.z", "tool.z_axis.x", "left::joint3", "pipe.angle"]
OUTPUTS += ["pipe.along", "pipe.force", "grip.x", "grip.y"]
DEGREES = [2, 2, 2, 2, 2, 2, 2, 0, 0, 0]


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("tool.y", [1]),
        ("tool", [0, 1, 2]),
        ("tool.zx", [2, 0]),
        ("tool.z_axis", [3]),
        ("left::joint3, tool.y", [4, 1]),
        ("pipe", [5, 6]),  # Where it is, and not its force.
        ("pipe.force", [7]),
        ("grip", [8, 9]),
    ],
)
def test_what_a_name_means(name, meant):
    """Row k of the reference is 10 + k; all others are their own place."""
    others = {output: float(place) for place, output in enumerate(OUTPUTS) if place not in meant}
    rows = ExpressionReference(lambda t: [10.0 + k + 0 * t for k in range(len(meant))])
    found = references_by_name({name: rows, **others}, OUTPUTS, DEGREES)
    values = stack_references(found, [0] * len(OUTPUTS))(0.0)
    expected = np.arange(10.0)
    expected[meant] = 10.0 + np.arange(len(meant))
    np.testing.assert_array_equal(values, expected)


def test_rows_apart_keep_their_derivatives():
    """As an expression and as a trajectory: t^2 and t^3, for the last and the first output."""
    cubic = PiecewisePolynomial.CubicHermite([0, 2], [[0, 4], [0, 8]], [[0, 4], [0, 12]])
    for powers in (ExpressionReference(lambda t: [t**2, t**3]), TrajectoryReference(cubic)):
        found = references_by_name({"c, a": powers, "b": 7}, ["a", "b", "c"], [2, 1, 1])
        assert [reference.size for reference in found] == [1, 1, 1]
        values = stack_references(found, [2, 1, 1])(1.5)
        np.testing.assert_allclose(values, [3.375, 6.75, 9.0, 7.0, 0.0, 2.25, 3.0], rtol=1e-13)


@pytest.mark.parametrize(
    ("references", "message"),
    [
        ({}, r"a\.x, a\.y"),
        ({"a.z": 1.0}, r"'a\.z'"),
        ({"a": 1.0, "a.x": 2.0}, r"'a' and 'a\.x'"),
        ({"a": ConstantReference([1.0])}, r"'a': .*a\.x, a\.y"),
        ({"a.xx": 1.0}, r"'a\.xx'"),
        ({"a": PointToPointReference([0, 0], [1, 1], 0, 1, 1)}, r"'a': .*order=2"),
    ],
)
def test_refusals(references, message):
    with pytest.raises(ReferenceSignalError, match=message):
        references_by_name(references, ["a.x", "a.y"], [2, 2])


class Kinked(FormulaReference):
    size = 1

    def rows(self, time):
        return ca.fabs(time)


class Nothing(Reference):
    size = 1

    def expression(self, degrees, time):
        return None


@pytest.mark.parametrize(
    ("reference", "message"),
    [(Kinked(), "row 0 .*not smooth.*PointToPoint"), (Nothing(), r"Nothing.*\(3, 1\).*None")],
)
def test_an_own_reference_without_derivatives_is_refused(reference, message):
    for make in (
        lambda: reference.derivatives([2]),
        lambda: stack_references([reference], [2]),
        lambda: references_by_name({"a": reference}, ["a"], [2]),
    ):
        with pytest.raises(ReferenceSignalError, match=message):
            make()
    if isinstance(reference, Kinked):
        assert reference.derivatives([0])(-2.0) == 2.0
