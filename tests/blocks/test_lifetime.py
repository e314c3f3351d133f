"""Python frees what a closed loop was made of when nobody needs the loop any more."""

import gc
from collections.abc import Callable
from weakref import ref

import arms
import numpy as np
import polishing
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from runs import scenario, some

import drake_dae as dd
from drake_dae.running import merged_run
from drake_dae.systems.references import ReferenceGenerator


def plant() -> dd.RobotPlant:
    arm = arms.arm("two_link")
    return dd.RobotPlant(arm.model, structure=arm.structure)


def loop() -> dd.ClosedLoop:
    return dd.make_closed_loop(plant(), arms.law("two_link"), [dd.ConstantReference([0.3, 15.0])])


SYSTEMS = {
    "plant": plant,
    "controller": lambda: dd.TrackingController(arms.law("two_link")),
    "task": lambda: dd.TaskController(
        dd.Task([dd.Approach()]), *polishing.laws(), sample_period=polishing.PERIOD
    ),
    "references": lambda: ReferenceGenerator([dd.ConstantReference([0.3, 15.0])], (2, 0)),
    "sensor": lambda: dd.ForceSensor(1, 0.01, 0.001, noise_deviation=0.1),
    "converted": lambda: plant().ToAutoDiffXd(),
}


@pytest.mark.slow
@pytest.mark.parametrize("make", some(SYSTEMS.values(), of=3), ids=SYSTEMS)
def test_a_system_is_freed_after_it_was_part_of_a_diagram(make: Callable[[], LeafSystem]):
    system = make()
    last = ref(system)
    if isinstance(system, LeafSystem):
        builder = DiagramBuilder()
        builder.AddSystem(system)
        diagram = builder.Build()
        context = diagram.CreateDefaultContext()
        diagram.GetSubsystemContext(system, context)
        del builder, diagram, context
    del system
    gc.collect()
    assert last() is None


@pytest.mark.slow
def test_a_loop_on_drakes_contact_is_freed_after_it_ran_with_one_call_a_sample(monkeypatch):
    monkeypatch.setattr(merged_run, "WORTH", 1)  # Short runs, too.
    chosen = scenario("wall_point_contact", "compiled=false")
    made, context = dd.build_scenario(chosen)
    dd.simulate(made.diagram, context, 0.01, chosen.integrator)
    made.record(context)
    lasts = [ref(each) for each in (made, made.diagram, made.log, made.plant, made.plant.model)]
    del made, context
    gc.collect()
    assert [last() for last in lasts] == [None] * 5


def test_a_drawn_scenario_is_freed_with_its_model_and_its_geometry():
    meshcat = dd.start_meshcat()
    made, context = dd.build_scenario(scenario("two_link_wall"), meshcat)
    dd.simulate(made.diagram, context, 0.02, arms.fixed_step())
    links = made.plant.model.links
    forces = made.diagram.GetSubsystemByName("constraint_force_visualizer")
    lasts = [ref(each) for each in (made.plant, forces, made.plant.model, links.plant)]
    del made, context, links, forces
    gc.collect()
    assert [last() for last in lasts] == [None] * 4


def test_a_loop_lives_as_long_as_its_simulator():
    made = loop()
    context = made.diagram.CreateDefaultContext()
    simulator = Simulator(made.diagram, context)
    size = made.plant.dae.num_states
    del made, context
    gc.collect()
    simulator.AdvanceTo(0.02)
    state = simulator.get_context().get_continuous_state_vector().CopyToVector()
    assert state.shape == (size,)
    assert np.all(np.isfinite(state))
