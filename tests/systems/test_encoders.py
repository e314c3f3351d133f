"""Encoders, against maps written by hand and the noise of rounding."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, RandomSource, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from runs import run_scenario, scenario

from drake_dae import Encoders, build_scenario
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.systems import StateSensor

T, W = 1e-3, 300.0
A = np.exp(-W * T)


def measure(encoders, q, v, duration, seed=0):
    """What one encoder tells of a position q(t), a polynomial by its factors, at the samples."""
    builder = DiagramBuilder()
    polynomials = [np.polynomial.Polynomial(factors) for factors in (q, v)]
    ends = [0.0, duration + T]
    degree = max(len(q), len(v))
    # Hermite data of one piece hold any polynomial of degree 3.
    assert degree <= 4
    course = PiecewisePolynomial.CubicHermite(
        ends,
        np.array([[p(t) for t in ends] for p in polynomials]),
        np.array([[p.deriv()(t) for t in ends] for p in polynomials]),
    )
    source = builder.AddSystem(TrajectorySource(course))
    sensor = builder.AddSystem(StateSensor(2, 1, encoders, T))
    builder.Connect(source.get_output_port(), sensor.GetInputPort("state"))
    if encoders.has_noise:
        noise = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, 2, T))
        builder.Connect(noise.get_output_port(), sensor.GetInputPort("noise"))
    log = LogVectorOutput(sensor.GetOutputPort("estimated_state"), builder, T)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    diagram.SetRandomContext(context, RandomGenerator(seed))
    simulator.AdvanceTo(duration)
    found = log.FindLog(context)
    times = found.sample_times()
    true = np.array([p(times) for p in polynomials])
    return times, found.data(), true


def test_it_is_the_map_by_hand():
    """qm_k is rounded, vm_k = a vm_(k-1) + (1 - a) (qm_k - qm_(k-1)) / T from v_0."""
    delta = 2e-4
    _, found, (q, v) = measure(Encoders(delta, W), [0.1, 0.7, -2.0, 1.0], [0.7, -4.0, 3.0], 0.2)
    rounded = delta * np.round(q / delta)
    by_hand = [v[0]]
    for step in np.diff(rounded):
        by_hand.append(A * by_hand[-1] + (1.0 - A) * step / T)
    assert_allclose(found[0], rounded, atol=1e-15)
    assert_allclose(found[1], by_hand, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("delta", [1e-5, 1e-4])
def test_rounding_is_noise_of_its_deviation(delta):
    """delta / sqrt(12) of positions.

    The motion passes 30 to 70 multiples a sample at a rate that changes. Of 3000 samples a
    deviation is known to 1 / sqrt(6000) = 1.3 %; three of these are allowed.
    """
    speed = 3e4 * delta
    q = [0.0, speed, 0.2 * speed, 0.02 * speed]
    v = [speed, 0.4 * speed, 0.06 * speed]
    encoders = Encoders(delta, W)
    _, found, true = measure(encoders, q, v, 3.0)
    assert_allclose(np.std(found[0] - true[0]), encoders.position_deviation, rtol=0.04)
    assert_allclose(encoders.position_deviation, delta / np.sqrt(12.0))


def test_noise_has_its_deviation_and_its_seed():
    encoders = Encoders(position_noise=5e-6, velocity_noise=1e-3, position_bias=-2e-3)
    first, again, other = (measure(encoders, [0.1], [0.0], 2.0, seed)[1] for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert_allclose(np.mean(first[0]), 0.1 - 2e-3, atol=5 * 5e-6 / np.sqrt(2000))
    # Of 2000 samples to 1.6 %.
    assert_allclose(np.std(first, axis=1), [5e-6, 1e-3], rtol=0.05)


SAMPLED = ("sampling={period: 2.0e-3, delay: 0.0}", "duration=0.1", "law.gains.all=[-10.0]")
ROUGH = "sensors.encoders={resolution: 1.0e-4, velocity_bandwidth: 200.0, position_noise: 1.0e-5}"


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param(SAMPLED, id="ideal"),
        pytest.param(
            (
                "plant=!MultibodyPlant {time_step: 1.0e-3}",
                "sampling={period: 2.0e-3, delay: 1.0e-3}",
                "duration=0.1",
            ),
            id="contact",
        ),
    ],
)
def test_law_reads_what_was_measured_at_its_samples(settings):
    """What acts is the law of the estimated state of that instant, and of no other."""
    loop, _, record = run_scenario(scenario("two_link_wall", ROUGH, *settings))
    law = loop.controller.law
    late = 0 if loop.plant.time_step == 0.0 else 1e-3
    samples = np.searchsorted(record.time, 2e-3 * np.arange(1, 49) - 1e-9)
    wanted = [law.control(record["estimated_state"][k], record["reference"][k]) for k in samples]
    acting = np.searchsorted(record.time, record.time[samples] + late + 5e-4)
    assert_allclose(record["control"][acting], wanted, rtol=1e-12)
    off = np.abs(record["estimated_state"] - record["state"])[samples, :2]
    assert 2e-5 < off.max() < 1e-4


@pytest.mark.parametrize("seed", [0, 7, 2**32 - 1])
def test_encoders_and_force_sensor_of_one_seed_have_noise_of_their_own(seed):
    """Numbers of one generator would make errors of the force and of the positions follow."""
    found = scenario(
        "two_link_wall",
        f"sensors.force={{sample_period: 2.0e-3, noise_deviation: 0.1, seed: {seed}}}",
        f"sensors.encoders={{position_noise: 1.0e-6, velocity_noise: 1.0e-3, seed: {seed}}}",
        *SAMPLED,
    )
    loop, context = build_scenario(found)
    simulator = Simulator(loop.diagram, context)
    felt, measured = [], []
    for k in range(4):
        simulator.AdvanceTo((k + 0.5) * 2.0 * T)
        for source, numbers in ((loop.noise, felt), (loop.encoder_noise, measured)):
            own = source.GetMyContextFromRoot(context)
            numbers.extend(source.get_output_port().Eval(own))
    assert len(set(felt)) == 4
    assert len(set(measured)) == 16
    assert not set(felt) & set(measured)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["sensors.encoders={resolution: -1.0}"], "resolution"),
        (["sensors.encoders={resolution: [1.0e-5, 1.0e-5, 1.0e-5]}"], r"3.*2"),
        (["sensors.encoders={velocity_bandwidth: 0.0}"], "velocity_bandwidth"),
        (["sensors.encoders={velocity_bandwidth: 9.0, velocity_noise: 1.0}"], "velocity_bandwidth"),
        (["sensors.encoders={position_bias: [[1.0, 2.0]]}"], "position_bias"),
        (["sensors.encoders={seed: -1}"], "seed"),
        (["sensors.encoders={}", "sampling="], "sampling"),
    ],
)
def test_what_no_encoder_can_be_is_refused(settings, message):
    with pytest.raises(ScenarioError, match=f"encoders: .*{message}"):
        build_scenario(scenario("two_link_wall", SAMPLED[0], *settings))


def test_a_sensor_needs_positions_and_velocities():
    with pytest.raises(ModelError, match="size"):
        StateSensor(3, 2, Encoders(), T)
