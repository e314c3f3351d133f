"""One sample of an estimator, against its equations with matrices of MultibodyPlant alone."""

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from arms import arm, numbers
from numpy.testing import assert_allclose

from drake_dae import JointFriction, RobotModel, StateEstimator, TrackingLaw, poles
from drake_dae.dae import with_disturbance
from drake_dae.dae.disturbance import filter_gain
from drake_dae.systems import Observing

T = 1e-3
RATES = Observing(20.0, force_rate=5.0, state_rate=100.0)
Q, V = np.array([1.1, -1.5]), np.array([0.2, -0.3])


@cache
def law(friction: float = 0.0):
    found = arm("two_link")
    wall = replace(found.model.constraints[0], friction=friction, stiction_tolerance=1e-3)
    model = RobotModel(found.model.links, [wall], found.model.outputs, [1.2, -1.6])
    names = [signal.name for signal in model.links.velocity_signals]
    system = with_disturbance(model.dae, names, ["wall.friction"])
    return TrackingLaw(system, poles(-4.0), measured_force=True)


def gain(rate):
    """K_1, K_2, K_3 of a position."""
    return filter_gain(RATES.state_rate, rate, T)[:, 0]


def sample(measured, v, forces, controls, step=0.0, lag=0.0, mu=0.0, friction=0.0, slid=1e3):
    """The estimate after a sample: (q, v), r, mu; forces and controls are the last and the new.

    The contact has slid for many samples, or has not slid yet.
    """
    system = law(friction).system
    estimator = StateEstimator(law(friction), RATES, T, lag, 0.0, step, 1e-4)
    block = estimator.block
    held = np.concatenate([[0.0], Q, v, [0.0, 0.0], [mu], [slid], controls[0], [forces[0]]])
    given = {
        "time": [T],
        "held memory": held,
        "input measured_state": [*measured, *v],
        "input measured_force": [forces[1]],
        "input control": controls[1],
        "input hold": [0.0],
        "input reference": np.zeros(law(friction).layout.reference_size),
        "parameters": system.parameter_values,
    }
    names = ("estimated_state", "disturbance", "friction")
    function = ca.Function("now", [*block.columns().values()], [block.outputs[n] for n in names])
    values = [value.full().ravel() for value in function(*(given[n] for n in block.columns()))]
    return values[0], values[1], values[2][0]


def predicted(v, force, control, step):
    """q and v a sample later by M v' + H = u + J^T lambda, from the middle or the start."""
    known = numbers("two_link", Q + (T - step) / 2.0 * v, v)
    total = control - known.bias + known.constraint_jacobian[0] * force
    after = v + T * np.linalg.solve(known.mass, total)
    return Q + T * v + (T + step) / 2.0 * (after - v), after


@pytest.mark.parametrize(("step", "lag"), [(0.0, 0.0), (T, 1.0), (T / 2.0, 0.5)])
def test_prediction_is_the_motion_between_samples(step, lag):
    """Where the measured angles are the predicted ones, nothing is corrected; to round-off.

    A discrete plant's position is that of its new velocity, and its force that of its step; a
    continuous plant has the mean of both.
    """
    controls, forces = (np.array([3.0, -1.0]), np.array([-2.0, 4.0])), (10.0, 30.0)
    share = (1.0 + step / T) / 2.0
    force = share * forces[1] + (1.0 - share) * forces[0]
    control = lag * controls[0] + (1.0 - lag) * controls[1]
    q, v = predicted(V, force, control, step)
    state, r, mu = sample(q, V, forces, controls, step, lag)
    assert_allclose(state, [*q, *v], atol=1e-12)
    assert_allclose(r, 0.0, atol=1e-9)
    assert mu == 0.0


def test_an_error_is_corrected_by_the_gains_of_its_direction():
    """e = M^-1 J^T a has the gains of k_n, and an error along the wall those of k_o."""
    push, control = 0.0, np.zeros(2)
    q, v = predicted(V, push, control, 0.0)
    known = numbers("two_link", Q + T / 2.0 * V, V)
    J = known.constraint_jacobian[0]
    along = np.array([-J[1], J[0]])  # J e = 0.
    across = np.linalg.solve(known.mass, J)
    for error, rate in ((1e-3 * along, RATES.rate), (1e-3 * across, RATES.force_rate)):
        state, r, _ = sample(q + error, V, (push, push), (control, control))
        by_q, by_v, by_a = gain(rate)
        assert_allclose(state, [*(q + by_q * error), *(v + by_v * error)], atol=1e-9)
        assert_allclose(r, by_a * known.mass @ error, rtol=1e-6)


def test_what_a_contact_that_sticks_may_hold_is_not_believed():
    """At rest an error along the wall may be friction: what moves the arm along it is left out.

    A force r moves it along t, J t = 0, by t^T r / (t^T M t); to round-off.
    """
    push, control, still = 20.0, np.zeros(2), np.zeros(2)
    q, _ = predicted(still, push, control, 0.0)
    known = numbers("two_link", Q, still)
    J = known.constraint_jacobian[0]
    along = np.array([-J[1], J[0]])
    _, r, mu = sample(q + 1e-4 * along, still, (push, push), (control, control))
    believed = gain(RATES.rate)[2] * known.mass @ (1e-4 * along)
    assert abs(along @ believed) > 1e-3
    assert abs(along @ r) < 1e-9
    assert mu == 0.0


def test_friction_that_is_known_is_predicted():
    """mu J_t^T lambda against the sliding, at full strength.

    The smoothing of friction leaves 1e-5 rad/s of the 5e-3 rad/s that friction makes in a sample.
    """
    push, control, mu = 20.0, np.zeros(2), 0.4
    known = numbers("two_link", Q + T / 2.0 * V, V)
    slides = known.output_jacobian[0]
    total = -known.bias + known.constraint_jacobian[0] * push
    total -= mu * push * slides * np.sign(slides @ V)
    after = V + T * np.linalg.solve(known.mass, total)
    q = Q + T * (V + after) / 2.0
    state, r, found = sample(q, V, (push, push), (control, control), mu=mu)
    assert_allclose(state, [*q, *after], atol=2e-5)
    assert_allclose(r, 0.0, atol=1e-3)
    assert found == pytest.approx(mu, abs=1e-6)


def test_a_contact_that_has_not_slid_yet_sticks_whatever_friction_that_needs():
    """No speed along the wall, and across it that of the forces with this friction; to round-off.

    A control of 30 N m would accelerate the tool by 30 m/s^2.
    """
    push, control, still = 20.0, np.array([30.0, 0.0]), np.zeros(2)
    known = numbers("two_link", Q, still)
    total = control - known.bias + known.constraint_jacobian[0] * push
    slides = known.output_jacobian[0]
    inverse = np.linalg.inv(known.mass)
    friction = -slides * (slides @ inverse @ total) / (slides @ inverse @ slides)
    after = T * inverse @ (total + friction)
    q = Q + T * after / 2.0
    state, r, mu = sample(q, still, (push, push), (control, control), slid=0.0)
    assert_allclose(state, [*q, *after], atol=1e-12)
    assert abs(slides @ state[2:]) < 1e-12
    assert abs(slides @ inverse @ total) > 10.0
    assert_allclose(r, 0.0, atol=1e-9)
    assert mu == 0.0


def test_a_displacement_beyond_noise_is_a_break_away_and_what_is_less_is_none():
    """3 and 5 standard deviations of 1e-4 rad; a speed is found, and across the wall none."""
    push, control, still = 20.0, np.zeros(2), np.zeros(2)
    known = numbers("two_link", Q, still)
    slides, inverse = known.output_jacobian[0], np.linalg.inv(known.mass)
    total = -known.bias + known.constraint_jacobian[0] * push
    friction = -slides * (slides @ inverse @ total) / (slides @ inverse @ slides)
    at_rest = Q + T**2 / 2.0 * inverse @ (total + friction)
    J = known.constraint_jacobian[0]
    along = np.array([-J[1], J[0]])
    along /= slides @ along
    deviation = 1e-4 * np.linalg.norm(slides)
    usual = gain(RATES.rate)[1]
    for size, breaks in ((3.0, False), (5.0, True)):
        measured = at_rest + size * deviation * along
        state, _, _ = sample(measured, still, (push, push), (control, control), slid=0.0)
        speed = slides @ state[2:]
        if breaks:
            assert speed > 2.0 * usual * size * deviation
        else:
            assert speed == pytest.approx(usual * size * deviation, rel=1e-6)


def test_a_force_below_zero_by_noise_is_hardly_a_friction():
    """-0.2 N with a friction of 0.4, as in free motion; what stops the tool was taken for it once.

    It makes 1e-4 rad/s at most.
    """
    control, noise = np.zeros(2), -0.2
    q, v = predicted(V, noise, control, 0.0)
    state, _, _ = sample(q, V, (noise, noise), (control, control), mu=0.4)
    assert_allclose(state, [*q, *v], atol=1e-4)


def test_the_first_sample_takes_what_is_measured():
    """Also where nothing is held yet: the arm at zero angles is stretched against its wall."""
    system = law().system
    block = StateEstimator(law(), RATES, T, 0.0, 0.0, 0.0, 1e-4).block
    memory = block.held["memory"]
    given = {
        "time": [0.0],
        "held memory": memory.start,
        "input measured_state": [*Q, *V],
        "input measured_force": [20.0],
        "input control": [60.0, 40.0],
        "input hold": [0.0],
        "input reference": np.zeros(law().layout.reference_size),
        "parameters": system.parameter_values,
    }
    outputs = [block.outputs["estimated_state"], memory.next]
    function = ca.Function("first", [*block.columns().values()], outputs)
    state, after = (v.full().ravel() for v in function(*(given[n] for n in block.columns())))
    assert_allclose(state, [*Q, *V], rtol=0, atol=0)
    assert np.all(np.isfinite(after))


def test_friction_of_joints_is_compensated_at_wanted_velocities_where_it_is_estimated():
    """What the law adds for friction is then no feedback of velocities, which could be unstable.

    Coulomb friction is fully developed in both motions, so that viscous friction alone differs.
    """
    found = arm("two_link")
    viscous = np.array([0.7, 0.4])
    friction = JointFriction(["joint1", "joint2"], [0.3, 0.2], viscous, stiction_tolerance=1e-6)
    wall = replace(found.model.constraints[0], friction=0.0)
    model = RobotModel(
        found.model.links, [wall], found.model.outputs, [1.2, -1.6], known_forces=[friction]
    )
    names = [signal.name for signal in model.links.velocity_signals]
    named = ["joint1.coulomb", "joint2.coulomb", "joint1.viscous"]
    law = TrackingLaw(with_disturbance(model.dae, names, named), poles(-4.0), measured_force=True)
    ranges = dict.fromkeys(named, 1.0)
    block = StateEstimator(law, Observing(20.0, ranges=ranges), T).block
    known = numbers("two_link", Q, V)
    slides = np.vstack([known.output_jacobian, known.constraint_jacobian])
    wanted = np.linalg.solve(slides, [0.4, 0.0])
    now = 0.5 * wanted
    reference = np.zeros(law.layout.reference_size)
    reference[:2] = known.outputs[0], 0.4
    given = {
        "time": [T],
        "input measured_state": [*Q, *now],
        "input measured_force": [5.0],
        "input reference": reference,
        "parameters": law.system.parameter_values,
    } | {f"held {name}": held.start for name, held in block.held.items()}
    columns = block.columns()
    function = ca.Function("law", [*columns.values()], [block.outputs["exogenous"]])
    values = [given.get(name, np.zeros(symbol.shape)) for name, symbol in columns.items()]
    disturbance = function(*values).full().ravel()[len(named) :]
    # The law cancels d v of its model itself; this changes it to d times the wanted velocity.
    assert_allclose(disturbance, [-viscous[0] * (wanted - now)[0], 0.0], rtol=1e-6, atol=1e-9)
