"""Motions that are slowed, and controls that are limited, while they run."""

from dataclasses import replace

import numpy as np
import pytest
from arms import arm, consistent_states, error_controlled, fixed_step, law, numbers
from scipy.optimize import linprog

from drake_dae import (
    ConstantReference,
    LoopSettings,
    MotionLimits,
    PathTiming,
    PointToPointReference,
    RobotPlant,
    SinusoidReference,
    TimeOptimalReference,
    TrackingLaw,
    make_closed_loop,
    poles,
    robot_motion_limits,
    rollout,
    simulate,
    start_values,
    with_disturbance,
)
from drake_dae.dae.governing.feasible import feasible_control
from drake_dae.errors import ModelError, WiringError

MOTORS = ("joint1_motor", "joint2_motor")
PRESS = ConstantReference(20.0)


def limits_of(efforts, share=1.0, **more):
    controls = {
        name: (-share * one, share * one) for name, one in zip(MOTORS, efforts, strict=True)
    }
    return MotionLimits(controls, **more)


def governed_loop(efforts, references, end, largest_rate=None, **settings):
    """The two-link arm in its time-optimal motion with 95 % of the efforts, governed at all."""
    found, own = arm("two_link"), law("two_link")
    timing = PathTiming(found.structure, limits_of(efforts, 0.95))
    profile = timing.profile(references, end, largest_rate=largest_rate, points=300)
    plant = RobotPlant(found.model, structure=found.structure)
    given = LoopSettings(governed=limits_of(efforts), **settings)
    loop = make_closed_loop(plant, own, [TimeOptimalReference(profile)], given)
    return profile, loop


def started(loop, error):
    """A context at rest with the tip off its reference."""
    model, plant = arm("two_link").model, loop.plant
    context = loop.diagram.CreateDefaultContext()
    wanted = loop.reference.reference(0.0)[[0, 3]] + [error, 0.0]
    parameters = plant.dae.parameter_values
    q = model.configuration(wanted[:1], model.nominal_positions, parameters)
    state = model.rest_state(q, wanted[1:], parameters)
    plant.set_consistent_state(plant.GetMyMutableContextFromRoot(context), state)
    return context


def run(loop, error, duration):
    context = started(loop, error)
    simulate(loop.diagram, context, duration, error_controlled(1e-8))
    return loop.record(context)


@pytest.mark.slow
@pytest.mark.parametrize("efforts", [(300.0, 120.0), (110.0, 60.0), (95.0, 45.0)])
def test_limits_hold_and_errors_follow_their_prediction(efforts):
    """A start 3 cm off the path; with less effort the motion takes longer."""
    references = [SinusoidReference(0.3, 0.3, 1.5), PRESS]
    profile, loop = governed_loop(efforts, references, 4.0, 1.0)
    record = run(loop, 0.03, profile.duration + 1.0)
    assert np.all(np.abs(record["control"]) <= efforts)
    s, rate, bend, _ = record["path"].T
    assert rate[0] == 0.0
    assert rate.min() >= 0.0
    assert rate.max() <= 1.0 + 1e-12
    assert s[-1] > profile.duration
    np.testing.assert_allclose(
        np.diff(rate), np.diff(record.time) * (bend[1:] + bend[:-1]) / 2.0, atol=1e-3
    )
    # Steps over the jumps of r'' at the turns are less accurate than 1e-8.
    off = np.abs(record["tracking_error"] - loop.predicted_error(record))
    assert off.max() < 2e-6
    assert np.abs(record["tracking_error"][-1]).max() < 1e-3


@pytest.mark.slow
def test_without_a_governor_the_same_start_exceeds_the_limits():
    """15 cm below the path even rest needs 11 % too much; then the governor waits."""
    references = [PointToPointReference(0.0, 0.6, 0.0, 2.0, order=3), PRESS]
    efforts = (110.0, 55.0)
    profile, loop = governed_loop(efforts, references, 2.0)
    governed = run(loop, -0.15, profile.duration + 1.0)
    found, own = arm("two_link"), law("two_link")
    plant = RobotPlant(found.model, structure=found.structure)
    plain = make_closed_loop(plant, own, [TimeOptimalReference(profile)])
    free = run(plain, -0.15, profile.duration)
    assert np.max(np.abs(free["control"]) / efforts) > 1.25
    needed = np.max(np.abs(governed["control"]) / efforts, axis=1)
    assert needed[0] == needed.max() == pytest.approx(1.109, abs=1e-3)
    # Hardly, once the error is small enough.
    assert needed[governed.time > 0.15].max() <= 1.0 + 2e-3
    assert governed["path"][:, 1].min() >= 0.0
    assert governed["path"][-1, 0] > profile.duration


@pytest.mark.slow
@pytest.mark.parametrize("period", [0.0, 0.01])
def test_a_rollout_has_the_record_of_simulate(period):
    references = [SinusoidReference(0.3, 0.3, 1.5), PRESS]
    settings = {"control_limits": [140.0, 70.0]}
    if period:
        from drake_dae import Sampling

        settings["sampling"] = Sampling(period)
    _, loop = governed_loop((140.0, 70.0), references, 1.5, **settings)
    context = started(loop, 0.05)
    simulate(loop.diagram, context, 0.4, fixed_step(2e-3))
    wanted = loop.record(context)
    start, parameters = start_values(loop, started(loop, 0.05))
    (found,) = rollout(
        loop, start, parameters, wanted.time, config=fixed_step(2e-3), compiled=False
    )
    assert list(found.record.signals) == list(wanted.signals)
    for name in ("state", "control", "path", "reference", "departure", "excess"):
        scale = max(1.0, np.abs(wanted[name]).max())
        np.testing.assert_allclose(
            found.record[name][:-1], wanted[name][:-1], rtol=0.0, atol=1e-9 * scale
        )


def test_within_all_limits_the_control_is_the_wanted_one():
    found = arm("two_link")
    function = feasible_control(found.structure, limits_of((300.0, 120.0)))
    parameters = found.model.dae.parameter_values
    random = np.random.default_rng(0)
    for state in consistent_states("two_link", 5):
        wanted = random.uniform(-1.0, 1.0, 2) * (300.0, 120.0)
        control, excess, departure, is_limited = function(state, wanted, parameters)
        np.testing.assert_array_equal(control, wanted)
        assert not excess.any()
        assert not departure.any()
        assert not is_limited.any()


@pytest.mark.parametrize("name", ["two_link", "seven_joint"])
def test_limits_hold_in_the_stated_order(name):
    """Drives always, then the force; the departure is what the control misses of the law."""
    found = arm(name)
    dae = found.model.dae
    limits = robot_motion_limits(found.model, forces={"wall.force": (5.0, 60.0)})
    function = feasible_control(found.structure, limits)
    most = np.array([limits.controls[signal.name][1] for signal in dae.control_signals])
    own = law(name, poles(-4.0))
    structure, parameters = own.structure, dae.parameter_values
    elimination = structure.elimination
    import casadi as ca

    given = [dae.state, dae.parameter_symbol]
    force = ca.Function("force", given, [elimination.alpha, elimination.beta])
    matrix = ca.Function("B", given, [structure.control_matrix])
    random = np.random.default_rng(1)
    held = 0
    for state in consistent_states(name, 20):
        wanted = 2.0 * random.uniform(-1.0, 1.0, most.size) * most
        wanted[0] = 1.5 * most[0]
        control, excess, departure, is_limited = function(state, wanted, parameters)
        assert np.all(np.abs(control) <= most)
        alpha, beta = (part.full() for part in force(state, parameters))
        value = float(alpha[0, 0] + beta[0] @ control)
        # By the corners of the box: the range of forces that the drives can make.
        middle, room = alpha[0, 0], np.abs(beta[0]) @ most
        can = middle - room < 60.0 and middle + room > 5.0
        if can:
            held += 1
            assert 5.0 - 1e-3 <= value <= 60.0 + 1e-3
        np.testing.assert_allclose(excess, wanted - control)
        missed = matrix(state, parameters).full() @ (control - wanted)
        np.testing.assert_allclose(departure, missed, atol=1e-9 * np.abs(missed).max())
        assert is_limited
    assert held > 3


@pytest.mark.parametrize(
    ("name", "period"), [("two_link", 0.0), ("two_link", 0.004), ("seven_joint", 0.0)]
)
def test_speeds_hold_where_drives_and_forces_allow_it(name, period):
    """By MultibodyPlant, and by a linear program that tells whether any control is allowed."""
    found, random = arm(name), np.random.default_rng(2)
    plant, dae = found.plant, found.model.dae
    speeds = [signal.name for signal in found.model.links.velocity_signals]
    limits = replace(
        robot_motion_limits(found.model, forces={"wall.force": (5.0, 60.0)}),
        states=dict.fromkeys(speeds, (-1.0, 1.0)),
        rates=dict.fromkeys(speeds, (-6.0, 6.0)),
    )
    function = feasible_control(found.structure, limits, period)
    most = np.array([limits.controls[signal.name][1] for signal in dae.control_signals])
    driven, held, given_way = np.eye(most.size), 0, 0
    for state in consistent_states(name, 30):
        half = state.size // 2
        speed = 0.995 * state[half:] / np.abs(state[half:]).max()
        there = numbers(name, state[:half], speed)
        jacobian = there.constraint_jacobian
        # M v' = u + J^T f - bias,   J v' + J' v = 0.
        matrix = np.block([[there.mass, -jacobian.T], [jacobian, np.zeros((1, 1))]])
        right = np.concatenate([-there.bias, -there.constraint_acceleration])
        free = np.linalg.solve(matrix, right)
        by = np.linalg.solve(matrix, np.vstack([driven, np.zeros((1, most.size))]))
        # v' <= 100 (V - v) in the last hundredth; elsewhere v <= V after a sample.
        elsewhere = 1.0 / period if period else np.inf
        left = 1.0 - speed, -1.0 - speed
        high, low = (np.where(np.abs(part) < 0.01, 100.0, elsewhere) * part for part in left)
        high, low = np.append(high, 60.0), np.append(low, 5.0)
        rows, room = np.vstack([by, -by]), np.concatenate([high - free, free - low])
        kept = np.isfinite(room)
        bounds = list(zip(-most, most, strict=True))
        can = linprog(np.zeros(most.size), rows[kept], room[kept], bounds=bounds).status == 0
        force = [rows[half], rows[-1]], [room[half], room[-1]]
        can_press = linprog(np.zeros(most.size), *force, bounds=bounds).status == 0
        wanted = random.uniform(-1.0, 1.0, most.size) * most
        control, *_ = function(np.concatenate([state[:half], speed]), wanted, dae.parameter_values)
        assert np.all(np.abs(control) <= most)
        over = rows @ control - room
        if can:
            held += 1
            # They give way by 1e-6 times their multipliers, relative to what full torque makes.
            assert over.max() <= 2e-3 * 6.0
        elif can_press:
            given_way += 1
            assert max(over[half], over[-1]) <= 2e-2
    assert held > 3
    assert plant.num_velocities() == half


def test_a_speed_away_from_its_limit_may_change_as_fast_as_it_does():
    """Without the last hundredth of a speed nothing is limited, however fast it rises or falls."""
    found = arm("two_link")
    speeds = [signal.name for signal in found.model.links.velocity_signals]
    limits = limits_of((300.0, 120.0), states=dict.fromkeys(speeds, (-0.1, 0.1)))
    function = feasible_control(found.structure, limits)
    parameters, wanted = found.model.dae.parameter_values, np.array([290.0, -110.0])
    acts = []
    for state in consistent_states("two_link", 3):
        direction = state[2:] / np.abs(state[2:]).max()
        for share in (-0.985, -0.5, 0.0, 0.5, 0.985, 0.995):
            slow = np.concatenate([state[:2], 0.1 * share * direction])
            control, *_, is_limited = function(slow, wanted, parameters)
            if abs(share) < 0.99:
                np.testing.assert_array_equal(control, wanted)
            acts.append(bool(is_limited) and abs(share) > 0.99)
    assert any(acts)


@pytest.mark.slow
def test_a_motion_at_its_limits_follows_its_prediction():
    """A joint brakes at 300 times its largest speed a second; s' stays 1.

    Where its acceleration was kept below 100 1/s times what is left of its speed, even at rest,
    the error left its prediction by 1 cm.
    """

    def limits(share):
        slow = {name: (-0.1 * share, 0.1 * share) for name in ("joint1_w", "joint2_w")}
        return limits_of((300.0, 120.0), min(share, 1.0), states=slow)

    found, efforts = arm("two_link"), (300.0, 120.0)
    references = [SinusoidReference(0.3, 0.02, 1.5), PRESS]
    profile = PathTiming(found.structure, limits(0.9)).profile(references, 4.0, points=200)
    settings = LoopSettings(governed=limits(1.0), slowed=limits(0.95), control_limits=efforts)
    plant = RobotPlant(found.model, structure=found.structure)
    own = [TimeOptimalReference(profile)]
    loop = make_closed_loop(plant, law("two_link"), own, settings)
    record = run(loop, 0.0, profile.duration + 0.3)
    time, speed = record.time, np.abs(record["state"][:, 2:])
    assert not record["departure"].any()
    # Steps over the jumps of r'' at the turns are less accurate than 1e-8.
    off = np.abs(record["tracking_error"] - loop.predicted_error(record))
    assert off.max() < 2e-6
    # s' returns to 1 at 20 1/s from the start, and is not lowered after it.
    np.testing.assert_allclose(record["path"][:, 1], 1.0 - np.exp(-20.0 * time), atol=1e-4)
    # The motion uses 0.9 of the limit, up to its accepted excess of 2 %.
    assert 0.88 < speed.max() / 0.1 < 0.92
    # Fast enough that the test shows something: brakes from full speed within 3 ms.
    fast = np.abs(np.diff(speed, axis=0)).max(axis=1) / np.diff(time)
    assert fast[time[1:] > 0.1].max() > 100.0 * 0.1


@pytest.mark.slow
def test_a_model_error_leaves_drives_at_their_limits_and_shows_its_departure():
    references = [PointToPointReference(0.0, 0.6, 0.0, 2.0, order=3), PRESS]
    efforts = (140.0, 70.0)
    profile, loop = governed_loop(efforts, references, 2.0, control_limits=efforts)
    context = started(loop, 0.0)
    own = loop.plant.GetMyMutableContextFromRoot(context)
    loop.plant.set_parameter(own, "link2.mass", 14.0)
    simulate(loop.diagram, context, profile.duration, fixed_step())
    record = loop.record(context)
    assert np.abs(record["control"]).max(axis=0)[0] <= 140.0
    is_off = np.abs(record["departure"]).max(axis=1) > 0.0
    np.testing.assert_array_equal(is_off, np.abs(record["excess"]).max(axis=1) > 0.0)


def test_what_cannot_be_governed_is_refused_in_a_sentence():
    found = arm("two_link")
    for share in (0.0, 1.5):
        with pytest.raises(ModelError, match=f"close is a share of .* got {share:g}"):
            MotionLimits(close=share)
    with pytest.raises(ModelError, match="each control needs a limit of its magnitude"):
        feasible_control(found.structure, MotionLimits())
    plant = RobotPlant(found.model, structure=found.structure)
    settings = LoopSettings(governed=limits_of((1.0, 1.0)), control_limits=[1.0])
    with pytest.raises(WiringError, match="control_limits has 1 entries, there are 2"):
        make_closed_loop(plant, law("two_link"), [ConstantReference(0.3), PRESS], settings)
    names = [signal.name for signal in found.model.links.velocity_signals]
    unknown = TrackingLaw(with_disturbance(found.model.dae, names), poles(-4.0))
    with pytest.raises(WiringError, match="governed: the law has exogenous signals that no"):
        make_closed_loop(plant, unknown, [ConstantReference(0.3), PRESS], settings)
