"""Rollouts and exports of diagrams that a user wired by hand, against Drake's Simulator."""

import shutil
import subprocess
from functools import partial

import numpy as np
import pytest
from arms import fixed_step
from blocks_of_users import Counter_, Guarded
from by_hand import OUTPUTS, wired
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    DiscreteDerivative,
    FirstOrderLowPassFilter,
    Gain,
    Integrator,
    LinearSystem,
    LogVectorOutput,
    RandomSource,
    Saturation,
    Sine,
    ZeroOrderHold,
)
from runs import both
from scipy.linalg import expm

from drake_dae import rollout
from drake_dae.errors import ModelError
from drake_dae.running import export_loop, start_values
from drake_dae.running.rollout_program import events_within, program_of

fixed = partial(fixed_step, scheme="runge_kutta3")


@pytest.mark.slow
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
    """The program of the export compares with Drake's Simulator."""
    diagram, context, _ = wired(hold)
    export_loop(diagram, context, "arm", tmp_path, fixed(), 0.2)
    done = subprocess.run(
        ["make", "-s", "-C", str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "played: 200 steps as in Drake" in done.stdout


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
@pytest.mark.parametrize("begin", [0.0, 0.2, 0.43])
def test_updates_begin_at_their_offset(begin, compiled):
    """A counter at 0.3, 0.4, ... s from some start on is that of Drake's Simulator."""
    builder = DiagramBuilder()
    one = builder.AddSystem(ConstantVectorSource([1.0]))
    counter = builder.AddSystem(Counter_[None](0.1, 0.3))
    builder.Connect(one.get_output_port(), counter.get_input_port())
    builder.ExportOutput(counter.get_output_port(), "sum")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    start, parameters = start_values(diagram, context)
    times = np.arange(0.01, 1.0, 0.05)
    times = np.array([begin, *times[times > begin]])
    (found,) = rollout(diagram, start, parameters, times, config=fixed(5e-3), compiled=compiled)
    context.SetTime(begin)
    simulator = Simulator(diagram, context)
    wanted = []
    for time in times[1:]:
        simulator.AdvanceTo(time)
        wanted.append(counter.get_output_port().Eval(counter.GetMyContextFromRoot(context))[0])
    assert wanted[-1] > 3.0
    np.testing.assert_array_equal(found.record["sum"][1:, 0], wanted)


@both
def test_two_sources_of_noise_of_one_run_have_numbers_of_their_own(compiled):
    """And each run those of its seed."""
    builder = DiagramBuilder()
    for name in ("one", "other"):
        noise = builder.AddNamedSystem(name, RandomSource(RandomDistribution.kGaussian, 1, 0.1))
        builder.ExportOutput(noise.get_output_port(), name)
    low = builder.AddSystem(FirstOrderLowPassFilter(0.05, 1))
    builder.Connect(noise.get_output_port(), low.get_input_port())
    builder.ExportOutput(low.get_output_port(), "filtered")
    diagram = builder.Build()
    start, parameters = start_values(diagram, diagram.CreateDefaultContext())
    times = np.arange(10) * 0.1 + 0.05
    seeds = np.array([3, 4, 3])
    found = rollout(
        diagram, [start] * 3, parameters, times, config=fixed(5e-2), compiled=compiled, seeds=seeds
    )
    first, second, again = (
        np.hstack([run.record["one"], run.record["other"]]).ravel().tolist() for run in found
    )
    assert first == again
    assert len({*first, *second}) == len(first) + len(second)


@pytest.mark.parametrize("seed", [None, 5])
@pytest.mark.parametrize("distribution", RandomDistribution.__members__.values())
def test_noise_is_that_of_a_simulator_for_each_distribution(distribution, seed):
    """Equal, from a start between two samples on."""
    builder = DiagramBuilder()
    noise = builder.AddSystem(RandomSource(distribution, 3, 0.1))
    builder.ExportOutput(noise.get_output_port(), "noise")
    diagram = builder.Build()
    context, times = diagram.CreateDefaultContext(), 0.25 + 0.1 * np.arange(30)
    context.SetTime(0.25)
    given = diagram, *start_values(diagram, context), times
    seeds = None if seed is None else [seed]
    (found,) = rollout(*given, config=fixed(5e-2), compiled=False, seeds=seeds)
    if seed is not None:
        noise.SetRandomContext(noise.GetMyContextFromRoot(context), RandomGenerator(seed))
    simulator, wanted = Simulator(diagram, context), []
    for time in times:
        simulator.AdvanceTo(time)
        wanted.append(noise.get_output_port().Eval(noise.GetMyContextFromRoot(context)))
    np.testing.assert_array_equal(found.record["noise"], wanted)


@both
@pytest.mark.parametrize("is_held", [False, True])
@pytest.mark.parametrize("is_fixed", [True, False])
def test_a_run_ends_where_a_block_has_no_value_of_use(is_fixed, is_held, compiled):
    """cos(w t) > 0 up to 0.55 s: a derivative ends there, an update at the sample after it.

    No value is infinite or no number. The step that fails begins 0.02 s before, or less.
    """
    builder = DiagramBuilder()
    source = builder.AddSystem(Sine(1.0, np.pi / 1.1, np.pi / 2.0, 1))
    chain = [Guarded(), *([ZeroOrderHold(0.1, 1)] if is_held else []), Integrator(1)]
    last = source.get_output_port(0)
    for block in chain:
        builder.AddSystem(block)
        builder.Connect(last, block.get_input_port(0))
        last = block.get_output_port(0)
    builder.ExportOutput(last, "sum")
    diagram = builder.Build()
    start, parameters = start_values(diagram, diagram.CreateDefaultContext())
    config = fixed(1e-2)
    config.use_error_control, config.accuracy = not is_fixed, 1e-6
    config.max_step_size = 1e-2
    times = np.linspace(0.0, 1.0, 101)
    (found,) = rollout(diagram, start, parameters, times, config=config, compiled=compiled)
    assert found.failure is not None
    assert found.failure.time == pytest.approx(0.6 if is_held else 0.55, abs=0.02)
    assert np.isfinite(found.record["sum"]).all()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
@pytest.mark.parametrize(
    ("matrix", "begin"),
    [([[8.0]], [1e-3]), ([[-8.0]], [1.0]), ([[0.0, 20.0], [-20.0, 0.0]], [0.0, 1.0])],
    ids=["grows", "decays", "swings"],
)
def test_error_control_takes_the_same_steps_of_what_changes_fast(matrix, begin):
    """With machine code and without; an error is measured by the larger state of a step's ends.

    A step may err by a millionth of the state and of one, which grows as the state.
    """
    n, builder = len(begin), DiagramBuilder()
    system = builder.AddSystem(LinearSystem(np.array(matrix), np.zeros((n, 0)), np.eye(n)))
    builder.ExportOutput(system.get_output_port(), "x")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    context.SetContinuousState(begin)
    start, parameters = start_values(diagram, context)
    config = SimulatorConfig(max_step_size=0.5, accuracy=1e-3)
    one, other = (
        rollout(diagram, start, parameters, [0.0, 2.0], config=config, compiled=compiled)[0]
        for compiled in (False, True)
    )
    assert one.steps == other.steps
    exact = expm(2.0 * np.array(matrix)) @ begin
    for run in (one, other):
        found = run.record["x"][-1]
        np.testing.assert_allclose(found, exact, rtol=0.0, atol=2e-4 * np.abs(exact).max() + 1e-6)


@both
@pytest.mark.parametrize("config", [fixed(0.01), SimulatorConfig()])
def test_a_diagram_without_continuous_state_rolls_out(config, compiled):
    """To 1e-14: a sine, and what it was at the last sample."""
    builder = DiagramBuilder()
    sine = builder.AddSystem(Sine(1.0, 2.0, 0.0, 1))
    hold = builder.AddSystem(ZeroOrderHold(0.03, 1))
    builder.Connect(sine.get_output_port(0), hold.get_input_port())
    builder.ExportOutput(sine.get_output_port(0), "sine")
    builder.ExportOutput(hold.get_output_port(), "held")
    diagram = builder.Build()
    start, parameters = start_values(diagram, diagram.CreateDefaultContext())
    times = [0.0, 0.05, 0.1]
    (found,) = rollout(diagram, start, parameters, times, config=config, compiled=compiled)
    assert found.failure is None
    np.testing.assert_allclose(found.record["sine"][:, 0], np.sin([0, 0.1, 0.2]), atol=1e-14)
    np.testing.assert_allclose(found.record["held"][1:, 0], np.sin([0.06, 0.18]), atol=1e-14)


def test_a_diagram_without_outputs_has_nothing_to_record():
    builder = DiagramBuilder()
    sine = builder.AddSystem(Sine(1.0, 2.0, 0.0, 1))
    gain = builder.AddSystem(Gain(2.0, 1))
    builder.Connect(sine.get_output_port(0), gain.get_input_port())
    diagram = builder.Build()
    with pytest.raises(ModelError, match="export"):
        start_values(diagram, diagram.CreateDefaultContext())


def test_a_diagram_is_compiled_once():
    """To compile one takes many times as long as a short run; another diagram is another."""
    first, other = random_diagram(0)[0], random_diagram(0)[0]
    assert program_of(first) is program_of(first)
    assert program_of(first) is not program_of(other)


def test_updates_at_rows_have_their_times():
    """So no step of 1e-17 s leads from one to the other: 3 * 0.1 is not 0.3."""
    times = np.linspace(0.0, 1.0, 11)
    moments, due = events_within([(0.1, 0.0), (0.25, 0.05)], times)
    assert {*times} <= {*moments}
    # As in Drake, those that differ by round-off follow each other.
    assert due[moments == times[3]].tolist() == [0b10, 0b01]
    assert moments.size == 14
