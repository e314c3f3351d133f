"""States that an estimator finds from encoders, against its filter, and against runs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import pushed_mass
from pydrake.common import RandomDistribution
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput, RandomSource
from runs import roll, scenario, some
from scipy.linalg import solve_discrete_lyapunov
from scipy.stats import chi2

from drake_dae import (
    DaePlant,
    Encoders,
    Sampling,
    StateEstimator,
    TrackingController,
    TrackingLaw,
    build_scenario,
    poles,
)
from drake_dae.dae.disturbance import filter_gain, transition
from drake_dae.errors import ScenarioError
from drake_dae.systems import ControlHold, Observing
from drake_dae.systems.sensors import StateSensor

T, MASS, FAST, SLOW = 0.01, 2.5, 20.0, 5.0
RATES = Observing(SLOW, state_rate=FAST)


def observed(
    push: float,
    duration: float,
    noise: float = 0.0,
    velocity_noise: float = 0.0,
    damping: float = 0.0,
):
    """What the estimator says of the body under its law, and the body's states, at the samples."""
    system = pushed_mass(MASS, damping=damping)
    law = TrackingLaw(system, poles(-2.0))
    builder = DiagramBuilder()
    plant, controller = builder.AddSystem(DaePlant(system)), TrackingController(law)
    builder.AddSystem(controller)
    encoders = Encoders(position_noise=noise, velocity_noise=velocity_noise)
    sensor = builder.AddSystem(StateSensor(2, 1, encoders, T))
    estimator = builder.AddSystem(
        StateEstimator(law, RATES, T, position_deviation=noise, velocity_deviation=velocity_noise)
    )
    hold = builder.AddSystem(ControlHold(1, Sampling(T)))
    reference = builder.AddSystem(ConstantVectorSource([0.5, 0.0, 0.0]))
    none = builder.AddSystem(ConstantVectorSource([]))
    if noise:
        source = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, 2, T))
        builder.Connect(source.get_output_port(), sensor.GetInputPort("noise"))
    for start, out, end, into in (
        (plant, "state", sensor, "state"),
        (sensor, "estimated_state", estimator, "measured_state"),
        (estimator, "estimated_state", controller, "estimated_state"),
        (estimator, "exogenous", controller, "exogenous"),
        (controller, "control", hold, "control"),
        (hold, "control", plant, "control"),
        (hold, "control", estimator, "control"),
    ):
        builder.Connect(start.GetOutputPort(out), end.GetInputPort(into))
    builder.Connect(none.get_output_port(), estimator.GetInputPort("measured_force"))
    for block in (controller, estimator):
        builder.Connect(reference.get_output_port(), block.GetInputPort("reference"))
    logs = [
        LogVectorOutput(block.GetOutputPort(name), builder, T)
        for block, name in (
            (plant, "state"), (estimator, "estimated_state"), (estimator, "disturbance")
        )
    ]  # fmt: skip
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant.set_parameter(plant.GetMyMutableContextFromRoot(context), "disturbance", push)
    simulator = Simulator(diagram, context)
    simulator.get_mutable_integrator().set_maximum_step_size(T)
    simulator.AdvanceTo(duration)
    return [log.FindLog(context).data().T for log in logs]


def error_step(ratio=None):
    """(1 - K H) F of the error of (q, v, a) over a sample, and K."""
    found = filter_gain(FAST, SLOW, T, ratio)
    shown = np.eye(3)[: found.shape[1]]
    return (np.eye(3) - found @ shown) @ transition(T), found


def test_errors_of_the_estimate_are_those_of_the_filter():
    """e = (1 - K H) F e for (q, v, a), whatever the law does; to the integrator's accuracy.

    A constant push of 4 N makes the start (0, 0, 4 / M).
    """
    states, estimates, found = observed(4.0, 3.0)
    step, _ = error_step()
    error, wanted = np.array([0.0, 0.0, 4.0 / MASS]), []
    for _ in states:
        wanted.append(error)
        error = step @ error
    actual = np.hstack([states - estimates, (4.0 - found) / MASS])
    assert_allclose(actual[1:], wanted[1:], atol=1e-6)
    assert abs(found[-1, 0] - 4.0) < 1e-3


def test_friction_that_is_stiff_for_the_samples_is_borne():
    """D T / M = 8: an explicit prediction grows sevenfold a sample. A push is found, slowly."""
    states, estimates, found = observed(4.0, 3.0, damping=8.0 * MASS / T)
    assert np.abs(states - estimates).max() < 0.05
    assert 3.0 < found[-1, 0] < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("ratio", some([None, 3.0], first=1))
def test_noise_leaves_the_deviations_of_the_filter(ratio):
    """60 s, 6,000 samples that are correlated for some 10: 600 of them tell 4 per cent."""
    noise = 1e-3
    states, estimates, _ = observed(0.0, 60.0, noise, 0.0 if ratio is None else ratio * noise)
    step, found = error_step(ratio)
    each = found @ np.diag([1.0, ratio or 0.0][: found.shape[1]])
    wanted = noise * np.sqrt(np.diag(solve_discrete_lyapunov(step, each @ each.T)))[:2]
    assert_allclose(np.std((states - estimates)[200:], axis=0), wanted, rtol=0.12)


FORCE = "sensors.force={sample_period: 0.001, noise_deviation: 0.3}"
NOISY = ("wall_point_contact", "plant=!CompliantContact {time_step: 0.001, friction: 0.3}", FORCE)
NOISE = "sensors.encoders={position_noise: 5.0e-5, velocity_noise: 0.01}"


@pytest.mark.slow
def test_encoders_alone_track_as_promised_and_innovations_are_consistent():
    """5e-5 rad and 0.01 rad/s: errors below 0.1 mm, 0.4 N and 1 N m from sample to sample.

    The residuals q - qm have the deviations of the filter: their squares are within the band of
    95 per cent for 93 to 97 per cent of the samples. Prediction and run differ by at most 30 per
    cent in what noise makes of the force, and of the controls.
    """
    loop, record = roll(scenario(*NOISY, NOISE, "duration=4"))
    late = record.time > 2.0
    error = record["tracking_error"][late]
    assert np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1))) < 1e-4
    assert np.sqrt(np.mean(error[:, -1] ** 2)) < 0.4
    change = np.diff(record["control"][late], axis=0)
    assert np.sqrt(np.mean(np.sum(change**2, axis=1))) < 1.0
    assert 0.93 < np.mean(in_band(loop, record)) < 0.97


def in_band(loop, record):
    """Whether the squared residuals of each sample after 2 s are in their band of 95 per cent."""
    observing, late = loop.observer.observing, record.time > 2.0
    gain = filter_gain(observing.state_rate, observing.rate, 1e-3, 0.01 / 5e-5)
    residual = (record["measured_state"] - record["estimated_state"])[late, :7]
    squares = np.sum(residual**2, axis=1) / (5e-5**2 * (1.0 - gain[0, 0]))
    low, high = chi2.ppf([0.025, 0.975], 7)
    return (low < squares) & (squares < high)


OBSERVED = "estimator={rate: 20, state_rate: 100}"
ROUNDED = "sensors.encoders={resolution: 1.0e-5}"


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ((*NOISY, OBSERVED), "estimator"),
        ((*NOISY, OBSERVED, ROUNDED, "sensors.encoders.velocity_bandwidth=500"), "velocity_bandw"),
        ((*NOISY, "estimator={rate: 20, state_rate: 2000}", "sensors.encoders={}"), "2000"),
        (("wall_flexible_contact", OBSERVED, ROUNDED), "estimator"),
    ],
)
def test_what_cannot_be_estimated_is_refused(settings, told):
    with pytest.raises(ScenarioError, match=told):
        build_scenario(scenario(*settings))
