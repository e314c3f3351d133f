"""Measured force: the sensor, the loop it closes, what it does to the errors of a wrong model."""

import numpy as np
import pytest
from arms import arm, consistent_states, fixed_step, law, touching
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput, RandomSource
from runs import some

import drake_dae as dd
from drake_dae.diagrams import LoopSettings
from drake_dae.errors import GainError, ModelError
from drake_dae.running import start_values

MOTORS = dd.DcMotors(torque_constant=0.5, inductance=1e-2, resistance=1.0, gear_ratio=100.0)
SERVOS = dd.ElectrohydraulicServos(stiffness=1e6, leakage=1e-6, geometry=0.05)
MOVE = [dd.SinusoidReference(0.3, 0.1, 1.5), dd.SinusoidReference(20.0, 5.0, 2.0)]
HOLD = [dd.ConstantReference(0.3), dd.ConstantReference(20.0)]


def run(
    model, references, *, measured=False, gain=0.0, sensor=None, duration=4.0, wrong=1.1, felt=0.0
):
    """The two-link arm under a law whose model has another mass of link 2.

    The sensor starts with the force reference and `felt` newtons more.

    Returns the times and the errors z - r, shape (k, 2).
    """
    chosen = dd.TrackingLaw(model.dae, dd.poles(-10.0), measured_force=measured, force_gain=gain)
    plant = dd.RobotPlant(model, structure=chosen.structure)
    loop = dd.make_closed_loop(plant, chosen, references, LoopSettings(sensor=sensor))
    context, controller = loop.diagram.CreateDefaultContext(), loop.controller
    own = controller.GetMyMutableContextFromRoot(context)
    mass = controller.get_parameter(own, "link2.mass")
    controller.set_parameter(own, "link2.mass", wrong * mass)
    places = chosen.layout.lowest
    height, force = loop.reference.reference(0.0)[places]
    q = model.configuration([height], [1.2, -1.6])
    plant.set_consistent_state(
        plant.GetMyMutableContextFromRoot(context), model.rest_state(q, [force])
    )
    if sensor is not None:
        sensor.set_force(sensor.GetMyMutableContextFromRoot(context), [force + felt])
    times = np.linspace(0.0, duration, round(100 * duration) + 1)
    (found,) = dd.rollout(loop, *start_values(loop, context), times, config=fixed_step())
    assert found.failure is None
    return times, found.record["tracking_error"]


@pytest.mark.slow
@pytest.mark.parametrize("gain", some([1.0, 4.0]))
@pytest.mark.equation(61)
def test_rigid_force_error_shrinks_to_1_over_1_plus_g(gain):
    """(61) with a wrong mass: within 5 %, of which the lag takes about 1 %; position untouched."""
    model = arm("two_link").model
    slow, sensor = (
        [MOVE[0], dd.SinusoidReference(20.0, 5.0, 0.5)],
        dd.ForceSensor(1, time_constant=2e-3),
    )
    times, without = run(model, slow)
    _, feedback = run(model, slow, measured=True, gain=gain, sensor=sensor)
    later = times > 1.0
    largest = np.max(np.abs(without[later, 1]))
    assert largest > 1.0
    ratio = np.max(np.abs(feedback[later, 1])) / largest
    assert ratio == pytest.approx(1.0 / (1.0 + gain), rel=0.05)
    # J^T lambda does not move the tip along the wall.
    np.testing.assert_allclose(feedback[:, 0], without[:, 0], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("stage", some([MOTORS, SERVOS]), ids=["motors", "servos"])
def test_measured_force_removes_the_static_error_behind_motors(stage):
    """At rest I_a' = 0 and the model's lambda' is 0, so (81) leaves Lambda_4 (lambda - r_2) = 0."""
    model = touching("two_link", [stage])
    _, without = run(model, HOLD, duration=3.0)
    _, feedback = run(model, HOLD, duration=3.0, measured=True)
    assert abs(without[-1, 1]) > 1.0
    # The slowest mode is the pole at -10: exp(-30) of a few newtons.
    assert abs(feedback[-1, 1]) < 1e-6 * abs(without[-1, 1])
    np.testing.assert_allclose(feedback[:, 0], without[:, 0], atol=1e-9)


@pytest.mark.equation(59)
def test_law_59_with_measured_force():
    """u of (59) less u without Gbar is J^T Gbar (lambda - r_2)."""
    found, gain = arm("two_link"), 3.0
    fed = dd.TrackingLaw(
        found.model.dae,
        dd.poles(-4.0),
        structure=found.structure,
        measured_force=True,
        force_gain=gain,
    )
    for state in consistent_states("two_link", 5):
        reference = np.array([0.1, 0.2, 0.3, 20.0])
        difference = fed.control(state, reference, measured_force=[26.0]) - law("two_link").control(
            state, reference
        )
        q = state[:2]
        # phi = 1.2 - x of the tip.
        jacobian = [np.sin(q[0]) + np.sin(q.sum()), np.sin(q.sum())]
        np.testing.assert_allclose(difference, gain * 6.0 * np.array(jacobian), rtol=1e-9)


@pytest.mark.parametrize("gain", [0.5, 0.95])
def test_a_sampled_loop_multiplies_the_error_by_minus_g(gain):
    """One-sample delay: stable below 1."""
    sensor = dd.ForceSensor(1, sample_period=0.02)
    model = arm("two_link").model
    given = {"wrong": 1.0, "felt": 1.0, "duration": 0.2}
    times, error = run(model, HOLD, measured=True, gain=gain, sensor=sensor, **given)
    middle = np.isclose(times % 0.02, 0.01)
    ratios = error[middle, 1][1:] / error[middle, 1][:-1]
    np.testing.assert_allclose(ratios, -gain, rtol=1e-6)


def test_the_lagged_loop_decays_at_1_plus_g_over_tau():
    """tau y' = lambda - y with lambda - r = -G (y - r): y - r decays at (1 + G) / tau."""
    gain, tau = 3.0, 0.2
    model = arm("two_link").model
    given = {"wrong": 1.0, "felt": 2.0, "duration": 0.3}
    sensor = dd.ForceSensor(1, tau)
    times, error = run(model, HOLD, measured=True, gain=gain, sensor=sensor, **given)
    # RK5 at 1 ms, (1 + G) / tau = 20 1/s: about 1e-12.
    expected = -gain * 2.0 * np.exp(-(1 + gain) / tau * times)
    np.testing.assert_allclose(error[:, 1], expected, atol=1e-9)


def sensed(sensor, source, duration, generator=None, step=1e-3):
    builder = DiagramBuilder()
    builder.AddSystem(source)
    builder.AddSystem(sensor)
    builder.Connect(source.get_output_port(0), sensor.GetInputPort("force"))
    noise = None
    if sensor.HasInputPort("noise"):
        size = sensor.GetInputPort("noise").size()
        noise = builder.AddSystem(RandomSource(RandomDistribution.kGaussian, size, 0.01))
        builder.Connect(noise.get_output_port(), sensor.GetInputPort("noise"))
    log = LogVectorOutput(sensor.GetOutputPort("measured_force"), builder, 0.01)
    simulator = Simulator(builder.Build())
    if generator is not None:
        noise.SetRandomContext(
            noise.GetMyMutableContextFromRoot(simulator.get_mutable_context()), generator
        )
    ApplySimulatorConfig(fixed_step(step), simulator)
    simulator.AdvanceTo(duration)
    found = log.FindLog(simulator.get_context())
    return found.sample_times(), found.data()


def test_lag_and_bias():
    """A step of 8 N: 8 (1 - exp(-t / tau)) + bias, to the integrator's 1e-12."""
    times, values = sensed(
        dd.ForceSensor(1, time_constant=0.1, bias=0.5), ConstantVectorSource([8.0]), 0.5
    )
    np.testing.assert_allclose(values[0], 8.0 * (1 - np.exp(-times / 0.1)) + 0.5, atol=1e-10)


@pytest.mark.parametrize(("lag", "period"), [(0.1, 0.0), (0.0, 0.1), (0.1, 0.1)])
def test_a_sensor_starts_as_if_it_had_felt_a_constant_force(lag, period):
    """It shows that force and its bias from the start on, as long as the force stays."""
    sensor, force = dd.ForceSensor(2, lag, period, [0.5, -0.2]), [8.0, 3.0]
    builder = DiagramBuilder()
    builder.AddSystem(sensor)
    source = builder.AddSystem(ConstantVectorSource(force))
    builder.Connect(source.get_output_port(), sensor.GetInputPort("force"))
    simulator = Simulator(builder.Build())
    own = sensor.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    sensor.set_force(own, force)
    for time in (0.0, 0.05, 0.25):
        if time:
            simulator.AdvanceTo(time)
        shown = sensor.GetOutputPort("measured_force").Eval(own)
        np.testing.assert_allclose(shown, [8.5, 2.8], rtol=1e-14)


@pytest.mark.slow
def test_noise_has_its_deviation_and_its_seed():
    sensor = lambda: dd.ForceSensor(2, 0.01, noise_deviation=[0.5, 2.0])  # noqa: E731

    def noisy(duration, seed):
        still = ConstantVectorSource([0.0, 0.0])
        return sensed(sensor(), still, duration, RandomGenerator(seed), step=0.01)[1]

    first, again, other = noisy(20.0, 3), noisy(2.0, 3), noisy(2.0, 4)
    np.testing.assert_array_equal(first[:, :201], again)
    assert np.max(np.abs(again - other)) > 0.1
    # 2000 samples: the deviation is known to 2 % (one sigma 1.6 %).
    np.testing.assert_allclose(np.std(first, axis=1), [0.5, 2.0], rtol=0.06)


def test_the_drift_of_a_sensor_is_set_in_a_context():
    sensor = dd.ForceSensor(2, sample_period=0.1)
    context = sensor.CreateDefaultContext()
    context.SetTime(3.0)
    sensor.set_errors(context, 1.0, 0.0, [0.5, -0.5])
    sensor.set_force(context, [10.0, 20.0])
    measured = sensor.GetOutputPort("measured_force").Eval(context)
    np.testing.assert_allclose(measured, [12.5, 19.5], atol=1e-14)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "close"),
        ({"time_constant": -0.1}, "-0.1"),
        ({"sample_period": np.inf}, "sample_period"),
        ({"time_constant": 0.1, "bias": [1.0, 2.0, 3.0]}, r"bias.*\(2,\)"),
        ({"time_constant": 0.1, "noise_deviation": [0.1, -1.0]}, "noise_deviation.*-1"),
        ({"time_constant": 0.1, "drift": np.nan}, "drift.*nan"),
    ],
)
def test_what_no_sensor_can_be_is_refused(given, message):
    with pytest.raises(ModelError, match=message):
        dd.ForceSensor(2, **given)


@pytest.mark.parametrize(
    ("measured", "gain", "message"), [(True, -0.5, "force_gain"), (False, 1.0, "measured_force")]
)
def test_gains_of_forces_that_do_not_fit_are_refused(measured, gain, message):
    system = arm("two_link").model.dae
    with pytest.raises(GainError, match=message):
        dd.TrackingLaw(system, dd.poles(-4.0), measured_force=measured, force_gain=gain)
