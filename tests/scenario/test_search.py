"""A search in contact: a dimple that the law does not know, and a wall without one."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from drake_dae import Search, load_scenario
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.rolled import roll_scenario
from drake_dae.scenario.start import start_scenario

# The arm of the other walls; its tool begins at y = 0 and z = 0.6 m.
TEXT = """
robot: {file: "package://drake_dae_models/seven_joint_arm.dmd.yaml"}
constraints:
- name: wall
  frame: tool
  surface: !ImplicitSurface
    function: "0.7 + depth*exp(-((y - 0.002)**2 + (z - 0.603)**2)/0.0015**2/2) - x"
    parameters: {depth: 0.0}
outputs:
- !PointCoordinates {frame: tool, axes: yz}
- !AxisCoordinates {frame: tool, axis: z, components: yz}
- !JointPositions {joints: [joint3, joint7]}
gains: {all: [-25]}
plant: !Unilateral {restitution: {wall: 0.0}}
sampling: {period: 0.002}
task:
  gains: {outputs: {wall.distance: [-5], "*": [-25]}}
  phases:
  - !Press {force: 5, over: 0.1}
  - !Search
    {outputs: tool.yz, radius: 0.006, depth: 0.0015, speed: 0.04, over: 0.1, on_failure: leave,
     on_success: stop}
start: {positions: {joint2: -0.1938, joint4: -1.936, joint6: 0.559}}
duration: 3.2
integrator: {integration_scheme: runge_kutta3, max_step_size: 0.002, use_error_control: false}
"""


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.parametrize("depth", [0.004, 0.0])
def test_a_search_ends_where_the_tool_falls_or_with_its_spiral(depth, tmp_path):
    """The dimple is deeper than 1.5 mm up to 2.1 mm from its middle."""
    (tmp_path / "search.yaml").write_text(TEXT)
    hole = f"plant_parameters={{wall.depth: {depth}}}"
    completed, loop = build_completed(load_scenario(tmp_path / "search.yaml", [hole]))
    context = start_scenario(completed.scenario, loop)
    found = roll_scenario(completed.scenario, loop, context)
    assert found.failure is None, found.failure
    changes, record = loop.changes(found.context), found.record
    names, began, ended = [change.phase for change in changes], changes[1].time, changes[2].time
    row = np.searchsorted(record.time, ended)
    place = record["controlled_output"][row, :2]
    if depth:
        assert names == ["Press", "Search", "held"]
        assert (changes[2].chosen, changes[2].failed) == ("stop", False)
        assert changes[2].reason == "after a fall of 0.0015 m"
        assert np.linalg.norm(place - [0.002, 0.603]) < 0.003
        return
    assert names == ["Press", "Search", "leave", "held"]
    assert changes[2].reason == "Search has come to 0.006 m without a fall of 0.0015 m"
    search = Search("tool.yz", 0.006, 0.0015, speed=0.04, over=0.1)
    wanted = began + search.path.travel.duration + 0.1
    assert_allclose(ended, np.ceil(wanted / 0.002 - 1e-6) * 0.002, atol=1e-9)
    # It lies on the spiral that began where the tool was: the way out is 6 mm.
    assert_allclose(np.linalg.norm(place - record["controlled_output"][0, :2]), 0.006, atol=2e-4)
    # Its turns are 2 mm apart: no place within is farther than that from the way.
    during = (record.time > began) & (record.time < ended)
    way = record["controlled_output"][during, :2] - record["controlled_output"][0, :2]
    turns, radii = np.meshgrid(np.arange(6.0), [0.0015, 0.003, 0.005])
    inside = np.stack([radii * np.cos(turns), radii * np.sin(turns)], axis=-1).reshape(-1, 2)
    assert max(np.linalg.norm(way - one, axis=1).min() for one in inside) < 0.0011
