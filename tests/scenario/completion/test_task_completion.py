"""Outputs and starts of scenarios with a task that gives neither."""

import pytest
from arms import tool_at_start
from numpy.testing import assert_allclose
from runs import some

from drake_dae import build_scenario, load_scenario
from drake_dae.errors import ScenarioError
from drake_dae.scenario import complete_scenario
from drake_dae.scenario.completion import BEFORE
from drake_dae.scenario.scenario import save_scenario

TEXT = """
robot: {{file: package://drake_dae_models/seven_joint_arm.dmd.yaml}}
constraints:
- {{name: wall, frame: tool, surface: {surface}}}
{more}
law:
  gains: !Poles {{all: [-20]}}
task:
  phases:
  - {first}
  - !Press {{force: 10}}
  - !Move {{references: {{{goals}, wall.force: 10}}, duration: 1}}
duration: 1
"""
PLANE = "!Plane {point: [0.7, 0, 0], normal: [-1, 0, 0]}"
SPHERE = "!Sphere {center: [0.5, 0, 0.2], radius: 0.25}"


def completed(
    tmp_path, surface=PLANE, first="!Approach {}", goals="tool.y: 0.1, tool.z: 0.5", more=""
):
    path = tmp_path / "task.yaml"
    path.write_text(TEXT.format(surface=surface, first=first, goals=goals, more=more))
    return complete_scenario(load_scenario(path))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("surface", "goals", "first", "place"),
    some(
        [
            (PLANE, "tool.y: 0.1, tool.z: 0.5", "!Approach {}", (0.7 - BEFORE, 0.1, 0.5)),
            (SPHERE, "tool.x: 0.5, tool.y: 0", "!Approach {}", (0.5, 0.0, 0.45 + BEFORE)),
            (PLANE, "tool.y: 0.1, tool.z: 0.5", "!Press {force: 5, name: first}", (0.7, 0.1, 0.5)),
        ]
    ),
)
def test_a_task_begins_before_its_surface(surface, goals, first, place, tmp_path):
    """The first goals and the distance, rounded as 1e-4 rad leave it."""
    found = completed(tmp_path, surface, first, goals)
    pose = tool_at_start(found.scenario)
    assert_allclose(pose.translation(), place, atol=2e-4)
    normal = {PLANE: [1, 0, 0], SPHERE: [0, 0, -1]}[surface]
    assert_allclose(pose.rotation().matrix()[:, 2], normal, atol=1e-3)
    assert "outputs completed by" in found.notes[0]
    assert found.notes[1].startswith("start found: {joint1")
    # As it is written it is complete, and runs.
    save_scenario(found.scenario, tmp_path / "whole.yaml")
    again = load_scenario(tmp_path / "whole.yaml")
    assert complete_scenario(again).notes == ()
    if surface == SPHERE:
        soft = ["plant=!CompliantContact {radius: 1.0e-5}"]
        build_scenario(load_scenario(tmp_path / "whole.yaml", soft))


def test_what_is_given_stays(tmp_path):
    more = "outputs: [{frame: tool, axes: yz}]\nstart: {positions: {joint2: 0.1, joint4: -1.9}}"
    found = completed(tmp_path, more=more).scenario
    assert found.start.positions == {"joint2": 0.1, "joint4": -1.9}
    assert found.outputs[0].axes == "yz"
    assert len(found.outputs) > 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goals": "tool.w: 0"}, r"task\.phases\.tool\.w: "),
        ({"goals": "tool.y: 5, tool.z: 0.5"}, "tool"),
    ],
)
def test_what_is_not_found_is_said(changes, message, tmp_path):
    with pytest.raises(ScenarioError, match=message):
        completed(tmp_path, **changes)
