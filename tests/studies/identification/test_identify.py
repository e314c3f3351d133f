"""Parameters from records: against the truth, finite differences and other least squares."""

import re
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest
from runs import scenario, some
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from drake_dae import Record, build_scenario
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.scenario.rolled import for_rollout, roll_scenario
from drake_dae.simulation.records.record import Recorded
from drake_dae.studies.identification.driven import DrivenPlant
from drake_dae.studies.identification.identify import identify
from drake_dae.studies.identification.measured import measured, measured_ports
from drake_dae.studies.identification.pieces import RecordPieces

FIXED = (
    "integrator={integration_scheme: runge_kutta3, use_error_control: false, max_step_size: 0.001}",
)
WALL = ("two_link_wall", "duration=0.4", *FIXED)
SAMPLED = (*WALL, "sampling={period: 0.001, delay: 0.001}")
COMPLIANT = (*SAMPLED, "plant=!CompliantContact {friction: 0.2}")
CONTINUOUS = (*SAMPLED, "plant=!CompliantContact {friction: 0.2, time_step: 0}")


@cache
def built(*settings):
    made = for_rollout(scenario(*settings))[0]
    return made, *build_scenario(made)


@cache
def run_of(changes, *settings):
    """A rollout with other numbers in the plant."""
    made, loop, context = built(*settings)
    other = context.Clone()
    own = loop.plant.GetMyMutableContextFromRoot(other)
    for name, value in changes:
        loop.plant.set_parameter(own, name, value)
    found = roll_scenario(made, loop, other)
    assert found.failure is None
    return loop, context, found.record


def noisy(record, seed, deviations):
    """A record with noise on some columns of some signals: (signal, columns, deviation)."""
    random, signals = np.random.default_rng(seed), dict(record.signals)
    for name, columns, deviation in deviations:
        values = signals[name].values.copy()
        values[:, columns] += deviation * random.normal(size=values[:, columns].shape)
        signals[name] = Recorded(values, signals[name].signals)
    return replace(record, signals=signals)


NOISE = (("state", slice(0, 2), 1e-4), ("constraint_force", slice(0, 1), 0.1))


# Differences of second order. With ideal contact truncation and round-off are both 1e-8 at this
# step; friction bends within 1e-4 m/s, which takes a shorter one, and
# shorter steps of the plant.
DERIVATIVES = {
    "ideal": (WALL, 3e-6, 1e-8, 1),
    "discrete": (COMPLIANT, 1e-8, 1e-5, 1),
    "continuous": (CONTINUOUS, 1e-8, 1e-5, 8),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", DERIVATIVES)
def test_derivatives_are_those_of_differences(kind):
    settings, step, tolerance, parts = DERIVATIVES[kind]
    loop, context, record = run_of((), *settings)
    places = [loop.plant.dae.parameter_slice("link2.mass").start]
    places += [place for _, place in loop.plant.further_parameters.values()][:1]
    driven = DrivenPlant(loop, context, measured_ports(loop), places)
    data = measured(record, driven, "record")
    biases = np.array([-1] * (len(data.channels) - 1) + [0])
    delays = np.full(len(data.channels), -1)
    pieces = RecordPieces(driven, data, biases, delays, 1, parts).first(40)
    x, theta = pieces.first_states, np.append(driven.nominal, 0.3)
    found = pieces.slopes(x, theta)
    n = x.shape[1]
    for i in range(n + theta.size):
        h = step * (1.0 if i < n else max(1.0, abs(theta[i - n])))
        ends = []
        for sign in (1.0, -1.0):
            z, p = x.copy(), theta.copy()
            if i < n:
                z[:, i] += sign * h
            else:
                p[i - n] += sign * h
            ends.append(pieces.slopes(z, p, found))
        for value, slope in ((0, found.of_errors), (2, found.of_ends)):
            expected = (ends[0][value] - ends[1][value]) / (2.0 * h)
            good = np.isfinite(expected)
            scale = 1.0 + np.abs(slope).max()
            np.testing.assert_allclose(
                slope[..., i][good] / scale, expected[good] / scale, atol=tolerance
            )


FOUND = {
    "ideal": (("link1.mass", 12.6), WALL),
    "compliant": (("link2.mass", 6.9), COMPLIANT),
    "loop": (("slider.mass", 1.3), ("slider_crank", "duration=0.5")),
    "springs": (("link2.mass", 6.1), ("two_link_flexible", "duration=0.5")),
    "sensor with a lag": (("link2.mass", 6.4), ("two_link_measured_force", "duration=0.2")),
    "exogenous": (("tool.mass", 0.8), ("seven_joint_moving_plate", "duration=0.3")),
    "motors": (("link2.mass", 6.1), ("two_link_motors", "duration=0.3")),
    "hydraulics": (("link2.mass", 6.1), ("two_link_hydraulics", "duration=0.3")),
}
DEAR = ("exogenous", "motors", "hydraulics", "springs")


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=pytest.mark.thorough) if k in DEAR else k for k in FOUND]
)
def test_a_parameter_is_found_from_an_exact_record(kind):
    change, settings = FOUND[kind]
    loop, context, record = run_of((change,), *settings)
    found = identify(loop, context, [record], [change[0]])
    # Rows of a run under error control are off by its accuracy, 1e-6, and the control between rows
    # is a spline.
    assert found[change[0]] == pytest.approx(change[1], rel=1e-6)
    assert found.undetermined == ()


def test_values_and_deviations_are_those_of_plain_least_squares():
    """Single shooting by SciPy: Drake's derivatives of the plant, and steps of our own."""
    settings = (WALL[0], "duration=0.1", *FIXED, "sampling={period: 0.001}")
    loop, context, record = run_of((("link2.mass", 6.5),), *settings)
    record = noisy(record, 1, NOISE)
    found = identify(loop, context, [record], ["link2.mass"])
    plant = loop.plant
    own = plant.CreateDefaultContext()
    # The last row has the control of the step that would follow.
    times, controls = record.time[:-1], record["control"][:-1]

    def rate(state):
        own.SetContinuousState(state)
        return plant.EvalTimeDerivatives(own).CopyToVector()

    def stepped(x, h):
        k1 = rate(x)
        k2 = rate(x + h / 2.0 * k1)
        k3 = rate(x + h / 2.0 * k2)
        return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(x + h * k3))

    def errors(unknown):
        state, mass = unknown[:4], unknown[4]
        plant.set_parameter(own, "link2.mass", mass)
        x, rows = plant.set_consistent_state(own, state), []
        for k, time in enumerate(times):
            plant.get_input_port(0).FixValue(own, controls[k])
            own.SetContinuousState(x)
            force = plant.GetOutputPort("constraint_force").Eval(own)
            rows.append(
                np.append(
                    (record["state"][k, :2] - x[:2]) / 1e-4,
                    (record["constraint_force"][k] - force) / 0.1,
                )
            )
            if k + 1 < times.size:
                plant.get_input_port(0).FixValue(own, controls[k + 1])

                x = stepped(x, times[k + 1] - time)
        return np.concatenate(rows)

    first = np.append(record["state"][0], 6.0)
    plain = least_squares(errors, first, x_scale=[1e-3, 1e-3, 1e-2, 1e-2, 0.1], xtol=1e-10)
    # The start is projected, so that two directions of it are free of effect.
    covariance = np.linalg.pinv(plain.jac.T @ plain.jac, rcond=1e-10)
    deviation = float(np.sqrt(covariance[4, 4]))
    # Differences of first order in the other one; noise is estimated here and given there, from 100
    # rows, within some 10 %.
    assert found["link2.mass"] == pytest.approx(plain.x[4], abs=0.05 * deviation)
    assert found.deviations[0] == pytest.approx(deviation, rel=0.15)


def covered(count):
    """How many of some noisy records have an interval with the truth, and the spread of values."""
    loop, context, record = run_of((("link1.mass", 12.6), ("link2.mass", 6.3)), *WALL)
    values, hits = [], []
    for seed in range(count):
        found = identify(loop, context, [noisy(record, seed, NOISE)], ["link1.mass", "link2.mass"])
        values.append(found.values)
        hits.append((found.intervals[:, 0] < [12.6, 6.3]) & (found.intervals[:, 1] > [12.6, 6.3]))
    return found, np.array(values), np.array(hits)


@pytest.mark.slow
def test_intervals_have_the_size_of_what_noise_does():
    found, values, hits = covered(8)
    # The deviation of 8 values is between 0.4 and 1.8 of the true one but once in 1e3.
    spread = values.std(axis=0, ddof=1)
    np.testing.assert_array_less(spread, 1.8 * found.deviations)
    np.testing.assert_array_less(found.deviations, 2.5 * spread)
    assert (hits.sum(axis=0) >= 6).all()
    np.testing.assert_allclose(found.bootstrap, found.deviations, rtol=0.5)
    assert all(noise.is_white for noise in found.noise.values())
    # Of 800 and 400 values the deviations have 2.5 and 3.5 %.
    assert found.noise["state"].deviation == pytest.approx(1e-4, rel=0.1)
    assert found.noise["constraint_force"].deviation == pytest.approx(0.1, rel=0.14)


@pytest.mark.thorough
def test_intervals_cover_as_often_as_they_say():
    _, _, hits = covered(1000)
    # 95 % of 1,000: one deviation is 0.7 %.
    assert (np.abs(hits.mean(axis=0) - 0.95) < 0.02).all()


def test_what_a_record_does_not_determine_is_told_by_name():
    loop, context, record = run_of((), *WALL)
    free = ["wall.position", "link2.mass"]
    found = identify(loop, context, [record], free)
    # Along the wall nothing depends on its place.
    assert {names for names in found.undetermined} == {("wall.position[1]",), ("wall.position[2]",)}
    assert np.isnan(found.deviations[[1, 2]]).all()
    assert found.last_step < 0.1
    assert "Converged: the last step" in found.text()
    assert found["wall.position[0]"] == pytest.approx(found.start[0], abs=1e-6)
    assert "not determined" in found.text()
    assert found.to_dict()["parameters"]["wall.position[1]"]["interval"] is None


@pytest.mark.slow
def test_errors_are_compared_with_the_stated_noise():
    settings = (*SAMPLED, "encoders={position_noise: 1e-4}")
    loop, context, record = run_of((), *settings)
    text = identify(loop, context, [record], ["link2.mass"]).text()
    assert "times the stated noise" not in text
    less = noisy(record, 3, [("estimated_state", slice(0, 2), 2e-4)])
    text = identify(loop, context, [less], ["link2.mass"]).text()
    # sqrt(1 + 4) = 2.24 times, from 800 values within 2.5 %
    found = re.search(r"The errors of estimated_state are (\S+) times the stated noise", text)
    assert found is not None
    assert float(found[1]) == pytest.approx(2.24, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["control", "constraint_force"])
def test_a_wrong_sign_is_told(name):
    loop, context, record = run_of((), *WALL)
    other = changed(record, name, lambda s: Recorded(-s.values, s.signals))
    remark = identify(loop, context, [other], ["link2.mass"]).remarks()[0]
    assert re.search("does not fit this robot. Look for a wrong sign", remark)


def test_biases_of_sensors_are_found():
    loop, context, record = run_of((), *WALL)
    signals = dict(record.signals)
    for name, column, bias in (("constraint_force", 0, 2.0), ("state", 1, 3e-3)):
        values = signals[name].values.copy()
        values[:, column] += bias
        signals[name] = Recorded(values, signals[name].signals)
    free = ["force.bias", "position.bias[1]"]
    found = identify(loop, context, [replace(record, signals=signals)], free)
    np.testing.assert_allclose(found.values, [2.0, 3e-3], rtol=1e-4)


def test_delays_of_sensors_are_found():
    loop, context, record = run_of((("link2.mass", 6.3),), *WALL)
    signals, later = dict(record.signals), {"state": 3.4e-3, "constraint_force": 1.3e-3}
    for name, delay in later.items():
        old = signals[name]
        # Exact to 1e-9: cubics through rows each millisecond.
        values = CubicSpline(record.time, old.values)(record.time - delay)
        signals[name] = Recorded(values, old.signals)
    late = replace(record, signals=signals).after(0.01)
    free = ["position.delay", "force.delay", "link2.mass"]
    found = identify(loop, context, [late], free)
    # What is left of a delay within a row is taken to second order: 1e-10 s^3 are left, times a
    # third derivative.
    assert found["position.delay"] == pytest.approx(3.4e-3, abs=1e-6)
    assert found["force.delay"] == pytest.approx(1.3e-3, abs=1e-5)
    assert found["link2.mass"] == pytest.approx(6.3, rel=1e-4)


def test_a_delay_needs_even_rows():
    loop, context, record = run_of((), *WALL)
    rows = np.r_[0:30, 31:200]
    signals = {n: Recorded(r.values[rows], r.signals) for n, r in record.signals.items()}
    with pytest.raises(ModelError, match="rows at equal steps"):
        identify(loop, context, [Record(record.time[rows], signals)], ["force.delay"])


SENSORS = {
    "samples": "sample_period: 0.002",
    "samples of a lag": "sample_period: 0.002, time_constant: 0.01",
    "a lag": "time_constant: 0.01",
}


SENSED = list(product(["ideal", "compliant"], SENSORS))


@pytest.mark.slow
@pytest.mark.parametrize(("plant", "kind"), some(SENSED))
def test_what_sensors_do_to_a_force_is_known_exactly(kind, plant):
    """Without noise a sample one row off, or the control of the step before, shows in the bias."""
    own = ("plant=!CompliantContact {friction: 0.2}",) if plant == "compliant" else ()
    settings = (
        *(*WALL, *own, "sampling={period: 0.002, delay: 0.002}"),
        f"force_feedback=!MeasuredForce {{{SENSORS[kind]}, bias: 1.0}}",
    )
    loop, context, record = run_of((("link2.mass", 6.3),), *settings)
    found = identify(loop, context, [record], ["link2.mass", "force.bias"])
    # The run integrates the lag by steps of third order: off by 0.1^4 / 24 of 28 N, 1.2e-4 N.
    assert found["link2.mass"] == pytest.approx(6.3, rel=1e-6)
    assert found["force.bias"] == pytest.approx(1.0, abs=1.5e-5)
    assert found.noise["measured_force"].deviation < 1.2e-4


def test_a_hold_may_act_just_before_the_step_of_its_instant():
    """At 0.501 s the times of a sample and of a step differ by the last bit; see `events_of`."""
    times = np.array([1002 * 0.0005, 501 * 0.001])
    assert times[0] == times[1]
    settings = (WALL[0], "duration=0.6", *FIXED, "sampling={period: 0.001, delay: 0.001}")
    own = "plant=!CompliantContact {friction: 0.2, time_step: 0.0005}"
    loop, context, record = run_of((("link2.mass", 6.3),), *settings, own)
    found = identify(loop, context, [record], ["link2.mass"])
    assert found.noise["state"].deviation < 1e-9
    assert found["link2.mass"] == pytest.approx(6.3, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("plant", "kind"), some(SENSED, of=6, first=4))
def test_rows_between_samples_are_no_measurements(kind, plant):
    """Encoders and law sample each second row; a sensor of the force samples, lags, or both."""
    noise, z = "noise_deviation: 0.3, bias: 1.0", []
    own = ("plant=!CompliantContact {friction: 0.2}",) if plant == "compliant" else ()
    names, truth = ["link2.mass", "force.bias"], [6.3, 1.0]
    for seed in range(3):
        settings = (
            *(*WALL, *own, "sampling={period: 0.002, delay: 0.002}"),
            f"encoders={{position_noise: 1e-5, seed: {seed}}}",
            f"force_feedback=!MeasuredForce {{{SENSORS[kind]}, {noise}, seed: {seed + 100}}}",
        )
        loop, context, record = run_of((("link2.mass", 6.3),), *settings)
        found = identify(loop, context, [record], names)
        z.append((found.values - truth) / found.deviations)
        assert found.noise["estimated_state"].deviation == pytest.approx(1e-5, rel=0.2)
        assert found.noise["measured_force"].deviation == pytest.approx(0.3, rel=0.3)
    # The sum of squares of 6 normal numbers is above 22.5 but once in 1e3.
    assert np.square(z).sum() < 22.5


@pytest.mark.slow
@pytest.mark.parametrize("free", [["plant.friction"], ["plant.dissipation"], ["link2.mass"]])
def test_what_begins_at_its_bound_stops_nothing_else(free):
    """Friction and dissipation are zero, where noise wants them below in half of all cases."""
    settings = (*SAMPLED, "plant=!CompliantContact {friction: 0.0}")
    loop, context, record = run_of((("link1.mass", 12.6),), *settings)
    names = ["link1.mass", *free, "plant.friction"][: 2 + (free[0] != "plant.friction")]
    found = identify(loop, context, [noisy(record, 5, NOISE)], names)
    values = dict(zip(found.names, found.values, strict=True))
    half = dict(zip(found.names, 3.0 * found.deviations, strict=True))
    assert abs(values["link1.mass"] - 12.6) < half["link1.mass"]
    assert 0.0 <= values["plant.friction"] < half["plant.friction"]
    if values["plant.friction"] == 0.0:
        assert re.search("At the lower bound: .*plant.friction", found.text())


def test_two_records_know_more_than_one():
    loop, context, record = run_of((("link2.mass", 6.3),), *WALL)
    records = [noisy(record, seed, NOISE) for seed in (1, 2)]
    alone = identify(loop, context, records[:1], ["link2.mass"])
    both = identify(loop, context, dict(zip("ab", records, strict=True)), ["link2.mass"])
    # Twice the data of the same noise, which is estimated from each.
    ratio = alone.deviations[0] / both.deviations[0]
    assert ratio == pytest.approx(np.sqrt(2.0), rel=0.05)


def changed(record, name, change):
    """A record with another signal; None removes it."""
    signals = dict(record.signals)
    if change is None:
        del signals[name]
    else:
        signals[name] = change(signals[name])
    return replace(record, signals=signals)


def cut(record, count):
    return record.after(record.time[-count - 1])


def without_numbers(recorded):
    values = recorded.values.copy()
    values[7, 0] = np.nan
    return Recorded(values, recorded.signals)


WRONG_RECORDS = {
    "too short": (lambda r: cut(r, 5), "5 rows; at least 20"),
    "no control": (lambda r: changed(r, "control", None), "no column .*joint1"),
    "degrees": (
        lambda r: changed(
            r,
            "state",
            lambda s: Recorded(s.values, (Signal("joint1", "deg"), *s.signals[1:])),
        ),
        "'state.joint1' in deg; it must be in rad",
    ),
    "another robot": (
        lambda r: changed(
            r, "state", lambda s: Recorded(s.values, (Signal("elbow", "rad"), *s.signals[1:]))
        ),
        "'state.elbow', and that of this robot has",
    ),
    "not a number": (lambda r: changed(r, "control", without_numbers), r"not a number at 0\.007 s"),
    "nothing measured": (
        lambda r: changed(changed(r, "state", None), "constraint_force", None),
        "neither positions .* nor forces",
    ),
    "no positions": (lambda r: changed(r, "state", None), "lacks the positions"),
    "a run that has failed": (
        lambda r: changed(r, "control", lambda s: Recorded(1e20 * s.values, s.signals)),
        "the run has failed there",
    ),
    "another motion": (
        lambda r: changed(r, "control", lambda s: Recorded(1e6 * s.values, s.signals)),
        "leaves the recorded one|have not come to an end",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", WRONG_RECORDS)
def test_a_record_that_does_not_fit_is_refused(kind):
    change, message = WRONG_RECORDS[kind]
    loop, context, record = run_of((), *WALL)
    with pytest.raises(ModelError, match=message):
        identify(loop, context, [change(record)], ["link2.mass"])


def test_a_run_that_ends_within_a_step_of_its_plant_is_understood():
    ends = (*COMPLIANT[:1], "duration=0.3004", *COMPLIANT[2:])
    loop, context, record = run_of((("link2.mass", 6.6),), *ends)
    assert np.diff(record.time)[-1] == pytest.approx(0.0004)
    assert identify(loop, context, [record], ["link2.mass"])["link2.mass"] == pytest.approx(6.6)


def test_rows_between_the_steps_of_a_plant_are_refused():
    loop, context, record = run_of((), *COMPLIANT)
    other = Record(1.3 * record.time, record.signals)
    with pytest.raises(ModelError, match=r"the plant steps by 0\.001 s"):
        identify(loop, context, [other], ["link2.mass"])


@pytest.mark.parametrize(
    ("free", "message"),
    [
        (["link3.mass"], "no parameter to identify 'link3.mass'.*link1.mass"),
        (["link1.mass", "link1.mass"], "'link1.mass' is named twice"),
        (["wall.position[3]"], "3 entries, counted from 0, and no entry 3"),
        ([], "free must be a list of names"),
        ("link1.mass", "free must be a list"),
    ],
)
def test_what_cannot_be_free_is_refused(free, message):
    loop, context, record = run_of((), *WALL)
    with pytest.raises(ModelError, match=message):
        identify(loop, context, [record], free)


def test_a_run_under_two_names_is_refused():
    loop, context, record = run_of((), *WALL)
    with pytest.raises(ModelError, match="record 1 and record 2 are the same run"):
        identify(loop, context, [record, replace(record, events=())], ["link2.mass"])


BOUNCE = ("wall_bounce", "duration=4.0")
POLISH = ("wall_polish",)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "name", "value"),
    [
        (BOUNCE, "link2.mass", 6.3),
        # Phases of a task in which the tool is free, strikes, rests with friction, and slides.
        pytest.param(POLISH, "tool.mass", 0.745, marks=pytest.mark.thorough),
    ],
)
def test_contacts_may_open_and_strike(settings, name, value):
    loop, context, record = run_of(((name, value),), *settings)
    assert record.events
    found = identify(loop, context, [record], [name])
    # The control between the rows of the task is a spline across the ends of its references.
    assert found[name] == pytest.approx(value, rel=1e-8 if settings is BOUNCE else 1e-5)
    left_out, total = found.left_out
    assert len(record.events) / 3 <= left_out < total / 5
    assert f"Left out are {left_out} of {total} steps" in found.text()
    assert np.isnan(found.errors[0]).all(axis=1).sum() < left_out


def test_steps_with_an_event_and_no_others_are_left_out():
    """A row whose time is that of an event may be before or after it."""
    loop, context, record = run_of((), *BOUNCE)
    data = measured(record, DrivenPlant(loop, context, measured_ports(loop), []), "record")
    expected = np.zeros(record.time.size - 1, dtype=bool)
    for event in record.events:
        expected[np.searchsorted(record.time, event.time) - 1] = True
    np.testing.assert_array_equal(data.cut, expected)
    shifted = replace(record, events=(replace(record.events[0], time=float(record.time[30])),))
    data = measured(shifted, DrivenPlant(loop, context, measured_ports(loop), []), "record")
    assert data.cut[[28, 29, 30, 31]].tolist() == [False, True, True, False]


WRONG_MODES = {
    "no mode": (None, "does not say when contacts are closed: .*wall.closed"),
    "a force": (
        lambda s: Recorded(7.5 * s.values, s.signals),
        "'mode' is .7.5. at 0 s; it must be 1",
    ),
}


@pytest.mark.parametrize("kind", WRONG_MODES)
def test_a_record_of_contacts_that_open_says_when(kind):
    change, message = WRONG_MODES[kind]
    loop, context, record = run_of((), *BOUNCE)
    with pytest.raises(ModelError, match=message):
        identify(loop, context, [changed(record, "mode", change)], ["link2.mass"])
    with pytest.raises(ModelError, match="a delay is not found across these"):
        identify(loop, context, [record], ["force.delay"])


@pytest.mark.slow
def test_no_record_and_drakes_own_contact_are_refused():
    loop, context, record = run_of((), *WALL)
    with pytest.raises(ModelError, match="no record"):
        identify(loop, context, [], ["link1.mass"])
    _, loop, context = built("wall_hydroelastic")
    with pytest.raises(ModelError, match="Drake's own contact"):
        identify(loop, context, [record], ["tool.mass"])
    _, loop, context = built("seven_joint_moving_plate")
    with pytest.raises(ModelError, match="exogenous signal"):
        identify(loop, context, [record], ["plate.position"])
