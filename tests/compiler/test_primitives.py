"""Compiled systems of Drake and of users, compared with Drake in the same context."""

import numpy as np
import pytest
from alone import alone
from blocks_of_users import Counter_
from pydrake.common import RandomDistribution
from pydrake.common.value import Value
from pydrake.math import sin
from pydrake.symbolic import Variable, if_then_else, logical_and
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    BasicVector_,
    DiagramBuilder,
    LeafSystem,
    LeafSystem_,
)
from pydrake.systems.primitives import (
    Adder,
    AffineSystem,
    ConstantVectorSource,
    Demultiplexer,
    DiscreteDerivative,
    DiscreteTimeDelay,
    DiscreteTimeIntegrator,
    FirstOrderLowPassFilter,
    Gain,
    Integrator,
    LinearSystem,
    MatrixGain,
    Multiplexer,
    PassThrough,
    RandomSource,
    Saturation,
    Sine,
    StateInterpolatorWithDiscreteDerivative,
    SymbolicVectorSystem,
    WrapToSystem,
    ZeroOrderHold,
)
from pydrake.systems.scalar_conversion import TemplateSystem

from drake_dae.compiler.compile import compile_diagram
from drake_dae.errors import ModelError


@TemplateSystem.define("Pendulum_")
def Pendulum_(T):
    """A user's system, templated on the scalar type."""

    class Impl(LeafSystem_[T]):
        def _construct(self, length=0.5, converter=None):
            super().__init__(converter)
            self.length = length
            self.DeclareNumericParameter(BasicVector_[T]([9.81]))
            self.DeclareContinuousState(2)
            self.DeclareVectorInputPort("torque", 1)
            self.DeclareVectorOutputPort("angle", 1, self._calc, {self.xc_ticket()})

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, other.length, converter=converter)

        def DoCalcTimeDerivatives(self, context, derivatives):
            angle, rate = context.get_continuous_state_vector().CopyToVector()
            gravity = context.get_numeric_parameter(0)[0]
            torque = self.GetInputPort("torque").Eval(context)[0]
            value = [rate, torque - gravity / self.length * sin(angle)]
            derivatives.get_mutable_vector().SetFromVector(value)

        def _calc(self, context, output):
            output[0] = context.get_continuous_state_vector()[0]

    return Impl


class Poses(LeafSystem):
    """A block whose only output is abstract."""

    def __init__(self):
        super().__init__()
        self.DeclareAbstractOutputPort("poses", lambda: Value([]), lambda context, output: None)


def symbolic_system():
    x, u, t = Variable("x"), Variable("u"), Variable("t")
    inside = logical_and(x > -0.5, x <= 0.5)
    return SymbolicVectorSystem(
        time=t,
        state=[x],
        input=[u],
        dynamics=[if_then_else(inside, u - x, -x)],
        output=[x * u + abs(t - 1.0)],
    )


SYSTEMS = {
    "Gain": lambda: Gain(2.0, 2),
    "Saturation": lambda: Saturation([-0.5, -0.1], [0.3, 0.2]),
    "FirstOrderLowPassFilter": lambda: FirstOrderLowPassFilter(0.2, 2),
    "ZeroOrderHold": lambda: ZeroOrderHold(0.1, 2),
    "Sine": lambda: Sine(1.0, 2.0, 0.3, 2),
    "Adder": lambda: Adder(3, 2),
    "Integrator": lambda: Integrator(2),
    "DiscreteTimeDelay": lambda: DiscreteTimeDelay(0.1, 3, 2),
    "DiscreteDerivative": lambda: DiscreteDerivative(2, 0.1),
    "DiscreteTimeIntegrator": lambda: DiscreteTimeIntegrator(2, 0.1),
    "LinearSystem": lambda: LinearSystem(
        A=[[0, 1.0], [-2.0, -0.3]], B=[[0.0], [1.0]], C=[[1.0, 0.0]], D=[[0.7]]
    ),
    "LinearSystem with a period": lambda: LinearSystem(
        A=np.eye(2) * 0.5, B=np.eye(2), C=np.eye(2), D=np.zeros((2, 2)), time_period=0.1
    ),
    "AffineSystem": lambda: AffineSystem(D=[[2.0, -1.0]], y0=[0.5]),
    "ConstantVectorSource": lambda: ConstantVectorSource([1.0, 2.0]),
    "Multiplexer": lambda: Multiplexer([1, 2]),
    "Demultiplexer": lambda: Demultiplexer(4, 2),
    "PassThrough": lambda: PassThrough(2),
    "MatrixGain": lambda: MatrixGain([[1.0, 2.0], [3.0, 4.0]]),
    "SymbolicVectorSystem": symbolic_system,
    "a diagram of primitives": lambda: StateInterpolatorWithDiscreteDerivative(2, 0.1),
    "a template of the user's": lambda: Pendulum_[None](0.8),
    "a template whose updates begin later": lambda: Counter_[None](0.1, 0.03),
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_compiled_system_has_drakes_outputs_derivatives_and_updates(name):
    """To 1e-14: the operations are the same, possibly in another order."""
    diagram, context = alone(SYSTEMS[name]())
    compiled = compile_diagram(diagram, context=context)
    arguments = context.get_time(), *compiled.start(context), compiled.values(context)
    row, valid = compiled.row(*arguments)
    expected = [diagram.GetOutputPort(output).Eval(context) for output in compiled.outputs]
    np.testing.assert_allclose(row.full()[:, 0], np.concatenate(expected), rtol=1e-14, atol=1e-14)
    assert np.isfinite(float(valid))
    rate = compiled.rate(*arguments)[0].full()[:, 0]
    np.testing.assert_allclose(
        rate, diagram.EvalTimeDerivatives(context).CopyToVector(), rtol=1e-14, atol=1e-14
    )
    if not compiled.rates:
        assert diagram.GetUniquePeriodicDiscreteUpdateAttribute() is None
        return
    (update,) = compiled.rates
    event = diagram.GetUniquePeriodicDiscreteUpdateAttribute()
    assert (update.period, update.offset) == (event.period_sec(), event.offset_sec())
    held = compiled.start(context)[1]
    held[list(update.places)] = update.function(*arguments, [])[0].full()[:, 0]
    next_held = diagram.EvalUniquePeriodicDiscreteUpdate(context)
    groups = [next_held.value(i) for i in range(next_held.num_groups())]
    np.testing.assert_allclose(held, np.concatenate(groups), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("name", [name for name in SYSTEMS if name != "a diagram of primitives"])
def test_feedthrough_is_drakes(name):
    """An output depends on an input in the compiled function as Drake reports it."""
    system = SYSTEMS[name]()
    diagram, context = alone(SYSTEMS[name]())
    compiled = compile_diagram(diagram, context=context)
    depends = np.zeros((compiled.row.numel_out(0), compiled.sizes["parameters"]), dtype=bool)
    depends[tuple(np.array(compiled.row.jac_sparsity(0, 3).get_triplet(), dtype=int))] = True
    columns = {port: part for _, port, part in compiled.fixed}
    first = 0
    for j, signals in enumerate(compiled.signals.values()):
        rows = depends[first : first + len(signals)]
        first += len(signals)
        for i in range(system.num_input_ports()):
            part = columns.get(system.get_input_port(i).get_name(), slice(0, 0))
            assert rows[:, part].any() == system.HasDirectFeedthrough(i, j)


def test_a_system_that_cannot_be_traced_is_named():
    builder = DiagramBuilder()
    system = builder.AddNamedSystem("my block", WrapToSystem(1))
    builder.ExportInput(system.get_input_port(0), "in")
    builder.ExportOutput(system.get_output_port(0), "out")
    with pytest.raises(ModelError, match="'my block'"):
        compile_diagram(builder.Build())


def test_an_input_without_connection_or_value_is_named():
    builder = DiagramBuilder()
    gain = builder.AddNamedSystem("my gain", Gain(0.5, 2))
    builder.ExportInput(gain.get_input_port(), "in")
    builder.ExportOutput(gain.get_output_port(), "out")
    diagram = builder.Build()
    with pytest.raises(ModelError, match="'u0' of 'my gain'"):
        compile_diagram(diagram)
    context = diagram.CreateDefaultContext()
    diagram.get_input_port().FixValue(context, [1.0, -2.0])
    compiled = compile_diagram(diagram, context=context)
    np.testing.assert_array_equal(compiled.values(context), [1.0, -2.0])
    with pytest.raises(ModelError, match="my gain"):
        compiled.values(diagram.CreateDefaultContext())


def test_only_systems_behind_the_named_outputs_are_compiled():
    builder = DiagramBuilder()
    sine = builder.AddSystem(Sine(1.0, 2.0, 0.0, 1))
    low = builder.AddSystem(FirstOrderLowPassFilter(0.1, 1))
    wrap = builder.AddSystem(WrapToSystem(1))
    for reader in (low, wrap):
        builder.Connect(sine.get_output_port(0), reader.get_input_port())
    builder.ExportOutput(sine.get_output_port(0), "sine")
    builder.ExportOutput(low.get_output_port(), "filtered")
    builder.ExportOutput(wrap.get_output_port(), "wrapped")
    diagram = builder.Build()
    assert compile_diagram(diagram, ["sine"]).sizes["state"] == 0
    assert compile_diagram(diagram, ["sine", "filtered"]).sizes["state"] == 1
    with pytest.raises(ModelError, match="WrapToSystem"):
        compile_diagram(diagram)
    with pytest.raises(ModelError, match="angle"):
        compile_diagram(diagram, ["angle"])


def test_without_names_all_vector_valued_outputs_are_compiled():
    """Those with abstract values, such as poses of bodies, are left out."""
    builder = DiagramBuilder()
    sine, poses = builder.AddSystem(Sine(1.0, 2.0, 0.0, 1)), builder.AddSystem(Poses())
    builder.ExportOutput(sine.get_output_port(0), "sine")
    builder.ExportOutput(poses.get_output_port(), "poses")
    assert compile_diagram(builder.Build()).outputs == ("sine",)


def test_random_numbers_are_drawn_at_their_period():
    source = RandomSource(RandomDistribution.kGaussian, 2, 0.013)
    builder = DiagramBuilder()
    builder.AddSystem(source)
    builder.ExportOutput(source.get_output_port(), "noise")
    compiled = compile_diagram(builder.Build())
    (rate,) = compiled.rates
    assert rate.period == 0.013
    assert rate.is_unrestricted
    assert compiled.sizes["noise"] == 2


@pytest.mark.slow
def test_a_compiled_multirate_loop_moves_as_in_the_simulator():
    """To 1e-10: both integrate to about 1e-12, by different methods."""
    builder = DiagramBuilder()
    source, adder = builder.AddSystem(Sine(1.0, 2.0, 0.3, 1)), builder.AddSystem(Adder(2, 1))
    back, limits = builder.AddSystem(Gain(-1.5, 1)), builder.AddSystem(Saturation([-0.8], [0.8]))
    hold = builder.AddSystem(ZeroOrderHold(0.1, 1))
    plant = builder.AddSystem(SYSTEMS["LinearSystem"]())
    low = builder.AddSystem(FirstOrderLowPassFilter(0.2, 1))
    builder.Connect(source.get_output_port(0), adder.get_input_port(0))
    builder.Connect(back.get_output_port(), adder.get_input_port(1))
    builder.Connect(adder.get_output_port(), limits.get_input_port())
    builder.Connect(limits.get_output_port(), hold.get_input_port())
    builder.Connect(hold.get_output_port(), plant.get_input_port())
    builder.Connect(plant.get_output_port(), low.get_input_port())
    builder.Connect(low.get_output_port(), back.get_input_port())
    builder.ExportOutput(low.get_output_port(), "filtered")
    diagram = builder.Build()
    compiled = compile_diagram(diagram)
    state, held = compiled.start(diagram.CreateDefaultContext())
    (update,) = compiled.rates
    step = 1e-3

    def rate(time, x):
        return compiled.rate(time, x, held, [])[0].full()[:, 0]

    for k in range(2000):
        time = k * step
        if k % 100 == 0:
            held = update.function(time, state, held, [], [])[0].full()[:, 0]
        k1 = rate(time, state)
        k2 = rate(time + step / 2, state + step / 2 * k1)
        k3 = rate(time + step / 2, state + step / 2 * k2)
        k4 = rate(time + step, state + step * k3)
        state = state + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    simulator = Simulator(diagram)
    simulator.get_mutable_integrator().set_target_accuracy(1e-12)
    simulator.AdvanceTo(2.0)
    np.testing.assert_allclose(state, compiled.start(simulator.get_context())[0], atol=1e-10)


@pytest.mark.parametrize("depth", [1, 2])
def test_an_input_of_a_nested_diagram_reaches_all_blocks_connected_to_it(depth):
    source = Sine(1.0, 2.0, 0.3, 1)
    inner = DiagramBuilder()
    gains = [inner.AddSystem(Gain(factor, 1)) for factor in (2.0, -3.0, 5.0)]
    inner.ExportInput(gains[0].get_input_port(), "in")
    for number, gain in enumerate(gains):
        if number:
            inner.ConnectInput("in", gain.get_input_port())
        inner.ExportOutput(gain.get_output_port(), f"out {number}")
    block = inner.Build()
    for level in range(depth):
        builder = DiagramBuilder()
        builder.AddSystem(block)
        if level == depth - 1:
            builder.Connect(builder.AddSystem(source).get_output_port(0), block.get_input_port())
        else:
            builder.ExportInput(block.get_input_port(), "in")
        for number in range(3):
            builder.ExportOutput(block.GetOutputPort(f"out {number}"), f"out {number}")
        block = builder.Build()
    compiled = compile_diagram(block)
    assert compiled.fixed == ()
    values = compiled.values(block.CreateDefaultContext())
    row, _ = compiled.row(0.7, [], [], values)
    np.testing.assert_allclose(row.full()[:, 0], np.array([2.0, -3.0, 5.0]) * np.sin(1.7))
