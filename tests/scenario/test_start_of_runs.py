"""A run starts with the errors that its law sees, on the constraints that its plant has."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.math import RollPitchYaw

from drake_dae import build_scenario, load_scenario

TILT, PLACE = (0.0, 0.2, 0.0), (1.15, 0.0, 0.05)

TILTED = (
    "outputs=[!TiltFromNormal {constraint: wall, axis: z, components: x}]",
    "constraints.0.rpy=[0, 0, 0]",
    "references={wall.tilt_x: 0.3, wall.force: 20}",
    "start.errors={wall.tilt_x: 0.1}",
    f"plant.parameters.wall.rpy={list(TILT)}",
    f"plant.parameters.wall.position={list(PLACE)}",
)
OBSERVED = (
    "plant=!CompliantContact {time_step: 0.001, stiffness: 1.0e5}",
    "sampling={period: 0.001, delay: 0.001}",
    "sensors.force={sample_period: 0.001}",
    "estimator={rate: 20}",
)


@pytest.mark.parametrize("plant", [(), OBSERVED], ids=["ideal", "observed"])
def test_the_tilt_is_that_from_the_wall_of_the_law_on_the_wall_of_the_plant(plant):
    """Tip and tool by hand, from the two angles; 1e-9 is ten times what Newton's method leaves."""
    loop, context = build_scenario(load_scenario("two_link_wall", [*plant, *TILTED]))
    q1, q2, *rest = loop.plant.state(loop.plant.GetMyContextFromRoot(context))
    tip = np.array([np.cos(q1) + np.cos(q1 + q2), 0.0, np.sin(q1) + np.sin(q1 + q2)])
    normal = RollPitchYaw(TILT).ToRotationMatrix().matrix() @ [-1.0, 0.0, 0.0]
    assert abs((tip - PLACE) @ normal) < 1e-9
    across = np.array([np.sin(q1 + q2), 0.0, -np.cos(q1 + q2)])  # the tool's x axis
    assert_allclose(across @ [-1.0, 0.0, 0.0], 0.4, atol=1e-9)
    assert_allclose(rest, 0.0, atol=1e-9)
