"""An insertion where there is no hole: it lags, fails, and pushes no more than it says."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.systems.analysis import SimulatorConfig
from runs import first_quick, scenario, some

from drake_dae import build_scenario, load_scenario, simulate
from drake_dae.errors import ScenarioError
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.rolled import roll_scenario
from drake_dae.scenario.start import start_scenario

# 20 mm before the wall, at rest.
TEXT = """
robot: {file: "package://drake_dae_models/two_link_arm.urdf"}
constraints:
- {name: wall, frame: tool, surface: !Plane {point: [1.2, 0, 0], normal: [-1, 0, 0]}}
outputs: [!PointCoordinates {frame: tool, axes: z}]
gains: !Poles {all: [-25]}
sampling: {period: 0.001}
task:
  gains: !Poles {all: [-8]}
  phases:
  - !Insert {depth: 0.01, speed: 0.04, lag: 0.005, over: 0.1, if_late: pull}
  - !Retreat {name: pull, distance: 0.01}
start: {positions: {joint1: 1.1653, joint2: -1.8326}}
duration: 2.5
integrator: {integration_scheme: runge_kutta3, max_step_size: 0.001, use_error_control: false}
"""


@pytest.mark.slow
@pytest.mark.parametrize("rolls", some(first_quick([True, False])))
def test_an_insertion_beside_its_hole_pushes_as_a_spring_and_damper(rolls, tmp_path):
    """F = m (p^2 e + 2 p v) where the tool rests and the reference goes on, m = 1 / (J M^-1 J^T).

    Exact except for the hold of the control over a sample, in which e moves on by 0.04 mm, 0.8 % of
    it.
    """
    (tmp_path / "insert.yaml").write_text(TEXT)
    completed, loop = build_completed(load_scenario(tmp_path / "insert.yaml"))
    context = start_scenario(completed.scenario, loop)
    if rolls:
        found = roll_scenario(completed.scenario, loop, context)
        record, changes = found.record, loop.changes(found.context)
    else:
        config = SimulatorConfig(max_step_size=0.001, use_error_control=False)
        simulate(loop.diagram, context, 2.5, config)
        record, changes = loop.record(context), loop.changes(context)
    assert [change.phase for change in changes] == ["Insert", "pull", "done"]
    assert changes[1].reason.startswith("Insert lags 0.005")
    assert (changes[1].chosen, changes[1].failed) == ("pull", True)
    row = np.searchsorted(record.time, changes[1].time - 1e-9)
    mass = 1.0 / loop.plant.structure.constraint_matrix(record["state"][row])[0, 0]
    lag = -record["desired_output"][row - 1, -1]
    assert_allclose(
        record["constraint_force"][row - 1, 0], mass * (64 * lag + 16 * 0.04), rtol=0.02
    )
    assert_allclose(
        record["controlled_output"][-1, 0], record["controlled_output"][0, 0], atol=1e-3
    )


def test_an_insertion_refuses_an_observer():
    """Given, or chosen together with the gains: both would cancel what the hole exerts."""
    for settings in (["observer={rate: 20}"], ["gains=null", "task.gains=null"]):
        with pytest.raises(ScenarioError, match="observer: an Insert lets the hole push"):
            build_scenario(scenario("peg_in_hole", *settings))
