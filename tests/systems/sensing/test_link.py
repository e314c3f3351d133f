"""Jitter and lost controls, against maps written by hand, moments, and rollouts."""

from statistics import NormalDist

import casadi as ca
import numpy as np
import pytest
from arms import error_controlled, fixed_step
from numpy.testing import assert_allclose
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.analysis import Simulator
from pydrake.systems.primitives import RandomSource
from runs import run, scenario

from drake_dae import (
    ConstantReference,
    DaePlant,
    DaeSystem,
    LoopSettings,
    Sampling,
    TrackingLaw,
    build_scenario,
    export_controller,
    make_closed_loop,
    poles,
    rollout,
    start_values,
)
from drake_dae.diagrams.drives import link_seed
from drake_dae.errors import ModelError, ScenarioError, SimulationError

K, T = 3.0, 0.05


def integrator():
    """x' = u, z = x."""
    x, none = ca.SX.sym("x"), ca.SX(0, 1)
    return DaeSystem(x, 0 * x, ca.SX(1, 0), ca.SX(1), none, x, ca.SX(1, 0), nominal_state=[1.0])


def started(sampling, seed=0):
    """The loop of x' = u behind u = -K x, from x = 1."""
    system = integrator()
    law, settings = TrackingLaw(system, poles(-K)), LoopSettings(sampling=sampling)
    loop = make_closed_loop(DaePlant(system), law, [ConstantReference(0.0)], settings)
    context = loop.diagram.CreateDefaultContext()
    if loop.link is not None:
        loop.link.set_seed(context, seed)
    return loop, context


def drawn(seed, count, rest):
    """The random numbers at k T + rest of a source that draws anew at each k T."""
    source = RandomSource(RandomDistribution.kGaussian, 2, T)
    context, values = source.CreateDefaultContext(), []
    source.SetRandomContext(context, RandomGenerator(link_seed(seed)))
    simulator = Simulator(source, context)
    for k in range(count):
        # At an instant of both, the link has the numbers of before, as Drake's rule is.
        if k or rest:
            simulator.AdvanceTo(k * T + rest)
        values.append(source.get_output_port().Eval(context).copy())
    return np.array(values)


def lost_by_hand(sampling, numbers):
    """Which controls are lost: with `loss` one, and the next burst - 1 with it."""
    level = NormalDist().inv_cdf(sampling.loss) if sampling.loss else -np.inf
    lost, left = [], 0
    for number in numbers[:, 1]:
        left = left - 1 if left > 1 else sampling.burst * (number < level)
        lost.append(left > 0)
    return np.array(lost)


def states_by_hand(sampling, numbers, lost, count):
    """x(k T): the control of t_i acts from t_i + delay on, or jitter later, or never."""
    lag = int(sampling.delay / T + 1e-9)
    arrivals = []
    for i in range(count):
        if not lost[i + lag]:
            late = sampling.jitter * (numbers[i + lag, 0] > 0.0)
            arrivals.append((i * T + sampling.delay + late, i))
    x, acting, now, states, controls = 1.0, -K, 0.0, [], []
    for k in range(count):
        states.append(x)
        controls.append(-K * x)
        while arrivals and arrivals[0][0] < (k + 1) * T - 1e-9:
            arrival, i = arrivals.pop(0)
            x += acting * (arrival - now)
            now, acting = arrival, controls[i]
        x += acting * ((k + 1) * T - now)
        now = (k + 1) * T
    return np.array(states)


def counted(lost):
    """The number of lost controls in a row after each of them."""
    counts, count = [], 0
    for is_lost in lost:
        count = count + 1 if is_lost else 0
        counts.append(count)
    return np.array(counts)


SAMPLINGS = {
    "jitter": Sampling(T, jitter=0.6 * T),
    "jitter beyond the next sample": Sampling(T, 1.4 * T, jitter=0.8 * T),
    "loss": Sampling(T, loss=0.3),
    "bursts behind a delay": Sampling(T, 0.3 * T, loss=0.2, burst=3),
    "both": Sampling(T, 2.2 * T, jitter=0.5 * T, loss=0.2, burst=2),
}


@pytest.mark.parametrize("name", SAMPLINGS)
def test_late_and_lost_controls_act_as_in_the_map_by_hand(name):
    """The control is constant between events, so that only round-off of 40 samples remains."""
    sampling, count, seed = SAMPLINGS[name], 40, 3
    loop, context = started(sampling, seed)
    record = run(loop, context, count * T, error_controlled(1e-10))
    numbers = drawn(seed, count + 3, sampling.rest)
    lost = lost_by_hand(sampling, numbers)
    late = numbers[:count, 0] > 0.0
    assert sampling.jitter == 0.0 or 5 < late.sum() < 35
    assert sampling.loss == 0.0 or 5 < lost[:count].sum() < 35
    rows = np.searchsorted(record.time, T * np.arange(count) - 1e-9)
    states = states_by_hand(sampling, numbers, lost, count)
    assert_allclose(record["state"][rows, 0], states, atol=1e-12)
    before = np.searchsorted(record.time, T * np.arange(1, count) - 1e-9)
    assert_allclose(record["lost_controls"][before, 0], counted(lost)[: count - 1])


@pytest.mark.parametrize("name", SAMPLINGS)
def test_a_rollout_loses_the_same_controls(name):
    """Both are exact between events, where the control is constant: round-off remains."""
    loop, context = started(SAMPLINGS[name])
    start, parameters = start_values(loop, context)
    times = np.linspace(0.0, 2.0, 401)  # With all events among them, so that both have their rows.
    seeds = [{"link_noise": link_seed(5)}]
    config = fixed_step(0.005)
    (rolled,) = rollout(loop, start, parameters, times, config=config, seeds=seeds)
    loop.link.set_seed(context, 5)
    record = run(loop, context, 2.0, config)
    rows = np.searchsorted(record.time, times - 1e-9)
    assert_allclose(record.time[rows], times, atol=1e-12)
    for signal in ("state", "control", "lost_controls"):
        assert_allclose(rolled.record[signal], record[signal][rows], atol=1e-12)
    assert np.ptp(record["state"]) > 0.5


@pytest.mark.slow
def test_moments_under_jitter_are_those_of_the_random_map():
    """x_(k+1) = x_k + e u_(k-1) + (T - e) u_k with e = 0 or j: E of x^2 by the Kronecker product.

    K T = 1.2 and j = 0.8 T: with either delay alone the map is stable. Of 4000 runs the mean of
    x^2 is within five of its standard deviations.
    """
    gain, jitter, count, runs = 1.2 / T, 0.8 * T, 12, 4000
    maps = [
        np.array([[1.0 - gain * (T - e), -gain * e], [1.0, 0.0]]) for e in (0.0, jitter)
    ]  # of (x_k, x_(k-1))
    second = sum(np.kron(a, a) for a in maps) / 2.0
    moments = [1.0]
    vector = np.kron([1.0, 1.0], [1.0, 1.0])
    for _ in range(count):
        vector = second @ vector
        moments.append(vector[0])
    system = integrator()
    law = TrackingLaw(system, poles(-gain))
    settings = LoopSettings(sampling=Sampling(T, jitter=jitter))
    loop = make_closed_loop(DaePlant(system), law, [ConstantReference(0.0)], settings)
    start, parameters = start_values(loop, loop.diagram.CreateDefaultContext())
    times = T * np.arange(count + 1)
    config = fixed_step(T)
    found = rollout(loop, start, parameters, times, config=config, seeds=list(range(runs)))
    squares = np.array([each.record["state"][:, 0] ** 2 for each in found])
    spread = squares.std(axis=0) / np.sqrt(runs)
    assert np.all(np.abs(squares.mean(axis=0) - moments) <= 5.0 * spread + 1e-12)
    assert squares[:, -1].std() > 0.1 * moments[-1]


def test_the_share_of_lost_controls_is_that_of_a_renewal_process():
    """A cycle has (1 - p) / p controls that arrive and n that do not: within five deviations."""
    p, n, count = 0.02, 5, 20_000
    sampling = Sampling(1e-3, loss=p, burst=n)
    loop, context = started(sampling)
    start, parameters = start_values(loop, context)
    times = np.linspace(0.0, 1e-3 * count, count + 1)
    config = fixed_step(1e-3)
    (rolled,) = rollout(loop, start, parameters, times, config=config, seeds=[1])
    lost = rolled.record["lost_controls"][1:, 0]
    share = n * p / (n * p + 1.0 - p)
    # Bursts are independent, so that the variance is about n times that of single ones.
    deviation = np.sqrt(n * share / count)
    assert abs(np.mean(lost > 0.5) - share) < 5.0 * deviation
    assert lost.max() >= n
    assert np.all(lost % 1.0 == 0.0)


def test_the_robot_stops_by_itself_where_too_many_controls_are_lost():
    """In both ways of running, at the sample that a count by hand gives."""
    sampling, seed = Sampling(T, 0.3 * T, loss=0.2, burst=2, most_lost=4), 3
    loop, context = started(sampling, seed)
    lost = lost_by_hand(sampling, drawn(seed, 400, sampling.rest))
    first = int(np.argmax(counted(lost) >= 4))
    assert 0 < first < 390
    start, parameters = start_values(loop, context)
    with pytest.raises(SimulationError, match=r"4 controls in a row were lost") as found:
        run(loop, context, 400 * T, error_controlled(1e-6))
    assert found.value.time == pytest.approx(first * T + sampling.rest, abs=1e-9)
    times, seeds = np.linspace(0.0, 400 * T, 401), [{"link_noise": link_seed(seed)}]
    (rolled,) = rollout(loop, start, parameters, times, seeds=seeds)
    assert str(rolled.failure) == str(found.value)
    assert_allclose(rolled.failure.state, found.value.state, atol=1e-9)


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ({"jitter": T}, "jitter"),
        ({"loss": 1.0}, "loss"),
        ({"burst": 0}, "burst"),
        ({"most_lost": 0}, "most_lost"),
        ({"seed": -1}, "seed"),
    ],
)
def test_numbers_of_a_link_that_make_no_sense_are_refused(numbers, text):
    with pytest.raises(ModelError, match=text):
        Sampling(T, **numbers)


@pytest.mark.slow
def test_jitter_on_a_discrete_plant_is_a_multiple_of_its_steps():
    """That plant takes controls at its steps alone, so that less would change nothing."""
    point = "sampling={period: 0.001, delay: 0.001, jitter: 0.0005}"
    with pytest.raises(ScenarioError, match=r"sampling: .*0\.001"):
        build_scenario(scenario("wall_point_contact", point))


def test_an_export_refuses_a_link_that_draws(tmp_path):
    loop, context = started(Sampling(T, loss=0.1))
    with pytest.raises(ModelError, match="'link_noise'"):
        export_controller(loop, context, "controller", tmp_path)
