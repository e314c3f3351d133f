"""A scenario whose surface moves: the prediction, the picture, and wrong inputs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.math import RollPitchYaw
from recordings import animation

from drake_dae import build_scenario, load_scenario, make_animation, simulate
from drake_dae.scenario.shipped import find_scenario

NAME = "seven_joint_moving_plate"


def scenario(*settings):
    return load_scenario(find_scenario(NAME), list(settings))


@pytest.mark.slow
def test_position_and_force_follow_on_a_plate_that_moves():
    """Off the prediction by the integrator's accuracy of 1e-8 in each of some 100 steps.

    The plate heaves by 5 cm and tilts by 7 degrees; the tool is on it to round-off.
    """
    chosen = scenario("duration=2.5")
    loop, context = build_scenario(chosen)
    simulate(loop.diagram, context, chosen.duration, chosen.integrator)
    record = loop.record(context)
    off = np.abs(record["tracking_error"] - loop.predicted_error(record))
    assert np.max(off) < 1e-6
    assert np.max(np.abs(record["tracking_error"][0])) > 0.03
    names = [signal.name for signal in record.signals["exogenous"].signals]
    assert names[6:9] == ["plate.position[2]", "plate.position[2]'", "plate.position[2]''"]
    height = record["exogenous"][:, 6]
    assert_allclose(height, 0.4 + 0.05 * np.sin(2 * record.time), rtol=1e-14)
    assert np.max(np.abs(record["constraint_residual"])) < 1e-9  # Before each projection.


@pytest.mark.slow
def test_the_plate_moves_in_the_animation():
    chosen = scenario("duration=0.5")
    loop, context = build_scenario(chosen)
    simulate(loop.diagram, context, chosen.duration, chosen.integrator)
    found = animation(make_animation(loop, loop.record(context), context))
    position = found["/contact/plate/surface", "position"]
    assert_allclose(position.values[:, 2], 0.4 + 0.05 * np.sin(2 * position.times), atol=1e-4)
    roll = [
        RollPitchYaw(0.12 * np.sin(1.7 * t), 0.1 * np.sin(1.3 * t + 0.5), 0.0)
        for t in position.times
    ]
    turns = found["/contact/plate/surface", "quaternion"].values  # x, y, z, w
    wanted = np.array([r.ToQuaternion().wxyz()[[1, 2, 3, 0]] for r in roll])
    assert_allclose(turns, wanted, atol=1e-4)
