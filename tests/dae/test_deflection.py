"""Forces that change within a period of a compliant contact: the error is the predicted one."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from drake_dae import build_scenario, load_scenario, simulate
from drake_dae.errors import ScenarioError

STIFFNESS, DAMPING = 1e5, 50.0

CONTINUOUS = (
    f"plant=!CompliantContact {{time_step: 0, stiffness: {STIFFNESS}, dissipation: 0}}",
    "plant.radius=1.0e-5",
    f"law.constraint_damping=!Poles {{all: [-{DAMPING}]}}",
    "law.gains.all=[-8]",
    "start.errors.tool.z=0",
    "references.tool.z=0.3",
    "references.wall.force=!PointToPoint {start: [10], end: [40], start_time: 0.5, end_time: 0.55}",
    "integrator.integration_scheme=runge_kutta3",
    "integrator.max_step_size=2.0e-4",
    "integrator.use_error_control=false",
    "sampling=",
)


def force_errors(*settings: str):
    """Times and force errors of the two-link arm on an undamped contact, from 0.45 s on."""
    scenario = load_scenario("two_link_wall", [*CONTINUOUS, *settings])
    loop, context = build_scenario(scenario)
    simulate(loop.diagram, context, 0.7, scenario.integrator)
    record = loop.record(context)
    late = record.time > 0.45
    return record.time[late], record["tracking_error"][late, 1]


@pytest.mark.slow
def test_the_contact_follows_a_force_that_rises_within_a_period():
    """The start of 10 N decays with e^(-25 t) to 1e-4 N; without the deflection 6 N are left.

    The law is linear in 1 / k, and half of k leaves the opposite of that: the geometry changes by
    1e-3 of it.
    """
    _, errors = force_errors(f"law.contact_stiffness={STIFFNESS}")
    assert np.abs(errors).max() < 1e-3
    _, without = force_errors()
    assert np.abs(without).max() > 5.0
    _, half = force_errors(f"law.contact_stiffness={STIFFNESS / 2.0}")
    assert_allclose(half, -without, atol=6e-3)


@pytest.mark.parametrize(
    ("name", "stiffness", "message"),
    [
        ("two_link_wall", 0, "contact_stiffness"),
        ("two_link_flexible", 1e5, "joints"),
        ("wall_polish", 1e5, "contact_stiffness"),
    ],
)
def test_where_a_deflection_is_not_known_it_is_refused(name, stiffness, message):
    with pytest.raises(ScenarioError, match=message):
        build_scenario(load_scenario(name, [f"law.contact_stiffness={stiffness}"]))
