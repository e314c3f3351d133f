"""Latches open and close by commands: momentum, energy, refusals."""

import numpy as np
import pytest
from latches import MASSES, carts
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

import drake_dae as dd
from drake_dae.errors import ModelError, SimulationError

LATCHES = ["left_hand", "right_hand"]


class Commands(LeafSystem):
    """Commands of both latches that change at 0.1 s."""

    def __init__(self, before, after):
        super().__init__()
        self._after = after
        self.DeclareStateOutputPort("latch", self.DeclareDiscreteState(before))
        self.DeclarePeriodicDiscreteUpdateEvent(1.0, 0.1, self._change)

    def _change(self, context, state):
        state.get_mutable_vector(0).SetFromVector(self._after)


def ran(before, after, start, seconds=0.2):
    """The plant and its context after a run in which the commands change at 0.1 s."""
    builder = DiagramBuilder()
    plant = builder.AddSystem(dd.UnilateralRobotPlant(carts(), {}, latches=LATCHES))
    commands = builder.AddSystem(Commands(before, after))
    builder.Connect(commands.GetOutputPort("latch"), plant.GetInputPort("latch"))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    context.SetAccuracy(1e-9)
    own = plant.GetMyMutableContextFromRoot(context)
    plant.GetInputPort("control").FixValue(own, np.zeros(2))
    plant.set_state(own, start)
    simulator = Simulator(diagram, context)
    simulator.AdvanceTo(seconds)
    return plant, plant.GetMyContextFromRoot(simulator.get_context())


def test_closing_conserves_momentum_and_loses_the_energy_of_the_relative_motion():
    """Left cart and puck, 3 kg at 1 m/s, couple to 3 kg at rest: 0.5 m/s, and half the energy."""
    m = np.array(list(MASSES.values()))
    before = np.array([1.0, 1.0, 0.0])
    # The right cart is reached at 0.1 s.
    plant, context = ran([1, 0], [1, 1], [0.0, 0.0, 0.1, *before])
    after = plant.state(context)[3:]
    np.testing.assert_allclose(after, m @ before / m.sum(), rtol=1e-12)
    (event,) = plant.events(context)
    assert event.time == pytest.approx(0.1, abs=1e-9)
    assert (event.contacts, event.closed) == (("right_hand",), ("left_hand", "right_hand"))
    assert event.impulses == pytest.approx([1.5], rel=1e-12)  # N s: 3 kg from 0 to 0.5 m/s.
    assert event.energy_lost == pytest.approx(0.75, rel=1e-12)  # J: half of 3 kg (1 m/s)^2 / 2.
    np.testing.assert_allclose(plant.state(context)[:3], 0.15, atol=1e-10)


def test_an_open_latch_exerts_no_force():
    """The left cart and the puck move on together, then by themselves."""
    plant, context = ran([1, 0], [0, 0], [0.0, 0.0, 1.0, 1.0, 1.0, 0.0])
    assert plant.closed(context) == ()
    assert [event.kind for event in plant.events(context)] == [dd.ContactChange.OPENING]
    np.testing.assert_array_equal(plant.GetOutputPort("constraint_force").Eval(context), 0.0)
    np.testing.assert_allclose(plant.state(context), [0.2, 0.2, 1.0, 1.0, 1.0, 0.0], atol=1e-12)


def test_a_latch_that_is_too_far_does_not_close():
    with pytest.raises(SimulationError, match=r"latch 'right_hand' .* is 0\.02 m or rad off"):
        ran([1, 0], [1, 1], [0.0, 0.0, 0.02, 0.0, 0.0, 0.0])


def test_without_a_wire_all_latches_are_closed():
    plant = dd.UnilateralRobotPlant(carts(), {}, latches=LATCHES)
    context = plant.CreateDefaultContext()
    context.SetAccuracy(1e-9)
    plant.GetInputPort("control").FixValue(context, np.array([6.0, 0.0]))
    plant.set_state(context, np.zeros(6))
    simulator = Simulator(plant, context)
    simulator.AdvanceTo(1.0)
    # 6 N on 6 kg.
    after = plant.state(simulator.get_context())
    np.testing.assert_allclose(after[3:], 1.0, rtol=1e-9)


@pytest.mark.parametrize(
    ("latches", "text"),
    [(["hook"], "no constraint 'hook'"), ([], "no opening contacts are given")],
)
def test_latches_that_do_not_exist_are_refused(latches, text):
    with pytest.raises(ModelError, match=text):
        dd.UnilateralRobotPlant(carts(), {}, latches=latches)
