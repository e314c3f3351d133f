"""What Drake steps beside traced blocks, as forced updates."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from pydrake.geometry import SceneGraph
from pydrake.systems.analysis import Simulator
from runs import scenario

from drake_dae.compiler.drake_steps import DrakeSteps
from drake_dae.scenario.build import make_plant
from drake_dae.scenario.model import completed_model, scenario_structure

PUSH = "plant.disturbances=[{frame: tool, force: [100, 20, 5], start_time: 0.002}]"


def stepped_part(name, *settings):
    """The part of the plant of a scenario that Drake steps, and its context where it touches."""
    chosen = scenario(name, "compiled=false", *settings)
    completed, model, _ = completed_model(chosen, SceneGraph())
    plant = make_plant(completed.scenario, model, scenario_structure(model))
    touching, stepped = plant.CreateDefaultContext(), plant.traced().stepped
    plant.set_state(touching, plant.structure.manifold.project(model.dae.nominal_state))
    context = stepped.system.CreateDefaultContext()
    stepped.put(context, stepped.held(touching))
    return stepped, context


@pytest.mark.slow
@pytest.mark.parametrize("name", ["wall_point_contact", "wall_hydroelastic"])
def test_forced_updates_are_the_steps_of_a_simulator(name):
    """Bit by bit: it is the same update of Drake's plant, at the same time, state and input."""
    stepped, context = stepped_part(name, PUSH)
    port, period = stepped.system.GetInputPort(stepped.into), stepped.period
    begun, count = context.Clone(), 40
    given = 20.0 * np.sin(np.arange(count)[:, None] + np.arange(port.size()))  # N m

    simulator = Simulator(stepped.system, context)
    value = port.FixValue(context, np.zeros(port.size()))
    simulator.Initialize()
    size = sum(stepped.system.GetOutputPort(name).size() for name in stepped.ports)
    expected, found = np.zeros((2, count, size))
    for number, torques in enumerate(given):
        value.GetMutableData().get_mutable_value().SetFromVector(torques)
        simulator.AdvanceTo((number + 1) * period)
        stepped.read(context, expected[number])

    stepped.system.ExecuteInitializationEvents(begun)
    steps = DrakeSteps(stepped, begun)
    for number, torques in enumerate(given):
        steps.step(number * period, torques, found[number])
    assert_array_equal(found, expected)
    assert np.ptp(expected, axis=0).min() > 0.0  # It moves, and the contact force changes.
