"""A biped makes a step: a foot leaves the ground, comes down elsewhere, and carries again."""

import numpy as np
import pytest
from runs import run_scenario, scenario

WEIGHT = (20.0 + 2 * (5.0 + 2.5 + 1.0)) * 9.81


@pytest.fixture(scope="module")
def stepped():
    """The loop, and the record of all of it."""
    loop, _, record = run_scenario(scenario("biped_step"))
    return loop, record


@pytest.mark.slow
@pytest.mark.thorough
def test_a_foot_leaves_the_ground_and_carries_again_in_front_of_the_other(stepped):
    _, record = stepped
    time, force = record.time, record["constraint_force"][:, 0]
    names = [signal.name for signal in record.signals["controlled_output"].signals]
    foot = record["controlled_output"][:, names.index("rear::sole.x")]
    is_open = np.flatnonzero(record["mode"][:, 0] == 0)
    first, last = is_open[0], is_open[-1]
    assert 3.0 < time[last] - time[first] < 4.0
    assert np.all(force[is_open] == 0.0)
    assert foot[first] == pytest.approx(-0.3, abs=1e-4)
    assert foot[last] == pytest.approx(0.3, abs=1e-6)
    assert record["gap"].max() == pytest.approx(0.06, abs=1e-3)
    assert force[-1] == pytest.approx(120.0, abs=1e-6)


@pytest.mark.slow
@pytest.mark.thorough
def test_heel_and_toe_press_all_the_time_and_all_feet_carry_the_weight(stepped):
    """Newton's law of the whole robot at the end, where it rests: to round-off of 363 N."""
    _, record = stepped
    forces = record["constraint_force"]
    assert forces[:, 1:3].min() > 50.0
    assert np.abs(forces[:, 3]).max() < 0.1 * WEIGHT  # Friction of 0.1 would do.
    assert forces[-1, :3].sum() == pytest.approx(WEIGHT, abs=1e-6)


@pytest.mark.slow
@pytest.mark.thorough
def test_the_step_is_as_predicted_and_the_closed_contacts_are_kept(stepped):
    loop, record = stepped
    off = np.abs(record["tracking_error"] - loop.predicted_error(record))
    assert off.max() < 1e-6  # Accuracy 1e-8 of a step, over 11 s.
    assert np.abs(record["constraint_residual"][:, 1:]).max() < 1e-9
