"""The functions of a block against Drake in the same context: of each block, ours and Drake's."""

from dataclasses import replace

import casadi as ca
import numpy as np
import polishing
import pytest
from actuated import actuated
from arms import arm, law
from blocks_of_users import Counter_
from pydrake.symbolic import Variable, if_then_else, logical_and
from pydrake.systems import primitives as drake
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, PortDataType
from runs import some

import drake_dae as dd
from drake_dae.blocks.block import BlockFunction
from drake_dae.blocks.compose import compose
from drake_dae.dae import with_disturbance
from drake_dae.errors import ModelError
from drake_dae.running.rollout_program import RolloutProgram
from drake_dae.systems import Observing, PointMaterial
from drake_dae.systems.applied_control import ControlHold, ControlLimits, Sampling
from drake_dae.systems.sensors import Encoders, StateSensor


def measured_law(integral, gain=0.5):
    found = arm("two_link")
    gains = dd.poles(-4.0)
    return dd.TrackingLaw(
        found.model.dae,
        gains,
        structure=found.structure,
        measured_force=True,
        force_gain=gain,
        integral=integral,
    )


def references():
    height, force = dd.SinusoidReference(0.3, 0.3, 1.5), dd.SinusoidReference(20.0, 5.0, 2.0)
    return dd.ReferenceGenerator([height, force], law("two_link").degrees)


def robot(kind):
    found = arm("two_link") if kind is None else actuated("two_link", kind)
    return dd.RobotPlant(found.model, structure=found.structure)


def found_friction():
    """The law of the arm on a wall whose friction is found."""
    found = arm("two_link")
    smooth = found.model.constraints[0]
    wall = replace(smooth, friction=0.2, stiction_tolerance=0.1)
    model = dd.RobotModel(found.model.links, [wall], found.model.outputs, [1.2, -1.6])
    names = [signal.name for signal in model.links.velocity_signals]
    dae = with_disturbance(model.dae, names, ["wall.friction"])
    return dd.TrackingLaw(dae, dd.poles(-4.0), measured_force=True)


def estimator(lag, **more):
    rates = Observing(10.0, force_rate=15.0, state_rate=30.0, **more)
    return dd.StateEstimator(
        found_friction(), rates, 0.01, lag, 0.02, lag * 0.01, 1e-3, [1e-2, 0.0]
    )


BLOCKS = {
    "RobotPlant": lambda: robot(None),
    "RobotPlant with springs": lambda: robot("flexible"),
    "RobotPlant with hydraulic servos": lambda: robot("hydraulic"),
    "CompliantPlant": lambda: dd.CompliantPlant(arm("two_link").model, PointMaterial(0.01)),
    "CompliantPlant with springs": lambda: dd.CompliantPlant(
        actuated("two_link", "flexible").model, PointMaterial(0.01, friction=0.3)
    ),
    "ReferenceGenerator": references,
    "TrackingController": lambda: dd.TrackingController(law("two_link")),
    "TrackingController with a sampled integral": lambda: dd.TrackingController(
        measured_law(("tool.z", "wall.force"), 0.0), sample_period=0.01
    ),
    "ControlLimits": lambda: ControlLimits([0.5, 2.0]),
    "TaskController": lambda: dd.TaskController(
        dd.Task([dd.Approach(), dd.Press(20.0), dd.Release()]),
        *polishing.laws(),
        sample_period=0.01,
    ),
    "ControlHold": lambda: ControlHold(2, Sampling(0.01)),
    "ControlHold that acts late": lambda: ControlHold(2, Sampling(0.01, 0.02)),
    "StateEstimator": lambda: estimator(0.5, least_force=1e-3),
    "StateEstimator of a contact that sticks": lambda: estimator(
        0.5, least_speed=1e3, least_force=1e-3
    ),
    "StateSensor": lambda: StateSensor(5, 2, Encoders(resolution=[0.1, 0.0]), 0.01),
    "StateSensor with differences": lambda: StateSensor(
        4, 2, Encoders(resolution=1e-3, velocity_bandwidth=200.0, position_bias=0.1), 0.01
    ),
    "ForceSensor with all of it": lambda: dd.ForceSensor(2, 0.02, 0.01, 0.3, [0.1, 0.2], 0.4),
}


def symbolic_system():
    x, u, t = Variable("x"), Variable("u"), Variable("t")
    inside = logical_and(x > -0.5, x <= 0.5)
    return drake.SymbolicVectorSystem(
        time=t,
        state=[x],
        input=[u],
        dynamics=[if_then_else(inside, u - x, -x)],
        output=[x * u + abs(t - 1.0)],
    )


SYSTEMS = {
    "Gain": lambda: drake.Gain(2.0, 2),
    "Saturation": lambda: drake.Saturation([-0.5, -0.1], [0.3, 0.2]),
    "FirstOrderLowPassFilter": lambda: drake.FirstOrderLowPassFilter(0.2, 2),
    "ZeroOrderHold": lambda: drake.ZeroOrderHold(0.1, 2),
    "Sine": lambda: drake.Sine(1.0, 2.0, 0.3, 2),
    "Adder": lambda: drake.Adder(3, 2),
    "Integrator": lambda: drake.Integrator(2),
    "DiscreteTimeDelay": lambda: drake.DiscreteTimeDelay(0.1, 3, 2),
    "DiscreteDerivative": lambda: drake.DiscreteDerivative(2, 0.1),
    "DiscreteTimeIntegrator": lambda: drake.DiscreteTimeIntegrator(2, 0.1),
    "LinearSystem": lambda: drake.LinearSystem(
        A=[[0, 1.0], [-2.0, -0.3]], B=[[0.0], [1.0]], C=[[1.0, 0.0]], D=[[0.7]]
    ),
    "LinearSystem with a period": lambda: drake.LinearSystem(
        A=np.eye(2) * 0.5, B=np.eye(2), C=np.eye(2), D=np.zeros((2, 2)), time_period=0.1
    ),
    "AffineSystem": lambda: drake.AffineSystem(D=[[2.0, -1.0]], y0=[0.5]),
    "ConstantVectorSource": lambda: drake.ConstantVectorSource([1.0, 2.0]),
    "Multiplexer": lambda: drake.Multiplexer([1, 2]),
    "Demultiplexer": lambda: drake.Demultiplexer(4, 2),
    "PassThrough": lambda: drake.PassThrough(2),
    "MatrixGain": lambda: drake.MatrixGain([[1.0, 2.0], [3.0, 4.0]]),
    "SymbolicVectorSystem": symbolic_system,
    "a diagram of primitives": lambda: drake.StateInterpolatorWithDiscreteDerivative(2, 0.1),
    "a template whose updates begin later": lambda: Counter_[None](0.1, 0.03),
}


def alone(system):
    """A diagram of one system, all ports exported, and a context with random numbers in it.

    An input port has the name "in <index>" there, an output port with vectors "out <index>".
    """
    builder, random = DiagramBuilder(), np.random.default_rng(0)
    builder.AddSystem(system)
    for i in range(system.num_input_ports()):
        if system.get_input_port(i).get_data_type() == PortDataType.kVectorValued:
            builder.ExportInput(system.get_input_port(i), f"in {i}")
    for i in range(system.num_output_ports()):
        if system.get_output_port(i).get_data_type() == PortDataType.kVectorValued:
            builder.ExportOutput(system.get_output_port(i), f"out {i}")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    context.SetTime(0.4)
    for i in range(diagram.num_input_ports()):
        port = diagram.get_input_port(i)
        port.FixValue(context, random.normal(size=port.size()))
    state = context.get_mutable_continuous_state_vector()
    state.SetFromVector(random.normal(size=state.size()))
    discrete = context.get_mutable_discrete_state()
    for i in range(discrete.num_groups()):
        discrete.get_mutable_vector(i).SetFromVector(random.normal(size=discrete.value(i).size))
    return diagram, context


def in_context(name):
    """A block alone, its functions, and a context in which it has values."""
    system = (BLOCKS | SYSTEMS)[name]()
    diagram, context = alone(system)
    own = system.GetMyMutableContextFromRoot(context)
    if isinstance(system, dd.DaePlant):
        system.set_consistent_state(own, system.structure.states[1])
    elif isinstance(system, dd.TrackingController):
        diagram.GetInputPort("in 0").FixValue(context, system.law.structure.states[1])
    return system, diagram, context, compose(diagram, context=context)


def sources(composed, context):
    """Source -> its values in a context, as of `Block.columns`."""
    values = {"time": context.get_time()}
    for kind, places in (("state", composed.states), ("parameters", composed.parameters)):
        own = [system.GetMyContextFromRoot(context) for system in places]
        if kind == "state":
            parts = [each.get_continuous_state_vector().CopyToVector() for each in own]
        else:
            groups = [(c, i) for c in own for i in range(c.num_numeric_parameter_groups())]
            parts = [c.get_numeric_parameter(i).CopyToVector() for c, i in groups]
        values[kind] = np.concatenate([np.zeros(0), *parts])
    for (system, i), (group, _) in composed.held.items():
        own = system.GetMyContextFromRoot(context)
        values[f"held {group}"] = own.get_discrete_state(i).CopyToVector()
    for name, (system, i) in composed.fixed.items():
        own = system.GetMyContextFromRoot(context)
        values[f"input {name}"] = system.get_input_port(i).Eval(own)
    return values


def check_value(composed, value, given, wanted):
    """To 1e-12 of the largest value: other common subexpressions are removed."""
    function = BlockFunction(composed.block, "", {"value": value})
    found = function(*(given[source] for source in function.sources))[0]
    scale = max(1.0, np.abs(wanted).max(initial=0.0))
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-12 * scale)


def check_functions(diagram, context, composed):
    """Outputs and derivative are those of the diagram, to a share of the largest value."""
    given = sources(composed, context)
    for name, value in composed.block.outputs.items():
        check_value(composed, value, given, diagram.GetOutputPort(name).Eval(context))
    if composed.block.state.numel():
        derivative = diagram.EvalTimeDerivatives(context).CopyToVector()
        check_value(composed, composed.block.derivative, given, derivative)


@pytest.mark.parametrize("name", [*some(BLOCKS, of=3, first=1), *SYSTEMS])
def test_outputs_derivatives_and_updates_are_those_of_the_system(name):
    _, diagram, context, composed = in_context(name)
    check_functions(diagram, context, composed)
    for (period, offset, _), groups in composed.block.rates().items():
        if offset:
            context.SetTime(offset + period)
        # The events of this instant, a multiple of the period.
        simulator = Simulator(diagram, context.Clone())
        simulator.Initialize()
        simulator.AdvancePendingEvents()
        after = sources(composed, simulator.get_context())
        for group in groups:
            following = composed.block.held[group].next
            check_value(composed, following, sources(composed, context), after[f"held {group}"])


@pytest.mark.parametrize(
    "name", [*some(BLOCKS, of=3), *(each for each in SYSTEMS if each != "a diagram of primitives")]
)
def test_feedthrough_is_that_of_the_system(name):
    """So an algebraic loop is one for both."""
    system, _, _, composed = in_context(name)
    block = composed.block
    for j, value in enumerate(block.outputs.values()):
        for i in range(system.num_input_ports()):
            symbol = block.inputs.get(f"in {i}")
            if symbol is not None and symbol.numel():
                assert ca.depends_on(value, symbol) <= system.HasDirectFeedthrough(i, j)
                if name in SYSTEMS:
                    assert ca.depends_on(value, symbol) == system.HasDirectFeedthrough(i, j)


def test_a_system_that_cannot_be_traced_is_named():
    builder = DiagramBuilder()
    system = builder.AddNamedSystem("my block", drake.WrapToSystem(1))
    builder.ExportInput(system.get_input_port(0), "in")
    builder.ExportOutput(system.get_output_port(0), "out")
    with pytest.raises(ModelError, match="'my block'"):
        RolloutProgram(builder.Build())
