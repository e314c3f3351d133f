"""The place of a surface from the depth to which a force presses a tool into it."""

import casadi as ca
import numpy as np
import pytest

from drake_dae import DaeSystem
from drake_dae.dae import IdentifiedTerms, Parameter
from drake_dae.dae.disturbance import estimated_within
from drake_dae.systems.estimator_parameters import FADING, ParameterFilter, _pushes

RATE, PERIOD, PLACE = 20.0, 0.002, 3e-3


def filter_of(place, distance):
    """A filter of the place of a surface, and its step: (state, x, force) -> state."""
    x, force, none = ca.SX.sym("x", 2), ca.SX.sym("force", 1), ca.SX(0, 1)
    k, still = distance(place.symbol, x), ca.SX(1, 1)
    body = DaeSystem(
        *(x, ca.vertcat(x[1], 0), ca.SX([0, -1]), ca.SX(2, 0), k, none, none), parameters=(place,)
    )
    motion = dict.fromkeys(("momentum", "drift", "inputs"), still)
    terms = IdentifiedTerms.of(body, (place,), motion, {"constraint_input": force})
    size = place.value.size
    within = estimated_within((place,), {})
    estimator = ParameterFilter(terms, within, 0, 1.0, RATE, PERIOD)
    theta = ca.SX.sym("theta", size)
    gap = distance(theta, x)
    gaps = gap, ca.jacobian(gap, theta), ca.hessian(gap, theta)[0]
    still, one = (ca.SX.zeros(1, 1), ca.SX.zeros(1, size)), ca.SX.ones(1, 1)
    held = estimator.after(theta, *still, one, gaps, force, force > 0.5, one)
    after = ca.vertcat(theta + held[:size], held)
    return estimator, ca.Function("step", [ca.vertcat(theta, estimator.held), x, force], [after])


def filter_of_a_wall():
    """A filter of the place of a wall within 10 mm, and its step."""
    place = Parameter("place", 0.0, "m", bounds=(-0.01, 0.01))
    return filter_of(place, lambda own, x: own - x[0])


def found(filter_and_step, times, states, forces):
    """The place and the compliances after samples."""
    estimator, step = filter_and_step
    size = estimator.change.numel()
    state = ca.DM([*np.zeros(size), *estimator.start])
    for time in times:
        state = step(state, states(time), forces(time))
    values = state.full().ravel()
    return np.array([*values[:size], *values[2 * size : 2 * size + 2]])


def found_place(depth):
    """The place of a wall after 5 s: a ramp to 10 N in the first second, then 5 to 35 N.

    The wall is at 3 mm; the tool is at 3 mm and the depth.
    """

    def force(time):
        return 10.0 * time if time < 1.0 else 20.0 + 15.0 * np.sin(4.0 * time)

    times = PERIOD * np.arange(2500)
    return found(filter_of_a_wall(), times, lambda t: [PLACE + depth(force(t)), 0.0], force)[0]


@pytest.mark.parametrize(
    ("depth", "tolerance"),
    [
        (lambda force: 0.0, 2e-6),
        (lambda force: 1e-5 * force, 1e-5),
        (lambda force: 2.5e-5 * force ** (2.0 / 3.0), 3.5e-5),
        (lambda force: 4.2e-5 * force**0.5, 6e-5),
    ],
    ids=["rigid", "spring", "Hertz", "layer"],
)
def test_a_wall_is_found_however_its_depth_grows_with_the_force(depth, tolerance):
    """A filter with the compliance of a spring alone leaves 0.1 um, 14 um, 51 um and 77 um.

    The depths are up to 0.35 mm.
    """
    assert abs(found_place(depth) - PLACE) < tolerance


def later(time):
    """10 N in the first second, then up to 25 N."""
    return 10.0 if time < 1.0 else 10.0 + min(1.0, time - 1.0) * (10.0 + 5.0 * np.sin(2.0 * time))


def test_a_rigid_wall_stays_where_it_is_when_its_force_rises_after_a_rest():
    """At rest neither compliance is known; then both are pushed to 0 at each sample.

    The wall is 3 mm farther than it is drawn, and found to 2 um, as above. Where one of them was
    clipped, its place went to its other bound, 10 mm.
    """
    times = PERIOD * np.arange(1500)
    values = found(filter_of_a_wall(), times, lambda t: [-PLACE, 0.0], later)
    assert abs(values[0] + PLACE) < 2e-6
    assert np.all(values[1:] > -1e-20)


def test_a_place_is_found_whose_slope_is_at_its_bound():
    """The height of a wall and its slope, where a tool moves to and fro by 10 mm, 0.1 m aside.

    The depths are off by 10 um; the wall is known to a few times that under the tool. Where the
    slope was clipped alone, height and slope went from bound to bound.
    """
    place = Parameter("place", [0.0, 0.0], "m", bounds=([-0.01, -0.1], [0.01, 0.1]))
    sloped = filter_of(place, lambda own, x: own[0] + own[1] * x[1] - x[0])

    def state(time):
        aside = 0.1 + 0.01 * np.sin(3.0 * time)
        return [PLACE - 0.1 * aside + 1e-5 * np.sin(37.0 * time), aside]

    values = found(sloped, PERIOD * np.arange(1500), state, later)
    assert abs(values[0] + 0.1 * values[1] - (PLACE - 0.01)) < 4e-5
    assert abs(values[1] + 0.1) < 1e-3


def test_two_numbers_are_pushed_to_zero_as_little_as_possible():
    """The conditions of Karush, Kuhn and Tucker, which have one solution."""
    c, B = ca.SX.sym("c", 2), ca.SX.sym("B", 2, 2)
    pushes = ca.Function("pushes", [c, B], [_pushes(c, B)])
    random = np.random.default_rng(3)
    for _ in range(300):
        numbers, root = random.standard_normal(2), random.standard_normal((2, 2))
        block = root @ root.T + 0.01 * np.eye(2)
        y = pushes(numbers, block).full().ravel()
        moved = numbers + block @ y
        least = 1e-12 * (1.0 + np.abs(block).max() * np.abs(y).max())
        assert np.all(y >= 0.0)
        assert np.all(moved >= -least)
        assert abs(y @ moved) <= least * (1.0 + np.abs(y).max())


def test_what_was_measured_fades_while_nothing_touches():
    """P' = (P - P^2 / P_0) / F is a logistic growth; steps of 2 ms in 10 s are off by 1e-3 at most.

    From a hundredth of the bounds' deviation: 0.0165 of it after F, 0.12 after 5 F.
    """
    estimator, step = filter_of_a_wall()
    state = ca.DM([0.0, *estimator.start])
    least, prior, place = 1e-4, 0.02**2 / 12.0, 1 + 1 + 2  # After theta, change, compliances.
    assert float(state[place]) == pytest.approx(prior)
    state[place] = least * prior
    after = step.mapaccum("run", round(FADING / PERIOD))
    for times in (1, 5):
        run = after if times == 1 else step.mapaccum("long", round(times * FADING / PERIOD))
        left = float(run(state, ca.DM([0.0, 0.0]), 0.0)[place, -1]) / prior
        assert left == pytest.approx(1.0 / (1.0 + (1.0 / least - 1.0) * np.exp(-times)), rel=1e-3)
