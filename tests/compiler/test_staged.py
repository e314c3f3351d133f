"""Staged functions, where values that depend only on time and parameters are precomputed."""

import casadi as ca
import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Adder, Integrator, Sine, ZeroOrderHold
from runs import scenario

from drake_dae import build_scenario
from drake_dae.compiler.compile import compile_diagram
from drake_dae.compiler.compiled import CompiledDiagram


def _sampled_sum() -> CompiledDiagram:
    """The sum of a sine and of its integral, sampled."""
    builder = DiagramBuilder()
    sine = builder.AddSystem(Sine(2.0, 3.0, 0.5, 1))
    integrator, adder = builder.AddSystem(Integrator(1)), builder.AddSystem(Adder(2, 1))
    hold = builder.AddSystem(ZeroOrderHold(0.1, 1))
    builder.Connect(sine.get_output_port(0), integrator.get_input_port())
    builder.Connect(sine.get_output_port(0), adder.get_input_port(0))
    builder.Connect(integrator.get_output_port(), adder.get_input_port(1))
    builder.Connect(adder.get_output_port(), hold.get_input_port())
    builder.ExportOutput(hold.get_output_port(), "sampled")
    builder.ExportOutput(adder.get_output_port(), "sum")
    return compile_diagram(builder.Build())


def _shipped(name: str) -> CompiledDiagram:
    loop, _ = build_scenario(scenario(name))
    return compile_diagram(loop.diagram, list(loop.signals))


def _noise(compiled: CompiledDiagram) -> np.ndarray:
    return np.linspace(-1.0, 1.0, compiled.sizes["noise"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sine", "two_link_wall", "seven_joint_moving_plate"])
def test_staged_functions_equal_the_plain_ones_to_the_bit(name):
    """The operations are the same in the same order; some are in another function."""
    compiled = _sampled_sum() if name == "sine" else _shipped(name)
    staged, time = compiled.staged, 0.37
    state, held = compiled.start(compiled.context)
    parameters = compiled.values(compiled.context)
    state = state + 0.01 * np.cos(np.arange(state.size))
    given = staged["given"](time, parameters)
    plain = {"rate": compiled.rate, "row": compiled.row, "newton": compiled.newton(1)}
    plain |= {f"update_{i}": rate.function for i, rate in enumerate(compiled.rates)}
    assert set(staged) == {"given", *plain}
    for each, function in plain.items():
        noise = [_noise(compiled)] if each.startswith("update") else []
        expected = function(time, state, held, parameters, *noise)
        values = staged[each](time, state, held, parameters, given, *noise)
        for a, b in zip(values, expected, strict=True):
            np.testing.assert_array_equal(a.full(), b.full())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sine", "two_link_wall", "seven_joint_moving_plate"])
def test_staged_functions_do_not_depend_on_time(name):
    """They depend on the precomputed column instead, and have fewer operations."""
    compiled = _sampled_sum() if name == "sine" else _shipped(name)
    for each, plain in {"rate": compiled.rate, "row": compiled.row}.items():
        function = compiled.staged[each]
        symbols = function.sx_in()
        assert not ca.depends_on(ca.vertcat(*function.call(symbols)), symbols[0])
        assert function.n_instructions() < plain.n_instructions() + symbols[4].numel()
