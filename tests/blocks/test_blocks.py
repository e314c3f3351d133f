"""A Block as a LeafSystem, and diagrams composed to one block, beside the diagram as wired."""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pydrake.common import RandomDistribution
from pydrake.symbolic import Expression, Variable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    Adder,
    FirstOrderLowPassFilter,
    Gain,
    Integrator,
    LinearSystem,
    LogVectorOutput,
    RandomSource,
    ZeroOrderHold,
)
from runs import scenario

from drake_dae import Block, TracedSystem, build_scenario, compile_diagram
from drake_dae.blocks import Held, Requirement
from drake_dae.errors import ModelError, SimulationError, SingularityError


def pendulum() -> Block:
    """x'' = -g sin(x) - d x' + u, with a counter of samples and the last sample of x."""
    x, u, d = ca.SX.sym("x", 2), ca.SX.sym("u", 1), ca.SX.sym("d")
    count, last = ca.SX.sym("count", 1), ca.SX.sym("last", 1)
    return Block(
        "pendulum",
        {"torque": u},
        {"angle": x[0], "last": last, "power": u * x[1], "fixed": ca.SX([3.0])},
        x,
        ca.vertcat(x[1], -9.81 * ca.sin(x[0]) - d * x[1] + u),
        {
            "count": Held(count, count + 1, np.zeros(1), 0.1),
            "last": Held(last, x[0], np.array([np.nan]), 0.25, 0.05, begin=10.0 * x[0]),
        },
        d,
        {"state": np.array([0.3, 0.0]), "parameters": np.array([0.1])},
        {"torque": ca.SX.zeros(1)},
    )


def test_what_is_no_block_is_refused():
    x, y = ca.SX.sym("x", 2), ca.SX.sym("stray", 1)
    one = ca.SX.sym("one", 1)
    for arguments, told in (
        ({"state": x, "derivative": x[0]}, "derivative must have 2 entries, got 1"),
        ({"outputs": {"angle": y}}, "angle depends on stray"),
        ({"held": {"one": Held(one, x, np.zeros(1), 0.1)}}, "next of 'one'"),
        ({"held": {"one": Held(one, one, np.zeros(2), 0.1)}}, "start of 'one'"),
    ):
        with pytest.raises(ModelError, match=told):
            TracedSystem(Block("bad", **arguments))


def test_ports_depend_on_what_their_expressions_read():
    system = TracedSystem(pendulum())
    reads = {
        name: system.HasDirectFeedthrough(0, system.GetOutputPort(name).get_index())
        for name in ("angle", "last", "power", "fixed")
    }
    assert reads == {"angle": False, "last": False, "power": True, "fixed": False}


def test_rates_offsets_and_the_start_are_drakes():
    """After 1 s: samples of 0.1 s at 0, ..., 0.9; the last of 0.25 s at 0.8 s, with offset."""
    system = TracedSystem(pendulum())
    simulator = Simulator(system)
    simulator.Initialize()
    context = simulator.get_mutable_context()
    assert_allclose(system.GetOutputPort("last").Eval(context), [3.0])
    simulator.AdvanceTo(0.81)
    angle = system.GetOutputPort("last").Eval(context)
    simulator.AdvanceTo(1.0)
    assert context.get_discrete_state(0).value() == [10.0]
    again = Simulator(system)
    again.AdvanceTo(0.8)
    assert_allclose(angle, again.get_context().get_continuous_state_vector().value()[:1], atol=1e-6)


def test_it_converts_to_expressions():
    system = TracedSystem(pendulum()).ToSymbolic()
    context = system.CreateDefaultContext()
    angle, rate = Variable("a"), Variable("w")
    context.SetContinuousState([Expression(angle), Expression(rate)])
    change = system.EvalTimeDerivatives(context).CopyToVector()[1]
    assert change.Evaluate({angle: 0.4, rate: -0.2}) == pytest.approx(
        -9.81 * np.sin(0.4) + 0.02, abs=1e-13
    )


def test_a_requirement_that_does_not_hold_is_named():
    x = ca.SX.sym("x", 1)
    near, far = Requirement.regular(x, "M"), Requirement(2.0 - x, "beyond 2", Requirement.OUTSIDE)
    outputs = {"inverse": near.of(1 / x), "root": far.of(ca.sqrt(2.0 - x))}
    system = TracedSystem(Block("inverse", {"x": x}, outputs, requirements=(near, far)))
    context = system.CreateDefaultContext()
    for value, port, kind, told in (
        (0.0, "inverse", SingularityError, "M"),
        (3.0, "root", SimulationError, "beyond 2"),
    ):
        system.GetInputPort("x").FixValue(context, [value])
        with pytest.raises(kind, match=told):
            system.GetOutputPort(port).Eval(context)
    assert_allclose(system.GetOutputPort("inverse").Eval(context), [1 / 3])


def wired():
    """Two pendulums in nested diagrams, Drake's primitives, three rates, noise, a fixed port."""
    inner = DiagramBuilder()
    one = inner.AddNamedSystem("one", TracedSystem(pendulum()))
    smooth = inner.AddNamedSystem("smooth", FirstOrderLowPassFilter(0.2))
    inner.Connect(one.GetOutputPort("angle"), smooth.get_input_port())
    inner.ExportInput(one.GetInputPort("torque"), "torque")
    inner.ExportOutput(smooth.get_output_port(), "smooth")
    inner.ExportOutput(one.GetOutputPort("last"), "last")
    builder = DiagramBuilder()
    nested = builder.AddNamedSystem("nested", inner.Build())
    two = builder.AddNamedSystem("two", TracedSystem(pendulum()))
    hold = builder.AddNamedSystem("hold", ZeroOrderHold(0.03, 1))
    gain = builder.AddNamedSystem("gain", Gain(-2.0, 1))
    total = builder.AddNamedSystem("total", Adder(2, 1))
    linear = builder.AddNamedSystem("linear", LinearSystem([[0.9]], [[0.1]], [[1.0]], [[0]], 0.02))
    summed = builder.AddNamedSystem("summed", Integrator(1))
    noise = builder.AddNamedSystem("noise", RandomSource(RandomDistribution.kGaussian, 1, 0.05))
    builder.Connect(nested.GetOutputPort("smooth"), hold.get_input_port())
    builder.Connect(hold.get_output_port(), gain.get_input_port())
    builder.Connect(gain.get_output_port(), total.get_input_port(0))
    builder.Connect(noise.get_output_port(), total.get_input_port(1))
    builder.Connect(total.get_output_port(), two.GetInputPort("torque"))
    builder.Connect(two.GetOutputPort("angle"), linear.get_input_port())
    builder.Connect(linear.get_output_port(), nested.GetInputPort("torque"))
    builder.Connect(two.GetOutputPort("power"), summed.get_input_port())
    for name, port in (("sum", summed.get_output_port()), ("last", nested.GetOutputPort("last"))):
        builder.ExportOutput(port, name)
    log = LogVectorOutput(summed.get_output_port(), builder)
    return builder.Build(), log, noise


def test_a_diagram_of_all_kinds_is_one_block():
    """Equal in all states after 1 s; error control chooses the same steps, up to round-off."""
    diagram, _, noise = wired()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(1.0)
    values = [diagram.GetOutputPort(n).Eval(simulator.get_context())[0] for n in ("sum", "last")]

    start = diagram.CreateDefaultContext()
    block = compile_diagram(diagram, context=start)
    assert list(block.inputs) == ["noise.output"]
    builder = DiagramBuilder()
    one = builder.AddSystem(TracedSystem(block))
    source = builder.AddSystem(noise.Clone())
    builder.Connect(source.get_output_port(), one.GetInputPort("noise.output"))
    whole = builder.Build()
    context = whole.CreateDefaultContext()
    source.GetMyMutableContextFromRoot(context).SetStateAndParametersFrom(
        noise.GetMyContextFromRoot(start)
    )
    composed = Simulator(whole, context)
    composed.AdvanceTo(1.0)
    own = one.GetMyContextFromRoot(context)
    found = [one.GetOutputPort(name).Eval(own)[0] for name in ("sum", "last")]
    assert_allclose(found, values, rtol=1e-9)


def test_an_input_without_wire_and_value_is_named():
    builder = DiagramBuilder()
    gain = builder.AddNamedSystem("gain", Gain(2.0, 1))
    total = builder.AddNamedSystem("total", Adder(2, 1))
    builder.Connect(gain.get_output_port(), total.get_input_port(0))
    builder.ExportOutput(total.get_output_port(), "total")
    builder.ExportInput(gain.get_input_port(), "free")
    diagram = builder.Build()
    with pytest.raises(ModelError, match="'u1' of 'total'"):
        compile_diagram(diagram)
    context = diagram.CreateDefaultContext()
    total.get_input_port(1).FixValue(total.GetMyContextFromRoot(context), [1.0])
    assert list(compile_diagram(diagram, context=context).inputs) == ["free", "total.u1"]


@pytest.mark.parametrize(
    ("name", "settings", "shares"),
    [
        ("two_link_wall", (), True),
        ("two_link_wall", ("plant.parameters={link2.mass: [7.0]}",), False),
        ("four_bar", (), True),
        ("two_link_hydraulics", (), True),
    ],
)
def test_plant_and_law_of_one_model_share_equal_parameters(name, settings, shares):
    """Derivative and outputs as wired, at the start and near it, to round-off of the sizes."""
    loop, context = build_scenario(scenario(name, *settings))
    outputs = {n: loop.diagram.GetOutputPort(n) for n in loop.signals}
    block = compile_diagram(loop.diagram, outputs, context=context)
    size = loop.plant.dae.parameter_symbol.numel()
    assert (block.parameters.numel() < 2 * size) is shares
    system = TracedSystem(block)
    own = system.CreateDefaultContext()
    random = np.random.default_rng(0)
    for _ in range(3):
        rate = loop.diagram.EvalTimeDerivatives(context).CopyToVector()
        found = system.EvalTimeDerivatives(own).CopyToVector()
        assert_allclose(found, rate, rtol=0, atol=1e-10 * (1.0 + np.abs(rate).max()))
        for n, port in outputs.items():
            value = port.Eval(context)
            tolerance = 1e-10 * (1.0 + np.abs(value).max(initial=0.0))
            assert_allclose(system.GetOutputPort(n).Eval(own), value, rtol=0, atol=tolerance)
        guess = loop.plant.state(loop.plant.GetMyContextFromRoot(context))
        guess = guess + 1e-3 * random.normal(size=guess.size) * loop.plant.dae.scale
        loop.plant.set_consistent_state(loop.plant.GetMyMutableContextFromRoot(context), guess)
        own.SetContinuousState(context.get_continuous_state_vector().CopyToVector())


def test_a_block_has_no_run_state():
    """Contexts of one system do not share anything: two runs in turns are as one alone."""
    system = TracedSystem(pendulum())
    alone = Simulator(system)
    alone.AdvanceTo(1.0)
    turns = [Simulator(system), Simulator(system)]
    for end in (0.3, 0.7, 1.0):
        for simulator in turns:
            simulator.AdvanceTo(end)
    wanted = alone.get_context().get_continuous_state_vector().value()
    for simulator in turns:
        found = simulator.get_context().get_continuous_state_vector().value()
        assert_allclose(found, wanted, atol=1e-5)  # Other steps, at an accuracy of 1e-4.
    assert_array_equal(*(s.get_context().get_discrete_state(0).value() for s in turns))
