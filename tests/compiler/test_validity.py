"""The validity that compiled functions return, and the initial discrete state of users' blocks."""

import numpy as np
import pytest
from arms import touching
from blocks_of_users import Guarded, Latch
from pydrake.symbolic import Variable
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    Gain,
    Integrator,
    SymbolicVectorSystem,
    ZeroOrderHold,
)

from drake_dae import RobotModel, RobotPlant
from drake_dae.compiler.compile import compile_diagram


@pytest.mark.parametrize("reader", ["row", "rate", "update"])
@pytest.mark.parametrize(("u", "is_valid"), [(0.5, True), (-0.5, False)])
def test_invalid_values_are_reported_by_every_function_that_reads_them(reader, u, is_valid):
    """An output, a derivative or an update, through an adder that reads the value twice."""
    builder = DiagramBuilder()
    guarded, adder = builder.AddSystem(Guarded()), builder.AddSystem(Adder(2, 1))
    for index in range(2):
        builder.Connect(guarded.GetOutputPort("y"), adder.get_input_port(index))
    builder.ExportInput(guarded.GetInputPort("u"), "u")
    block = {"row": Gain(1.0, 1), "rate": Integrator(1), "update": ZeroOrderHold(0.1, 1)}[reader]
    builder.AddSystem(block)
    builder.Connect(adder.get_output_port(), block.get_input_port())
    builder.ExportOutput(block.get_output_port(), "out")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    diagram.get_input_port().FixValue(context, [u])
    compiled = compile_diagram(diagram, context=context)
    arguments = 0.0, *compiled.start(context), compiled.values(context)
    value, valid = {
        "row": lambda: compiled.row(*arguments),
        "rate": lambda: compiled.rate(*arguments),
        "update": lambda: compiled.rates[0].function(*arguments, []),
    }[reader]()
    assert float(value) == 4.0 * u
    assert np.isfinite(float(valid)) == is_valid


@pytest.mark.parametrize(("u", "is_valid"), [(0.5, True), (0.0, False)])
def test_a_non_finite_value_of_a_drake_block_is_invalid(u, is_valid):
    """1 / u at u = 0; Drake's blocks report no validity of their own."""
    u_symbol = Variable("u")
    builder = DiagramBuilder()
    inverse = builder.AddSystem(SymbolicVectorSystem(input=[u_symbol], output=[1 / u_symbol]))
    builder.ExportInput(inverse.get_input_port(), "u")
    builder.ExportOutput(inverse.get_output_port(), "out")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    diagram.get_input_port().FixValue(context, [u])
    compiled = compile_diagram(diagram, context=context)
    _, valid = compiled.row(0.0, *compiled.start(context), compiled.values(context))
    assert np.isfinite(float(valid)) == is_valid


def test_an_initial_discrete_state_may_depend_on_an_input_that_nothing_else_reads():
    builder = DiagramBuilder()
    latch = builder.AddSystem(Latch(0.1))
    zero = builder.AddSystem(ConstantVectorSource([0.0]))
    builder.Connect(zero.get_output_port(), latch.GetInputPort("u"))
    builder.ExportInput(latch.GetInputPort("first"), "first")
    builder.ExportOutput(latch.GetOutputPort("y"), "y")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    diagram.get_input_port().FixValue(context, [7.0])
    compiled = compile_diagram(diagram, context=context)
    state, held = compiled.start(context)
    assert np.isnan(held).all()
    np.testing.assert_array_equal(
        compiled.initialized(0.0, state, held, compiled.values(context)), [7.0]
    )


def test_a_fixed_value_at_the_exogenous_port_sets_the_time_varying_parameters_as_in_drake():
    """A wall that moves through x = 1.1; the default of this parameter is 1.2."""
    model = touching("two_link")
    moving = RobotModel(
        model.links, model.constraints, model.outputs, [1.2, -1.6], exogenous=["wall.position"]
    )
    builder = DiagramBuilder()
    plant = builder.AddSystem(RobotPlant(moving))
    builder.ExportOutput(plant.GetOutputPort("constraint_residual"), "residual")
    builder.ExportOutput(plant.GetOutputPort("constraint_force"), "force")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    size = plant.GetInputPort("exogenous").size()
    places = [sum(degree + 1 for degree in plant.exogenous_layout.degrees[:i]) for i in range(3)]
    exogenous = np.zeros(size)
    exogenous[places[0] : places[0] + 2] = 1.1, 0.3
    plant.GetInputPort("exogenous").FixValue(own, exogenous)
    plant.GetInputPort("control").FixValue(own, [3.0, -4.0])
    plant.set_consistent_state(own, [1.2, -1.6, 0.3, 0.4])
    compiled = compile_diagram(diagram, context=context)
    arguments = 0.0, *compiled.start(context), compiled.values(context)
    expected = diagram.EvalTimeDerivatives(context).CopyToVector()
    np.testing.assert_allclose(compiled.rate(*arguments)[0].full()[:, 0], expected, rtol=1e-11)
    row = compiled.row(*arguments)[0].full()[:, 0]
    force = plant.GetOutputPort("constraint_force").Eval(own)
    np.testing.assert_allclose(row[-1:], force, rtol=1e-11)
    # The state is on the moving wall, to the round-off of metres.
    np.testing.assert_allclose(row[:-1], 0.0, atol=1e-12)
