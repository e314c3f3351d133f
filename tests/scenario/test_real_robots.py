"""Robots as vendors wrote them, from `drake-dae new` to a run that keeps its prediction."""

import sysconfig
from pathlib import Path

import numpy as np
import pytest
from runs import run_scenario

from drake_dae import load_scenario, new_scenario
from drake_dae.cli import main
from drake_dae.scenario import complete_scenario

FOLDER = Path(sysconfig.get_path("purelib"), "cmeel.prefix/share/example-robot-data/robots")

ROBOTS = {
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "ur10": "ur_description/urdf/ur10_robot.urdf",
    "kinova": "kinova_description/robots/kinova.urdf",
    "xarm7": "xarm_description/urdf/xarm7.urdf",
    "panda": "panda_description/urdf/panda.urdf",
    "z1": "z1_description/urdf/z1.urdf",
    "tiago": "tiago_description/robots/tiago.urdf",
    "so100": "so_arm_description/urdf/so100.urdf",
}

# Tiago's antennas have inertias that no body has; collisions are in .dae or .stl.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::drake_dae.errors.GeometryWarning"),
    pytest.mark.filterwarnings("ignore::drake_dae.errors.RobotFileWarning"),
]


DEAR = ("panda", "tiago", "so100", "ur10", "xarm7", "z1", "kinova")
"""They take long, or show what others do."""


@pytest.mark.parametrize(
    "name", [pytest.param(one, marks=[pytest.mark.thorough] * (one in DEAR)) for one in ROBOTS]
)
def test_a_robot_runs_as_predicted_on_a_surface_that_new_finds(name, tmp_path):
    file = tmp_path / "task.yaml"
    assert main(["new", str(FOLDER / ROBOTS[name]), "--out", str(file)]) == 0
    loop, _, record = run_scenario(
        load_scenario(file, ["duration=0.5", "integrator.accuracy=1e-9"])
    )
    off = np.abs(record["tracking_error"] - loop.predicted_error(record)).max()
    assert off < 1e-8  # Ten times the accuracy of a step, in m, rad and N.
    assert np.abs(record["constraint_residual"]).max() < 1e-8
    model = loop.plant.model
    assert np.all(np.abs(record["control"]) < model.control_limits)
    assert record["constraint_force"].min() > 0.0
    low, high = model.links.position_limits
    q = record["state"][:, : low.size]
    assert np.all((low < q) & (q < high))


def test_a_place_keeps_away_from_a_singular_wrist():
    """Where the best conditioned start is, friction of 0.5 would jam the contact along the path."""
    found = new_scenario(str(FOLDER / "ur_description/urdf/ur3_robot.urdf"), "sphere")[0]
    assert complete_scenario(found).critical_friction > 1.0
