"""A run starts with the errors that its law sees, on the constraints that its plant has."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.math import RollPitchYaw
from runs import run_scenario
from vendors import joint, link, robot

from drake_dae import build_scenario, load_scenario
from drake_dae.cli import main

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


ARM = robot(
    "arm",
    *(link(name, 1.0) for name in ("base", "one", "end")),
    joint("first", "base", "one", "0 1 0", (0.0, 0.0, 0.0), limits=(-3, 3)),
    joint("second", "one", "end", "0 1 0", (0.0, 0.0, 1.0), limits=(-3, 3)),
)

MECHANISM = """
robot: {file: arm.urdf, base: {weld: base}, actuators: []}
constraints:
- {frame: end, point: [0, 0, 1], surface: !Plane {point: [0.8, 0, 0], normal: [-1, 0, 0]}}
start: {positions: {first: 0.9, second: -0.7}, velocities: {first_w: 0.8}}
integrator: {accuracy: 1.0e-10}
"""


def test_a_mechanism_without_drive_starts_in_motion_and_keeps_its_energy(tmp_path):
    """By MultibodyPlant's energies: an ideal constraint does no work, and no motor is there."""
    (tmp_path / "arm.urdf").write_text(ARM)
    (tmp_path / "mechanism.yaml").write_text(MECHANISM)
    chosen = load_scenario(tmp_path / "mechanism.yaml", ["duration=0.4"])
    loop, _, record = run_scenario(chosen)
    links = loop.plant.model.links
    energies = []
    for state in record["state"]:
        at_links = links.plant.CreateDefaultContext()
        links.plant.SetPositionsAndVelocities(at_links, state)
        energy = links.plant.CalcKineticEnergy(at_links)
        energies.append(energy + links.plant.CalcPotentialEnergy(at_links))
    assert record["state"][0, 2] == 0.8
    assert np.ptp(record["state"][:, 2]) > 1.0
    assert_allclose(energies, energies[0], atol=1e-7)  # Of 30 J; steps of 1e-10 of the states.
    assert record["control"].shape[1] == record["tracking_error"].shape[1] == 0
    assert np.abs(record["constraint_residual"]).max() < 1e-7


def test_what_needs_a_law_says_that_a_mechanism_has_none(tmp_path, capsys):
    (tmp_path / "arm.urdf").write_text(ARM)
    (tmp_path / "mechanism.yaml").write_text(MECHANISM)
    assert main(["analyze", str(tmp_path / "mechanism.yaml")]) == 1
    assert "robot.actuators" in capsys.readouterr().err
