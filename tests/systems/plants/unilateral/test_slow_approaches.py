"""Contacts that close so slowly that steps of the search move positions by less than round-off."""

import re

import numpy as np
import pytest
from falling import ball_model, mass_point, simulator_of
from numpy.testing import assert_allclose
from pegs import peg_of, upright_peg
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder, EventStatus

from drake_dae import (
    ConstantReference,
    Plate,
    ReferenceGenerator,
    SinusoidReference,
    UnilateralRobotPlant,
    rollout,
    start_values,
)
from drake_dae.errors import SimulationError
from drake_dae.systems.plants.contact_events import ContactChange

CLEARANCE = 1e-4
STEPS = 200
"""Without an end of the search a run makes 1000 steps in some microseconds."""


def fixed(step):
    return SimulatorConfig(
        integration_scheme="runge_kutta5",
        max_step_size=step,
        use_error_control=False,
        accuracy=1e-9,
    )


def alone(plant, state):
    """A plant without controls in a diagram, the values of a start, and of the parameters."""
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    for name in ("state", *plant.further_signals, "constraint_force"):
        builder.ExportOutput(plant.GetOutputPort(name), name)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant.set_state(plant.GetMyMutableContextFromRoot(context), state)
    return diagram, *start_values(diagram, context)


def counted(simulator):
    """Ends a run, at a time that is not the wanted one, after `STEPS` steps."""
    left = iter(range(STEPS))

    def monitor(context):
        if next(left, None) is None:
            return EventStatus.ReachedTermination(simulator.get_system(), "too many steps")
        return EventStatus.DidNothing()

    simulator.set_monitor(monitor)
    return simulator


@pytest.mark.slow
def test_a_peg_that_starts_without_force_is_pushed_by_a_hole_that_moves():
    """The plate is at A sin(w t) and the peg has its speed: it needs M A w^2 sin(w t), 0 first.

    Open, it would be A (w t)^3 / 6 inside after t: within the round-off of positions for 1e-6 s.
    """
    plant = UnilateralRobotPlant(
        upright_peg(exogenous=["wall.position"]), {"wall": 0.0}, pegs=[peg_of(CLEARANCE)]
    )
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    moved = [SinusoidReference(0.0, 0.01, 5.0), ConstantReference([0.0, 0.0])]
    table = builder.AddSystem(ReferenceGenerator(moved, plant.exogenous_layout.degrees))
    builder.Connect(table.get_output_port(), plant.GetInputPort("exogenous"))
    for name in ("state", *plant.further_signals, "constraint_force"):
        builder.ExportOutput(plant.GetOutputPort(name), name)
    simulator = counted(Simulator(builder.Build()))
    ResetIntegratorFromFlags(simulator, "runge_kutta5", 0.01)
    simulator.get_mutable_integrator().set_fixed_step_mode(True)
    root = simulator.get_mutable_context()
    context = plant.GetMyMutableContextFromRoot(root)
    plant.set_state(context, [CLEARANCE, 0.0, -5e-3, 0.05, 0.0, 0.0])
    root.SetAccuracy(1e-9)
    begun = start_values(simulator.get_system(), root)
    simulator.AdvanceTo(0.2)
    assert root.get_time() == 0.2
    (found,) = rollout(
        simulator.get_system(), *begun, [0.0, 0.2], config=fixed(0.01), compiled=False
    )
    at = 0.01 * np.sin(5.0 * 0.2)
    for own in (context, plant.GetMyContextFromRoot(found.context)):
        (event,) = plant.events(own)
        assert event.kind is ContactChange.CLOSING
        # Open, it would be 2e-16 m inside by then: the round-off of a position of 1 m.
        assert event.time < 1e-5
        # The steps of 0.01 s are off by (w h)^6 = 2e-8 of the motion, and it is projected.
        assert_allclose(plant.state(own)[0], CLEARANCE + at, atol=1e-11)
    force = plant.GetOutputPort("hole_force").Eval(context).sum()
    assert_allclose(force, 2.0 * 25.0 * at, rtol=1e-9)
    assert_allclose(found.record["hole_force"][-1].sum(), force, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [1e-5, 1e-6, 1e-8])
def test_a_peg_that_drifts_to_the_side_of_its_hole_arrives_in_time(speed):
    """Without gravity and at a constant speed, from where it needs 2 ms; and so in a rollout."""
    plant = UnilateralRobotPlant(upright_peg(), {"wall": 1.0}, pegs=[peg_of(CLEARANCE)])
    start = np.array([CLEARANCE - 2e-3 * speed, 0.0, -5e-3, speed, 0.0, 0.0])
    simulator, context = simulator_of(plant, start, 1e-3, 1e-9)
    counted(simulator).AdvanceTo(0.004)
    assert context.get_time() == 0.004
    (found,) = rollout(*alone(plant, start), [0.0, 0.004], config=fixed(1e-3), compiled=False)
    assert found.failure is None
    for own in (context, plant.GetMyContextFromRoot(found.context)):
        (event,) = plant.events(own)
        assert event.contacts == ("wall.side",)
        # Positions of 5e-3 m, such as the radius of the hole, have a round-off of 9e-19 m.
        assert_allclose(event.time, 2e-3, rtol=0.0, atol=1e-11 + 2e-18 / speed)
        assert_allclose(event.impulses, 2.0 * 2.0 * speed, rtol=1e-9)
    for state in (plant.state(context), found.record["state"][-1]):
        assert_allclose(state[0], start[0], rtol=0.0, atol=1e-17)
        assert_allclose(state[3], -speed, rtol=1e-12)


@pytest.mark.parametrize("speed", [1e-6, 1e-8])
def test_a_point_that_creeps_over_an_edge_falls(speed):
    """From where it needs 1 ms to the edge at 0.3 m; a position there has a round-off of 6e-17."""
    plant = mass_point({"floor": Plate((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.3, 0.3))})
    simulator, context = simulator_of(plant, [0.3 - 1e-3 * speed, 0, 0, speed, 0, 0], 1e-3, 1e-9)
    counted(simulator).AdvanceTo(0.1)
    assert context.get_time() == 0.1
    (event,) = plant.events(context)
    assert event.kind is ContactChange.OPENING
    assert_allclose(event.time, 1e-3, rtol=0.0, atol=1e-11 + 2e-16 / speed)


ENDED = r"the last 20 steps led from .* settling_time$"


@pytest.mark.slow
def test_events_that_crowd_end_a_run(monkeypatch):
    """A ball that bounces 600 times within 0.1 microseconds, until it is slower than 1e-11 m/s."""
    monkeypatch.setattr("drake_dae.systems.plants.unilateral.log.CROWD", 20)
    ratio, total = 0.99, 1e-7
    plant = UnilateralRobotPlant(ball_model(), {"floor": ratio}, settling_time=1e-13)
    # Infinitely many bounces take 2 v / (g (1 - e)).
    start = np.array([0.0, total * 9.81 * (1.0 - ratio) / 2.0])
    simulator, context = simulator_of(plant, start, 1e-6, 1e-7)
    with pytest.raises(SimulationError, match=ENDED):
        simulator.AdvanceTo(1e-3)
    assert context.get_time() < 1e-6
    # The events of a rollout, which makes no shorter steps, are counted in the same way.
    (found,) = rollout(*alone(plant, start), [0.0, 1e-3], config=fixed(1e-3), compiled=False)
    assert re.search(ENDED, str(found.failure))
    assert found.failure.time < 1e-6
