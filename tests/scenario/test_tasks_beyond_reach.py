"""Tasks that no robot of their scenario can do: what is told before they run."""

import re

import numpy as np
import pytest
from arms import numbers
from numpy.testing import assert_allclose

from drake_dae import load_scenario
from drake_dae.scenario.feasibility.feasibility import find_feasibility

TEXT = """
robot: {file: package://drake_dae_models/two_link_arm.urdf}
constraints:
- name: wall
  frame: tool
  surface: {point: [1.2, 0, 0], normal: [-1, 0, 0]}
outputs:
- {frame: tool, axes: z}
gains: {all: [-25]}
task:
  phases:
  - !Approach {speed: 0.1, over: 0.1}
  - !Press {force: 10, over: 0.1}
start: {positions: {joint1: 1.1653, joint2: -1.8326}}
duration: 1.0
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "task.yaml"
    path.write_text(TEXT)
    return path


def test_a_force_that_no_drive_holds_ends_the_examination(file):
    """u = -J^T F at rest, by NumPy alone, in a row of which there is one each ms."""
    found = find_feasibility(load_scenario(file, ["task.phases.1.force=50000"]))
    text = "\n".join(found.problems)
    told = re.search(
        r"(joint\d)_motor cannot hold the forces of contact: at ([\d.]+) s they alone need "
        r"([\d.]+) N m of it, and its limit is 120 N m",
        text,
    )
    assert told, text
    needs = found.task
    assert needs.times[-1] == pytest.approx(float(told[2]), abs=1e-3)
    arm = numbers("two_link", *np.split(needs.states[-1], 2))
    force = needs.constraint_inputs[-1]
    pushed = arm.constraint_jacobian.T @ force
    drive = ("joint1", "joint2").index(told[1])
    assert_allclose(float(told[3]), abs(pushed[drive]), rtol=5e-4)  # its four digits
    assert float(told[3]) > 1.5 * 120.0
    assert needs.phases[-1].name == "Press"
