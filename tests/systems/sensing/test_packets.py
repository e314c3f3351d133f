"""Measurements that are late or lost, against maps written by hand, and rollouts."""

from statistics import NormalDist

import numpy as np
import pytest
from arms import error_controlled, fixed_step
from numpy.testing import assert_allclose
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.primitives import RandomSource
from runs import run
from test_link import integrator

from drake_dae import (
    ConstantReference,
    DaePlant,
    LoopSettings,
    Packets,
    Sampling,
    TrackingLaw,
    export_controller,
    make_closed_loop,
    poles,
    rollout,
    start_values,
)
from drake_dae.diagrams.state_feedback import packet_seed
from drake_dae.errors import ModelError, SimulationError

K, T = 3.0, 0.05
LOSSY = {
    "late": Packets(late=0.4),
    "lost": Packets(loss=0.3),
    "bursts": Packets(loss=0.15, burst=3),
    "both": Packets(late=0.3, loss=0.15, burst=2),
}


def started(packets, seed=0):
    """The loop of x' = u behind u = -K x, from x = 1."""
    system = integrator()
    settings = LoopSettings(sampling=Sampling(T, measurements=packets))
    law = TrackingLaw(system, poles(-K))
    loop = make_closed_loop(DaePlant(system), law, [ConstantReference(0.0)], settings)
    context = loop.diagram.CreateDefaultContext()
    loop.packets.set_seed(context, seed)
    return loop, context


def drawn(seed, count):
    """The random numbers at k T of a source that draws anew at each k T, after that instant."""
    source = RandomSource(RandomDistribution.kGaussian, 2, T)
    context, values = source.CreateDefaultContext(), []
    source.SetRandomContext(context, RandomGenerator(packet_seed(seed)))
    simulator = Simulator(source, context)
    for k in range(count):
        if k:
            simulator.AdvanceTo(k * T)
        values.append(source.get_output_port().Eval(context).copy())
    return np.array(values)


def by_hand(packets, numbers):
    """x(k T), and the samples since the packet that the law has."""
    lost_below, late_below = (
        NormalDist().inv_cdf(p) if p else -np.inf for p in (packets.loss, packets.late)
    )
    x, to_lose, arrived = 1.0, 0, []
    states, missed = [], []
    for k, (late, loss) in enumerate(numbers):
        states.append(x)
        is_lost = k > 0 and (to_lose > 0 or loss < lost_below)
        if k > 0:
            to_lose = to_lose - 1 if to_lose > 0 else (packets.burst - 1) * (loss < lost_below)
        if not is_lost:
            arrived.append((k + (1 if k > 0 and late < late_below else 0), k))
        newest = max(sample for comes, sample in arrived if comes <= k)
        missed.append(k - newest)
        x -= T * K * states[newest]
    return np.array(states), np.array(missed)


@pytest.mark.parametrize("name", LOSSY)
def test_a_law_uses_the_newest_measurement_that_has_arrived(name):
    """The control is constant between samples, so that only round-off of 60 samples remains."""
    packets, count, seed = LOSSY[name], 60, 3
    loop, context = started(packets, seed)
    record = run(loop, context, count * T, error_controlled(1e-10))
    states, missed = by_hand(packets, drawn(seed, count))
    rows = np.searchsorted(record.time, T * np.arange(count) - 1e-9)
    assert_allclose(record["state"][rows, 0], states, atol=1e-12)
    assert_allclose(record["lost_measurements"][rows, 0], missed)
    assert 5 < np.sum(missed > 0) < 50


@pytest.mark.parametrize("name", LOSSY)
def test_a_rollout_loses_the_same_measurements(name):
    loop, context = started(LOSSY[name])
    start, parameters = start_values(loop, context)
    times, config = np.linspace(0.0, 2.0, 401), fixed_step(0.005)
    seeds = [{"packet_noise": packet_seed(5)}]
    (rolled,) = rollout(loop, start, parameters, times, config=config, seeds=seeds)
    loop.packets.set_seed(context, 5)
    record = run(loop, context, 2.0, config)
    rows = np.searchsorted(record.time, times - 1e-9)
    for signal in ("state", "control", "estimated_state", "lost_measurements"):
        assert_allclose(rolled.record[signal], record[signal][rows], atol=1e-12)


def test_the_law_stops_the_robot_where_too_many_measurements_are_missing():
    """In both ways of running, at the sample that a count by hand gives."""
    packets, seed = Packets(late=0.1, loss=0.2, burst=2, most_lost=5), 3
    loop, context = started(packets, seed)
    _, missed = by_hand(packets, drawn(seed, 600))
    first = int(np.argmax(missed >= 5))
    assert 0 < first < 590
    start, parameters = start_values(loop, context)
    with pytest.raises(SimulationError, match=r"no measurement has arrived for 5 samples") as found:
        run(loop, context, 600 * T, error_controlled(1e-6))
    assert found.value.time == pytest.approx(first * T, abs=1e-9)
    times, seeds = np.linspace(0.0, 600 * T, 601), [{"packet_noise": packet_seed(seed)}]
    (rolled,) = rollout(loop, start, parameters, times, seeds=seeds)
    assert str(rolled.failure) == str(found.value)


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ({"late": 1.0}, "late"),
        ({"loss": -0.1}, "loss"),
        ({"burst": 0}, "burst"),
        ({"most_lost": 0}, "most_lost"),
    ],
)
def test_numbers_of_packets_that_make_no_sense_are_refused(numbers, text):
    with pytest.raises(ModelError, match=text):
        Packets(**numbers)


def test_an_exported_controller_is_told_which_measurements_are_new(tmp_path):
    """The law alone is exported: its caller measures, and has the packets."""
    loop, context = started(Packets(loss=0.1))
    files = export_controller(loop, context, "controller", tmp_path)
    header = next(file for file in files if file.suffix == ".h").read_text()
    assert "double estimated_state[1]" in header
    assert "noise" not in header
