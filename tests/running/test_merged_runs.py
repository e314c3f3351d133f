"""Runs of a diagram whose traced blocks are composed to one, beside the diagram as wired."""

from copy import deepcopy
from functools import cache

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from runs import close_records, first_quick, scenario, some

from drake_dae import DaePlant, DaeSystem, build_scenario, simulate
from drake_dae.running import merged_run
from drake_dae.running import simulate as simulation
from drake_dae.running.merged_run import MergedRun

NOISE = "sensors.force={sample_period: 0.001, noise_deviation: 0.1, seed: 7}"

FIXED = ("integrator.use_error_control=false", "integrator.max_step_size=0.001")

LOOPS = {
    "observer and integrals": ("wall_point_contact",),
    "hydroelastic contact": ("wall_hydroelastic",),
    "noise": ("wall_point_contact", NOISE),
    "a control that is late": ("wall_point_contact", "sampling={period: 2.0e-3, delay: 3.0e-3}"),
    "a start between two samples": ("wall_point_contact", "integrator.start_time=0.0104"),
    "springs on a contact that gives way": ("wall_flexible_contact",),
    "ideal contact": ("seven_joint_wall", *FIXED),
    "a mechanism with springs": ("slider_crank_flexible", *FIXED),
}

DEAR = ("hydroelastic contact", "noise", "a start between two samples")
"""What has no other rates than the others."""


@pytest.fixture
def short_runs(monkeypatch):
    """Short runs are computed in this way, too."""
    monkeypatch.setattr(merged_run, "WORTH", 1)


@cache
def loop_of(name):
    robot, *settings = LOOPS[name]
    chosen = scenario(robot, *settings)
    return chosen, *build_scenario(chosen)


def built(name):
    chosen, loop, context = loop_of(name)
    return chosen, loop, context.Clone()


def block_by_block(config):
    """Settings for each step by itself: at a rate that no run reaches."""
    own = deepcopy(config)
    own.target_realtime_rate = 1e6
    return own


def logs(loop, context):
    """Name of a logged signal -> times and values."""
    log = loop.log.FindLog(context)
    stops = np.cumsum([len(signals) for signals in loop.signals.values()])
    columns = np.split(log.data().copy(), stops[:-1])
    return {
        name: (log.sample_times().copy(), values)
        for name, values in zip(loop.signals, columns, strict=True)
    }


def states(context):
    groups = range(context.num_discrete_state_groups())
    held = [context.get_discrete_state(i).value() for i in groups]
    return np.concatenate([context.get_continuous_state_vector().CopyToVector(), *held])


@pytest.mark.slow
@pytest.mark.parametrize("name", some(first_quick(LOOPS), dear=DEAR))
def test_logs_and_context_are_those_of_drakes_simulator(name, short_runs):
    """75 samples, no multiple of those after which the context is set.

    Only round-off differs, and contact multiplies it: by 1e5 N/m, and by some 10 in 75 steps.
    """
    duration = 0.075
    chosen, loop, context = built(name)
    expected = context.Clone()
    simulator = Simulator(loop.diagram, expected)
    ApplySimulatorConfig(chosen.integrator, simulator)
    simulator.Initialize()
    end = expected.get_time() + duration
    simulator.AdvanceTo(end)
    steps = simulator.get_num_steps_taken()
    simulator.AdvancePendingEvents()

    seen = []
    statistics = simulate(
        loop.diagram, context, duration, chosen.integrator, look=lambda c: seen.append(c.get_time())
    )
    # Called once for many samples, so that these were not made by Drake's Simulator.
    assert 3 <= len(seen) <= 6
    assert statistics.steps == steps
    assert context.get_time() == end
    found, right = states(context), states(expected)
    assert_allclose(found, right, rtol=0, atol=1e-9 * np.abs(right).max())
    pairs = zip(logs(loop, context).items(), logs(loop, expected).values(), strict=True)
    for (signal_name, (times, data)), (right_times, right_data) in pairs:
        assert_array_equal(times, right_times, err_msg=signal_name)
        size = np.abs(right_data).max(initial=1e-6)
        assert_allclose(data, right_data, rtol=0, atol=1e-9 * size, err_msg=signal_name)


@pytest.mark.slow
def test_a_run_that_goes_on_is_that_of_drakes_simulator(short_runs):
    """All states of Drake's plant and of the source of noise are in the context in between."""
    chosen, loop, context = built("noise")
    chosen, expected = deepcopy(chosen), context.Clone()
    for start in (0.0, 0.04):
        chosen.integrator.start_time = start
        simulate(loop.diagram, context, 0.04, chosen.integrator)
        simulate(loop.diagram, expected, 0.04, block_by_block(chosen.integrator))
    found, right = loop.record(context), loop.record(expected)
    assert_array_equal(found.time, right.time)
    close_records(found, right, 1e-9, least=1e-6)


def test_a_fixed_value_at_a_connected_port_counts(short_runs):
    """Drake lets it replace the connection; so the blocks run one by one."""
    chosen, loop, context = built("observer and integrals")
    Simulator(loop.diagram, context).Initialize()
    given = chosen.integrator, 0.01
    assert MergedRun.of(loop.diagram, context.Clone(), *given) is not None
    port = loop.plant.GetInputPort("control")
    port.FixValue(loop.plant.GetMyMutableContextFromRoot(context), np.zeros(7))
    simulate(loop.diagram, context, 0.01, chosen.integrator)
    assert MergedRun.of(loop.diagram, context, *given) is None


def test_a_trial_out_of_the_domain_does_not_end_it(short_runs):
    """x' = 1000 (1 - x^2 sqrt(x)): long steps try an x without a root, and are made shorter."""
    functions = {"f": lambda x: 1000.0 - 1000.0 * x**2 * ca.sqrt(x), "h": lambda x: 1}
    root = DaeSystem.from_functions(1, l=lambda x: x, nominal_state=[2.0], name="root", **functions)
    builder = DiagramBuilder()
    plant = builder.AddSystem(DaePlant(root))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    plant.GetInputPort("control").FixValue(own, [0.0])
    looks = []
    config = SimulatorConfig(max_step_size=0.1, accuracy=1e-9)
    run = simulate(diagram, context, 0.3, config, look=lambda now: looks.append(now.get_time()))
    assert_allclose(plant.state(own), [1.0], rtol=1e-6)
    assert len(looks) < run.steps / 16


def test_drake_goes_on_from_samples_that_fail(short_runs, monkeypatch):
    """So a failure is that of Drake's Simulator; here it finds a step after all."""
    chosen, loop, context = built("observer and integrals")

    class Failing(MergedRun):
        def write_back(self, count):
            if self._own.get_time() > 0.0445:
                raise RuntimeError("no convergence.")
            super().write_back(count)

    monkeypatch.setattr(simulation, "MergedRun", Failing)
    expected, seen = context.Clone(), []
    statistics = simulate(
        loop.diagram, context, 0.06, chosen.integrator, look=lambda now: seen.append(now.get_time())
    )
    simulate(loop.diagram, expected, 0.06, block_by_block(chosen.integrator))
    assert statistics.steps == 60
    assert seen[0] == pytest.approx(0.032)
    found, right = loop.record(context), loop.record(expected)
    assert_array_equal(found.time, right.time)
    assert_allclose(found["state"], right["state"], rtol=0, atol=1e-9)
