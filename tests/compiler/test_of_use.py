"""Whether values are of use, and what blocks of users hold at the start, through a diagram."""

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


@pytest.mark.parametrize("leads_to", ["row", "rate", "update"])
@pytest.mark.parametrize(("u", "is_of_use"), [(0.5, True), (-0.5, False)])
def test_useless_values_are_reported_wherever_they_lead(leads_to, u, is_of_use):
    """To an output, a derivative or an update, through a block that takes it twice."""
    builder = DiagramBuilder()
    guarded, adder = builder.AddSystem(Guarded()), builder.AddSystem(Adder(2, 1))
    for index in range(2):
        builder.Connect(guarded.GetOutputPort("y"), adder.get_input_port(index))
    builder.ExportInput(guarded.GetInputPort("u"), "u")
    block = {"row": Gain(1.0, 1), "rate": Integrator(1), "update": ZeroOrderHold(0.1, 1)}[leads_to]
    builder.AddSystem(block)
    builder.Connect(adder.get_output_port(), block.get_input_port())
    builder.ExportOutput(block.get_output_port(), "out")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    diagram.get_input_port().FixValue(context, [u])
    compiled = compile_diagram(diagram, context=context)
    given = 0.0, *compiled.start(context), compiled.values(context)
    value, valid = {
        "row": lambda: compiled.row(*given),
        "rate": lambda: compiled.rate(*given),
        "update": lambda: compiled.rates[0].function(*given, []),
    }[leads_to]()
    assert float(value) == 4.0 * u
    assert np.isfinite(float(valid)) == is_of_use


@pytest.mark.parametrize(("u", "is_of_use"), [(0.5, True), (0.0, False)])
def test_a_value_of_drakes_blocks_that_is_not_finite_is_of_no_use(u, is_of_use):
    """Such a block cannot say so itself: 1 / u, at u = 0."""
    given = Variable("u")
    builder = DiagramBuilder()
    inverse = builder.AddSystem(SymbolicVectorSystem(input=[given], output=[1 / given]))
    builder.ExportInput(inverse.get_input_port(), "u")
    builder.ExportOutput(inverse.get_output_port(), "out")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    diagram.get_input_port().FixValue(context, [u])
    compiled = compile_diagram(diagram, context=context)
    _, valid = compiled.row(0.0, *compiled.start(context), compiled.values(context))
    assert np.isfinite(float(valid)) == is_of_use


def test_what_a_block_holds_at_the_start_may_follow_from_what_nothing_else_reads():
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
    np.testing.assert_array_equal(compiled.initialized(0.0, state, held, compiled.values(context)), [7.0])


def test_parameters_that_move_by_a_value_that_is_fixed_are_those_of_drake():
    """A wall at x = 1.1 that moves, where the default of the parameter is 1.2."""
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
    given = 0.0, *compiled.start(context), compiled.values(context)
    wanted = diagram.EvalTimeDerivatives(context).CopyToVector()
    np.testing.assert_allclose(compiled.rate(*given)[0].full()[:, 0], wanted, rtol=1e-11)
    row = compiled.row(*given)[0].full()[:, 0]
    force = plant.GetOutputPort("constraint_force").Eval(own)
    np.testing.assert_allclose(row[-1:], force, rtol=1e-11)
    # On the wall where it is, to the round-off of metres.
    np.testing.assert_allclose(row[:-1], 0.0, atol=1e-12)
