"""The energies and lengths of shipped mechanisms are right."""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.math import RollPitchYaw
from runs import scenario
from scenario_texts import run

from drake_dae import Record

thorough = pytest.mark.thorough
NAMES = [
    "crank_turning",
    "conveyor",
    pytest.param("four_bar", marks=thorough),
    pytest.param("stewart_platform", marks=thorough),
]


@cache
def half_a_second(name: str) -> tuple:
    """A run in steps of 2 ms."""
    fixed = ["integrator.use_error_control=false", "integrator.max_step_size=0.002"]
    return run(scenario(name, "duration=0.5", *fixed))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_motors_give_the_energy_that_the_mechanism_gains(name):
    """By MultibodyPlant's energies; the trapezoidal rule leaves (2 ms)^2 of changes in power."""
    loop, record, _ = half_a_second(name)
    links = loop.plant.model.links
    plant = links.plant
    context = plant.CreateDefaultContext()
    energy, power = [], []
    for i, state in enumerate(record["state"]):
        plant.SetPositionsAndVelocities(context, state)
        energy.append(plant.CalcKineticEnergy(context) + plant.CalcPotentialEnergy(context))
        velocity = state[plant.num_positions() :]
        driven = plant.MakeActuationMatrix() @ record["control"][i]
        power.append(driven @ velocity + _lost(name, record, i, plant, context))
    work = np.concatenate(
        [[0.0], np.cumsum(np.diff(record.time) * (np.array(power)[1:] + power[:-1]) / 2)]
    )
    size = np.ptp(energy) + np.ptp(work)
    assert np.ptp(energy) > 1e-2
    assert_allclose(np.array(energy) - energy[0], work, atol=2e-4 * size)


def _lost(name, record: Record, i, plant, context) -> float:
    """The power of the crank's brake, 6 N m s/rad, and of the belt's friction, 0.3 of 12 N."""
    state = record["state"][i]
    if name == "crank_turning":
        return (
            -6.0
            * state[plant.num_positions() + plant.GetJointByName("crank").velocity_start()] ** 2
        )
    if name == "conveyor":
        tool = plant.GetFrameByName("tool").CalcSpatialVelocityInWorld(context).translational()
        names = [signal.name for signal in record.signals["exogenous"].signals]
        belt = record["exogenous"][i][names.index("belt.position[1]'")]
        slide = (tool - [0.0, belt, 0.0]) * [1.0, 1.0, 0.0]
        return float(-0.3 * 12.0 * slide / np.hypot(np.linalg.norm(slide), 1e-3) @ tool)
    return 0.0


@pytest.mark.slow
@thorough
def test_legs_of_the_stewart_platform_have_the_lengths_of_its_pose():
    """|p + R P_i - B_i|, from the angles of the joints alone; lengths of 0.7 m to round-off."""
    loop, record, _ = half_a_second("stewart_platform")
    q = loop.plant.model.links.plant
    base, top = np.radians([-10, 10, 110, 130, 230, 250]), np.radians([-50, 50, 70, 170, 190, 290])
    place = {name: q.GetJointByName(name).position_start() for name in ("platform", "leg1", "leg6")}
    for state in record["state"][::50]:
        pose = state[place["platform"] : place["platform"] + 6]
        for leg, joint in ((0, "leg1"), (5, "leg6")):
            foot = 0.45 * np.array([np.cos(base[leg]), np.sin(base[leg]), 0.0])
            ball = 0.25 * np.array([np.cos(top[leg]), np.sin(top[leg]), 0.0])
            end = pose[_XYZ] + RollPitchYaw(pose[_RPY]).ToRotationMatrix().matrix() @ ball
            # Coordinates in the robot's file have six decimals.
            assert np.linalg.norm(end - foot) == pytest.approx(0.5 + state[place[joint]], abs=2e-6)


_XYZ, _RPY = slice(3, 6), slice(0, 3)
"""Drake's RpyFloatingJoint: roll, pitch, yaw, then x, y, z."""
