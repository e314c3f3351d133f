"""Rollouts and exports of diagrams that a user wired by hand, against Drake's Simulator."""

import shutil
import subprocess

import numpy as np
import pytest
from by_hand import OUTPUTS, wired
from pydrake.common import RandomDistribution
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    Adder,
    DiscreteDerivative,
    FirstOrderLowPassFilter,
    Gain,
    LinearSystem,
    LogVectorOutput,
    RandomSource,
    Saturation,
    Sine,
    WrapToSystem,
    ZeroOrderHold,
)

from drake_dae import export_code, rollout, start_values
from drake_dae.errors import ModelError

with_compiler = pytest.param(
    True, marks=pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
)
both = pytest.mark.parametrize("compiled", [False, with_compiler])


def fixed(step=1e-3):
    return SimulatorConfig(
        integration_scheme="runge_kutta3", max_step_size=step, use_error_control=False
    )


@both
@pytest.mark.parametrize("hold", [0.0, 0.004])
def test_a_loop_wired_by_hand_rolls_out(hold, compiled):
    """To 1e-11 of the largest value: 500 steps, and forces of 20 N that are cancelled."""
    diagram, context, loggers = wired(hold)
    start, parameters = start_values(diagram, context)
    times = np.linspace(0.0, 0.5, 501)
    (found,) = rollout(diagram, start, parameters, times, config=fixed(), compiled=compiled)
    assert found.failure is None
    assert set(found.record.signals) == {*OUTPUTS, "torque"}
    assert [s.name for s in found.record.signals["controlled_output"].signals] == [
        "tool.z",
        "wall.force",
    ]
    simulator = Simulator(diagram, context)
    ApplySimulatorConfig(fixed(), simulator)
    simulator.AdvanceTo(0.5)
    for name, logger in loggers.items():
        wanted = logger.FindLog(context).data().T[:500]
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(found.record[name][:500], wanted, rtol=0.0, atol=1e-11 * scale)


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
@pytest.mark.slow
@pytest.mark.parametrize("hold", [0.0, 0.004])
def test_it_is_exported(hold, tmp_path):
    """The test program compares law, plant, projection, derivative, outputs and updates."""
    diagram, context, _ = wired(hold)
    export_code(diagram, context, "arm", tmp_path)
    done = subprocess.run(
        ["make", "-s", "-C", str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    header = (tmp_path / "arm.h").read_text()
    wanted = ["law", "plant", "project", "loop_rate", "loop_outputs"]
    for name in [*wanted, *(["loop_update_0"] if hold else [])]:
        assert f"int arm_{name}(" in header


def test_an_export_needs_one_plant_and_one_law(tmp_path):
    builder = DiagramBuilder()
    sine = builder.AddSystem(Sine(1.0, 2.0, 0.0, 1))
    builder.ExportOutput(sine.get_output_port(0), "sine")
    diagram = builder.Build()
    with pytest.raises(ModelError, match="this diagram has 0 plants and 0 laws"):
        export_code(diagram, diagram.CreateDefaultContext(), "sine", tmp_path)


def random_diagram(seed):
    """Blocks of Drake's in a ring with feedback and several rates, and a logger of all of them."""
    random, builder = np.random.default_rng(seed), DiagramBuilder()
    kinds = [
        lambda: Gain(random.uniform(-1.5, 1.5), 1),
        lambda: Saturation([-random.uniform(0.2, 1.0)], [random.uniform(0.2, 1.0)]),
        lambda: FirstOrderLowPassFilter(random.uniform(0.05, 0.5), 1),
        lambda: ZeroOrderHold(random.choice([0.01, 0.02, 0.025]), 1),
        lambda: DiscreteDerivative(1, random.choice([0.02, 0.03]), False),
        lambda: LinearSystem(
            A=random.normal(size=(2, 2)) - 2.0 * np.eye(2),
            B=random.normal(size=(2, 1)),
            C=random.normal(size=(1, 2)),
            D=[[0.0]],
        ),
    ]
    chosen = [kinds[i]() for i in random.integers(len(kinds), size=5)]
    chosen.append(LinearSystem(A=[[-1.0]], B=[[1.0]], C=[[1.0]], D=[[0.0]]))
    source, adder = builder.AddSystem(Sine(1.0, 3.0, 0.2, 1)), builder.AddSystem(Adder(2, 1))
    builder.Connect(source.get_output_port(0), adder.get_input_port(0))
    last, loggers = adder.get_output_port(), []
    for number, block in enumerate(chosen):
        builder.AddNamedSystem(f"block {number}", block)
        builder.Connect(last, block.get_input_port())
        last = block.get_output_port()
        builder.ExportOutput(last, f"out {number}")
        loggers.append(LogVectorOutput(last, builder))
    builder.Connect(last, adder.get_input_port(1))
    return builder.Build(), loggers


@pytest.mark.parametrize("seed", range(20))
def test_random_diagrams_roll_out(seed):
    """To 1e-11: fixed steps of the same method, and updates at the same instants."""
    diagram, loggers = random_diagram(seed)
    context = diagram.CreateDefaultContext()
    start, parameters = start_values(diagram, context)
    times = np.linspace(0.0, 0.3, 61)
    (found,) = rollout(diagram, start, parameters, times, config=fixed(5e-3), compiled=False)
    assert found.failure is None
    simulator = Simulator(diagram, context)
    ApplySimulatorConfig(fixed(5e-3), simulator)
    simulator.AdvanceTo(0.3)
    for number, logger in enumerate(loggers):
        log = logger.FindLog(context)
        assert log.num_samples() >= 61
        rows = np.searchsorted(log.sample_times(), times[:-1] - 1e-9)
        np.testing.assert_allclose(
            found.record[f"out {number}"][:-1, 0], log.data()[0, rows], rtol=1e-11, atol=1e-11
        )


@both
def test_noise_and_samples_of_several_rates(compiled):
    """To 1e-12: the numbers of Drake's RandomSource, held and filtered."""
    builder = DiagramBuilder()
    noise = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, 2, 0.01))
    hold = builder.AddSystem(ZeroOrderHold(0.015, 2))
    low = builder.AddSystem(FirstOrderLowPassFilter(0.05, 2))
    builder.Connect(noise.get_output_port(), hold.get_input_port())
    builder.Connect(hold.get_output_port(), low.get_input_port())
    builder.ExportOutput(low.get_output_port(), "filtered")
    log = LogVectorOutput(low.get_output_port(), builder)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    start, parameters = start_values(diagram, context)
    assert start.size == 4
    times = np.linspace(0.0, 0.3, 61)
    (found,) = rollout(diagram, start, parameters, times, config=fixed(5e-3), compiled=compiled)
    simulator = Simulator(diagram, context)
    ApplySimulatorConfig(fixed(5e-3), simulator)
    simulator.AdvanceTo(0.3)
    data = log.FindLog(context)
    rows = np.searchsorted(data.sample_times(), times[:-1] - 1e-9)
    wanted = data.data().T[rows]
    assert np.abs(wanted).max() > 0.1
    np.testing.assert_allclose(found.record["filtered"][:-1], wanted, rtol=0, atol=1e-12)


def test_what_drake_alone_can_run_is_named():
    builder = DiagramBuilder()
    sine = builder.AddSystem(Sine(1.0, 2.0, 0.0, 1))
    wrap = builder.AddNamedSystem("my own block", WrapToSystem(1))
    builder.Connect(sine.get_output_port(0), wrap.get_input_port())
    builder.ExportOutput(wrap.get_output_port(), "wrapped")
    diagram = builder.Build()
    with pytest.raises(ModelError, match=r"'my own block' \(WrapToSystem\) cannot be traced"):
        start_values(diagram, diagram.CreateDefaultContext())
