import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from problems import double_integrator

from drake_dae.dae import DaeSystem, Parameter
from drake_dae.errors import ModelError


def evaluated(system: DaeSystem, key: str, state: np.ndarray) -> np.ndarray:
    function = ca.Function(
        "value", [system.state, system.parameter_symbol], [ca.densify(getattr(system, key))]
    )
    return np.array(function(state, system.parameter_values))


def constrained(**changes) -> DaeSystem:
    """n = 4, m = 1, p = 2: a point on a line, with its force and its place along it."""
    fields = {
        "f": lambda x: [x[2], x[3], 0, 0],
        "g": lambda x: [0, 0, 1, 0],
        "h": lambda x: [[0, 0], [0, 0], [1, 0], [0, 1]],
        "k": lambda x: x[0],
        "l": lambda x: [0, x[1]],
        "m": lambda x: [1, 0],
    }
    return DaeSystem.from_functions(4, **{**fields, **changes})


def test_dimensions_and_made_up_names():
    system = constrained()
    assert (system.num_states, system.num_constraints, system.num_controls) == (4, 1, 2)
    shapes = {key: getattr(system, key).shape for key in "fghklm"}
    assert shapes == {"f": (4, 1), "g": (4, 1), "h": (4, 2), "k": (1, 1), "l": (2, 1), "m": (2, 1)}
    assert [s.name for s in system.state_signals] == ["x0", "x1", "x2", "x3"]
    assert [s.name for s in system.constraint_input_signals] == ["v0"]
    assert [s.name for s in system.constraint_output_signals] == ["y0"]
    assert [s.name for s in system.control_signals] == ["u0", "u1"]
    assert [s.name for s in system.output_signals] == ["z0", "z1"]
    np.testing.assert_array_equal(system.nominal_state, np.zeros(4))


def test_outputs_are_l_and_m_v():
    """(3), to the bit; with forces among the outputs, without, and where v shares an output."""
    outputs = {"l": lambda x: [x[0] * x[1], ca.sin(x[3])], "m": lambda x: [[2 + x[0]], [0]]}
    v = ca.SX.sym("v")
    for system in (constrained(), constrained(**outputs), constrained(m=lambda x: [0, 0])):
        function = ca.Function("z", [system.state, v], [ca.densify(system.outputs(v))])
        for x in np.random.default_rng(1).normal(size=(5, 4)):
            wanted = evaluated(system, "l", x) + evaluated(system, "m", x) * 3.5
            np.testing.assert_array_equal(function(x, 3.5), wanted)


def test_parameters_are_found_by_name():
    system = double_integrator(
        f=lambda x, p: [x[1], p.a + p.b[1]],
        h=lambda x, p: [0, 1],
        l=lambda x, p: x[0],
        parameters={"a": 2.0, "b": [3.0, 4.0], "c": np.float32(5)},
    )
    np.testing.assert_array_equal(system.parameter_values, [2.0, 3.0, 4.0, 5.0])
    assert [system.parameter_slice(name) for name in "abc"] == [
        slice(0, 1),
        slice(1, 3),
        slice(3, 4),
    ]
    assert evaluated(system, "f", np.zeros(2))[1, 0] == 6.0
    with pytest.raises(ModelError, match=r"'mass'.*a, b, c"):
        system.parameter_slice("mass")
    with pytest.raises(ModelError, match="'mass'"):
        double_integrator().parameter_slice("mass")


WRONG_SHAPES = {
    "f": (lambda x: [x[1], 0, 0], r"f .*\(3, 1\).*\(2, 1\)"),
    "g": (lambda x: [[1, 0], [0, 1]], r"g .*\(2, 2\).*\(2, 0\)"),
    "h": (lambda x: [0, 1, 0], r"h .*\(3, 1\).*\(2, 1\)"),
    "k": (lambda x: x[0], r"g .*\(2, 1"),
    "l": (lambda x: [[x[0], x[1]], [x[1], x[0]]], r"l .*\(2, 2\).*\(4, 1\)"),
    "m": (lambda x: [1, 2], r"m .*\(2, 1\).*\(1, 0\)"),
}


@pytest.mark.parametrize("key", WRONG_SHAPES)
def test_wrong_shapes_are_refused_by_name(key):
    function, message = WRONG_SHAPES[key]
    with pytest.raises(ModelError, match=rf"double integrator.*{message}"):
        double_integrator(**{key: function})


BAD_VALUES = {
    "an MX": (lambda x: ca.MX.sym("a", 2), "MX"),
    "NaN": (lambda x: [x[1], np.nan], "f, .*nan"),
    "infinity": (lambda x: [x[1], ca.inf], "f, .*inf"),
    "text": (lambda x: "x1", "f .*str"),
    "nothing": (lambda x: None, r"\bf\b"),
    "rows of two lengths": (lambda x: [[1, 2], [3]], r"\bf\b"),
    "an unknown symbol": (lambda x: [x[1], ca.SX.sym("mass")], "f .*mass"),
    "a failing function": (lambda x: [x[1], x[7]], r"\bf\b"),
    "a wrong signature": (lambda x, p: [x[1], 0], "'p'"),
    "no function": ([1, 2], r"f .*\[1, 2\]"),
    "a condition": (lambda x: [x[1], 1 if x[0] > 0 else 2], r"\bf\b"),
    "a function of the real number": (lambda x: [x[1], math.sin(x[0])], r"f, .*\[1, 0\].*math.sin"),
}


@pytest.mark.parametrize("what", BAD_VALUES)
def test_bad_expressions_are_refused(what):
    drift, message = BAD_VALUES[what]
    with pytest.raises(ModelError, match=message):
        double_integrator(f=drift)


NOT_SMOOTH = {
    "fabs": lambda x: ca.fabs(x),
    "fmin": lambda x: ca.fmin(x, 1),
    "floor": lambda x: ca.floor(x),
    "if_else": lambda x: ca.if_else(x, x, 2.0),
    "a comparison": lambda x: (x > 0) * x,
    "copysign": lambda x: ca.copysign(1, x),
    "remainder": lambda x: ca.remainder(x, 2),
}


@pytest.mark.parametrize("key", "fk")
@pytest.mark.parametrize("what", NOT_SMOOTH)
def test_functions_that_are_not_smooth_are_refused(key, what):
    """In any function, in any entry, and inside others."""
    base = constrained()
    expression = ca.SX(getattr(base, key))
    expression[-1] += ca.sin(NOT_SMOOTH[what](base.state[2] + 1) + 3)
    rows, columns = getattr(base, key).shape
    named = rf"system: {key}, .*\[{rows - 1}, {columns - 1}\].*\({rows}, {columns}\).*{what}"
    with pytest.raises(ModelError, match=named):
        replace(base, **{key: expression})


def test_bad_parameters_are_refused():
    for value in (np.nan, [1.0, np.inf], [[1.0]]):
        with pytest.raises(ModelError, match="'mass'"):
            Parameter("mass", value)
    with pytest.raises(ModelError, match="'heavy'"):
        Parameter("mass", "heavy")
    for symbol in (
        ca.SX.sym("m", 3),
        ca.SX.sym("m", 2).T,
        ca.SX.sym("m", 2) ** 2,
        ca.MX.sym("m", 2),
    ):
        with pytest.raises(ModelError, match="symbol"):
            Parameter("mass", [1.0, 2.0], symbol=symbol)
    with pytest.raises(ModelError, match=r"link1\.mass"):
        double_integrator(parameters={"link1.mass": 1.0})
    x = ca.SX.sym("x")
    with pytest.raises(ModelError, match=r"\ba\b"):
        DaeSystem(
            state=x,
            f=x,
            g=[],
            h=1,
            k=[],
            l=x,
            m=[],
            parameters=(Parameter("a", 1.0), Parameter("a", 2.0)),
        )
