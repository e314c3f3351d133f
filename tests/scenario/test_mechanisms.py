"""The energies of shipped mechanisms are right."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from runs import scenario
from scenario_texts import run

from drake_dae import Record

FIXED = ("integrator.use_error_control=false", "integrator.max_step_size=0.002", "duration=0.5")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["crank_turning", "conveyor", pytest.param("stewart_platform", marks=pytest.mark.thorough)],
)
def test_motors_give_the_energy_that_the_mechanism_gains(name):
    """By MultibodyPlant's energies; the trapezoidal rule leaves (2 ms)^2 of changes in power."""
    loop, record, _ = run(scenario(name, *FIXED))
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
