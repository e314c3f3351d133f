"""Signals that are computed after a run, from what was logged of it."""

import casadi as ca
import numpy as np
from pydrake.trajectories import PiecewisePolynomial

from drake_dae import Record, TrajectoryReference
from drake_dae.dae.system.signals import Signal
from drake_dae.simulation.records.record import Recorded
from drake_dae.systems.blocks.along import function_along
from drake_dae.systems.control.references import ReferenceGenerator
from drake_dae.trace.functions import TracedFunction


def test_a_function_at_each_moment_and_nan_where_it_has_no_value():
    x, y = ca.SX.sym("x"), ca.SX.sym("y", 2)
    function = TracedFunction("root", {"x": x, "y": y}, {"value": ca.vertcat(ca.sqrt(x), y)})
    given = {
        "y": np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]),
        "x": np.array([[4.0], [-1.0], [9.0]]),
        "unused": np.zeros((3, 7)),
    }
    found = function_along(function, given)
    np.testing.assert_array_equal(found, [[2.0, 1.0, 2.0], [np.nan] * 3, [3.0, 5.0, 6.0]])
    nothing = {name: values[:0] for name, values in given.items()}
    assert function_along(function, nothing).shape == (0, 3)


def test_a_value_at_a_singular_matrix_is_none():
    x = ca.SX.sym("x")
    function = TracedFunction("force", {"x": x}, {"value": x}, pivot=x)
    found = function_along(function, {"x": np.array([[1.0], [1e-13]])})
    np.testing.assert_array_equal(found, [[1.0], [np.nan]])


def test_a_reference_that_ends_is_nan_from_there_on():
    path = PiecewisePolynomial.FirstOrderHold([0.0, 1.0], [[0.0, 2.0]])
    generator = ReferenceGenerator([TrajectoryReference(path)], [1])
    found = generator.along([0.0, 0.5, 1.5])
    np.testing.assert_allclose(found, [[0.0, 2.0], [1.0, 2.0], [np.nan, np.nan]], rtol=1e-15)


def test_a_record_ends_where_a_signal_has_no_value():
    values = np.array([[1.0], [2.0], [np.nan], [4.0]])
    signals = {
        "force": Recorded(values, (Signal("wall.force", "N"),)),
        "state": Recorded(np.zeros((4, 2)), (Signal("q", "rad"), Signal("q'", "rad/s"))),
    }
    record = Record(np.arange(4.0), signals).while_finite()
    np.testing.assert_array_equal(record.time, [0.0, 1.0])
    np.testing.assert_array_equal(record["force"], [[1.0], [2.0]])
    assert record["state"].shape == (2, 2)
    assert record.while_finite() is record
