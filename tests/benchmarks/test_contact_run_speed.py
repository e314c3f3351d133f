"""A run on Drake's contact beside its plant alone, in the same run; reported, never judged."""

import time

import numpy as np
import pytest
from pydrake.geometry import SceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from runs import scenario
from timing import has_compiler

from drake_dae import build_scenario, simulate
from drake_dae.scenario.build import make_plant
from drake_dae.scenario.model import completed_model, scenario_structure

DURATION, ROUNDS = 4.0, 3
"""The simulated time in s, and how often each is run, in turn."""


def used(run):
    """The processor time of a call, in s: other processes are not in it."""
    began = time.process_time()
    run()
    return time.process_time() - began


def whole(name):
    """A run of a scenario as `simulate` makes it; returns it and its loop, to be called often."""
    machine_code = "compiled=true" if has_compiler() else "compiled=false"
    chosen = scenario(name, f"duration={DURATION}", machine_code)
    loop, start = build_scenario(chosen)

    def run():
        context = start.Clone()
        took = used(lambda: simulate(loop.diagram, context, DURATION, chosen.integrator))
        return took, loop.record(context)

    return run


def plant_alone(name, record):
    """The `ContactPlant` of a scenario in a Simulator, driven by recorded torques."""
    chosen = scenario(name)
    _, model, _ = completed_model(chosen, SceneGraph())
    plant = make_plant(chosen, model, scenario_structure(model))
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    torques = record["control"]
    breaks = plant.time_step * np.arange(len(torques) + 1)
    path = PiecewisePolynomial.ZeroOrderHold(breaks, np.vstack([torques, torques[-1:]]).T)
    source = builder.AddSystem(TrajectorySource(path))
    builder.Connect(source.get_output_port(), plant.GetInputPort("control"))
    diagram = builder.Build()

    def run():
        context = diagram.CreateDefaultContext()
        local = plant.GetMyMutableContextFromRoot(context)
        plant.set_state(local, record["state"][0])
        simulator = Simulator(diagram, context)
        simulator.Initialize()
        took = used(lambda: simulator.AdvanceTo(DURATION))
        np.testing.assert_allclose(plant.state(local), record["state"][-1], atol=1e-6)
        return took

    return run


@pytest.mark.parametrize(
    ("name", "beside", "wanted"),
    [
        ("wall_point_contact", "wall_point_contact", 2.5),
        ("wall_hydroelastic", "wall_hydroelastic", 1.3),
    ],
)
def test_a_run_beside_its_plant(name, beside, wanted, compare):
    ours = whole(name)
    record = ours()[1] if name == beside else whole(beside)()[1]
    theirs = plant_alone(beside, record)
    best = np.min([[ours()[0], theirs()] for _ in range(ROUNDS)], axis=0)
    of_a_millisecond = best / (1e3 * DURATION)
    compare(f"{name}, 1 ms of the run", of_a_millisecond[0], f"plant of {beside} alone",
            of_a_millisecond[1], wanted)  # fmt: skip
