"""Sampled laws and drives with limits, against maps written by hand and the continuous law."""

import re

import casadi as ca
import numpy as np
import pytest
from arms import arm, error_controlled
from numpy.testing import assert_allclose
from pydrake.systems.analysis import Simulator
from runs import run, scenario

import drake_dae as dd
from drake_dae.diagrams import LoopSettings
from drake_dae.errors import ModelError, WiringError

STEP = error_controlled(1e-10)
K, T = 3.0, 0.05


def integrator() -> dd.DaeSystem:
    """x' = u, z = x."""
    x, none = ca.SX.sym("x"), ca.SX(0, 1)
    return dd.DaeSystem(x, 0 * x, ca.SX(1, 0), ca.SX(1), none, x, ca.SX(1, 0), nominal_state=[1.0])


def pursue(reference, sampling, duration, **more):
    """x' = u behind u = r' - K (x - r), from x = 1."""
    system = integrator()
    plant = dd.DaePlant(system)
    loop = dd.make_closed_loop(
        plant,
        dd.TrackingLaw(system, dd.poles(-K)),
        [reference],
        LoopSettings(sampling=sampling, **more),
    )
    context = loop.diagram.CreateDefaultContext()
    return loop, context, run(loop, context, duration, STEP)


def at(record, name, times):
    """A signal of a record at times that it has; what was logged before their events."""
    index = np.searchsorted(record.time, np.asarray(times) - 1e-9)
    assert_allclose(record.time[index], times, atol=1e-12)
    return record[name][index, 0]


@pytest.mark.parametrize(("period", "delay"), [(1e-3, 1e6), (1e-12, 1.0), (1.0, 1e300)])
def test_a_delay_of_more_samples_than_are_kept_is_refused(period, delay):
    with pytest.raises(ModelError, match="10000"):
        dd.Sampling(period, delay)
    assert dd.Sampling(period, 9_999.5 * period).late_samples == 10_000


@pytest.mark.parametrize("delay", [0.0, 0.3 * T, T, 1.3 * T, 2.0 * T])
def test_held_control_is_that_of_the_map_by_hand(delay):
    """x_(k+1) = x_k + rest u_(k-n-1) + (T - rest) u_(k-n), u_k = -K x_k, and u_k = u_0 before.

    The control is constant between events, so the integrator leaves round-off alone.
    """
    whole = int(delay / T + 1e-9)
    rest = delay - whole * T
    x, u = [1.0], []
    for k in range(20):
        u.append(-K * x[k])
        x.append(x[k] + rest * u[max(k - whole - 1, 0)] + (T - rest) * u[max(k - whole, 0)])
    _, _, record = pursue(dd.ConstantReference(0.0), dd.Sampling(T, delay), 20 * T)
    assert_allclose(at(record, "state", T * np.arange(20)), x[:20], atol=1e-12)


def test_state_reference_and_log_belong_to_one_instant():
    """The control of [t_k, t_(k+1)) is r'(t_k) - K (x(t_k) - r(t_k)) of what is logged for t_k."""
    _, _, record = pursue(dd.SinusoidReference(0.2, 0.4, 5.0), dd.Sampling(T), 1.0)
    times = T * np.arange(20)
    r = 0.2 + 0.4 * np.sin(5.0 * times)
    assert_allclose(at(record, "reference", times), r, atol=1e-14)
    wanted = 2.0 * np.cos(5.0 * times) - K * (at(record, "state", times) - r)
    assert_allclose(at(record, "control", times[1:]), wanted[:-1], atol=1e-12)


def test_run_that_goes_on_keeps_what_is_held():
    """Drake makes the events of the moment where a run ends once more when the next one begins."""
    half, whole = dd.Sampling(T, 0.3 * T), 20 * T
    loop, context, _ = pursue(dd.ConstantReference(0.0), half, 9.9 * T)
    on = error_controlled(1e-10)
    on.start_time = context.get_time()
    dd.simulate(loop.diagram, context, 10.1 * T, on)
    _, _, record = pursue(dd.ConstantReference(0.0), half, whole)
    assert_allclose(loop.record(context)["state"][-1], record["state"][-1], atol=1e-12)


def test_limits_cut_and_tell_when():
    """x' = -1 from 1 until K x = 1, then exp(-K t): cut off for 1 - 1/K seconds."""
    _, _, record = pursue(dd.ConstantReference(0.0), None, 2.0, control_limits=[1.0])
    end = 1.0 - 1.0 / K
    assert np.all(np.abs(record["control"]) <= 1.0)
    cut = record.time[record["excess"][:, 0] != 0.0]
    steps = np.diff(record.time).max()
    assert cut[0] == 0.0
    assert end - steps < cut[-1] < end + 1e-9
    final = np.exp(-K * (2.0 - end)) / K
    # Error control sees the kink: 1e-10 a step, and a few more for what it misses.
    assert_allclose(record["state"][-1, 0], final, atol=1e-8)


def test_integrals_stand_still_while_a_drive_is_at_its_limit():
    """x' = 1 - K x cannot be held by |u| <= 0.5: without the hold the integral runs away."""
    system = integrator()
    tracking = dd.TrackingLaw(system, dd.poles(-K), integral=[system.output_signals[0].name])
    loop = dd.make_closed_loop(
        dd.DaePlant(system),
        tracking,
        [dd.ConstantReference(5.0)],
        LoopSettings(control_limits=[0.5]),
    )
    context = loop.diagram.CreateDefaultContext()
    record = run(loop, context, 1.0, STEP)
    assert np.all(record["excess"] > 0.0)
    assert_allclose(record["integral"], 0.0)


def test_a_law_that_reads_the_force_of_its_own_first_control_is_reported():
    """A sensor that samples has a force at the start."""
    arms = arm("two_link")
    more = {"structure": arms.structure, "measured_force": True, "force_gain": 0.4}
    tracking = dd.TrackingLaw(arms.model.dae, dd.poles(-4.0), **more)
    wanted, sampling = [dd.ConstantReference(0.3), dd.ConstantReference(20.0)], dd.Sampling(0.01)

    def pressed(sensor):
        plant = dd.RobotPlant(arms.model, structure=arms.structure)
        loop = dd.make_closed_loop(
            plant, tracking, wanted, LoopSettings(sensor=sensor, sampling=sampling)
        )
        context = loop.diagram.CreateDefaultContext()
        dd.simulate(loop.diagram, context, 0.3, error_controlled(1e-6))
        return loop.record(context)["constraint_force"][-1]

    with pytest.raises(WiringError, match="sample_period"):
        pressed(None)
    assert pressed(dd.ForceSensor(1, sample_period=0.01)) == pytest.approx(20.0, abs=0.5)


@pytest.mark.parametrize(
    ("numbers", "name"), [((0.0, 0.0), "period"), ((-1.0, 0.0), "period"), ((0.01, -1e-3), "delay")]
)
def test_sampling_refuses_times_that_are_none(numbers, name):
    with pytest.raises(ModelError, match=name):
        dd.Sampling(*numbers)


def test_limits_that_are_none_are_refused():
    with pytest.raises(ModelError, match=r"\b0\b"):
        dd.ControlLimits([1.0, 0.0])
    with pytest.raises(WiringError, match=r"size 1.*control_limits.*size 2"):
        pursue(dd.ConstantReference(0.0), None, 1.0, control_limits=[1.0, 1.0])


def grown(gain, a, late):
    """By how much errors of the measured force grow in a sample, by the loop sample by sample."""
    felt, read, sizes = 1.0, [1.0] * late, []
    for _ in range(400):
        read.append(felt)
        felt = a * felt - (1.0 - a) * gain * read.pop(0)
        sizes.append(abs(felt))
    return (max(sizes[-20:]) / max(sizes[180:200])) ** (1.0 / 200.0)


@pytest.mark.parametrize(("gain", "late"), [(7.0, 0), (4.6, 1)])
def test_what_a_sampled_sensor_takes_is_read_a_sample_later(gain, late):
    """These gains would be stable, were the newest sample read at once.

    Maxima over 20 samples of an error that swings tell its growth in 200 to 1e-3.
    """
    period, lag = 0.01, 0.05
    a = np.exp(-period / lag)
    radius = grown(gain, a, late + 1)
    assert grown(gain, a, late) < 0.99 < 1.01 < radius
    found, sampling = arm("two_link"), dd.Sampling(period, late * period)
    more = {"structure": found.structure, "measured_force": True, "force_gain": gain}
    tracking = dd.TrackingLaw(found.model.dae, dd.poles(-4.0), **more)
    wanted = [dd.ConstantReference(0.3), dd.ConstantReference(20.0)]
    settings = LoopSettings(sensor=dd.ForceSensor(1, lag, period), sampling=sampling)
    plant = dd.RobotPlant(found.model, structure=found.structure)
    with pytest.raises(WiringError, match="force_gain") as told:
        dd.make_closed_loop(plant, tracking, wanted, settings)
    number = float(re.search(r"force error by ([0-9.]*[0-9])", str(told.value))[1])
    assert number == pytest.approx(radius, rel=5e-3)


@pytest.mark.slow
def test_force_of_a_sampled_sensor_follows_the_control_of_two_samples_before():
    """e_(k+2) = a e_(k+1) - (1 - a) Gbar e_k of the measured force, in Drake's Simulator.

    The law's model is right, so that nothing else moves the force: that of the integrator, 1e-8.
    """
    found = scenario(
        "two_link_wall",
        "references={tool.z: 0.3, wall.force: 20}",
        "start.errors={}",
        "sensors.force={time_constant: 0.05, sample_period: 0.01}",
        "law.force_gain=5",
        "sampling={period: 0.01, delay: 0.0}",
    )
    loop, context = dd.build_scenario(found)
    loop.sensor.set_force(loop.sensor.GetMyMutableContextFromRoot(context), [19.0])
    simulator, errors, a = Simulator(loop.diagram, context), [], np.exp(-0.2)
    for k in range(12):
        simulator.AdvanceTo((k + 0.5) * 0.01)
        own = loop.sensor.GetMyContextFromRoot(context)
        errors.append(loop.sensor.GetOutputPort("measured_force").Eval(own).item() - 20.0)
    errors = np.array(errors)
    assert np.abs(errors).max() > 0.9
    wanted = a * errors[1:-1] - (1.0 - a) * 5.0 * errors[:-2]
    assert_allclose(errors[2:], wanted, atol=1e-5)
