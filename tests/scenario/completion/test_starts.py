"""Where a robot starts: within its limits, without whole turns."""

from dataclasses import replace

import numpy as np
import pytest
from runs import some
from vendors import joint, link, robot

from drake_dae import build_scenario, load_scenario
from drake_dae.errors import ScenarioError
from drake_dae.scenario import complete_scenario

FAR = """
robot: {{file: {folder}/far.urdf, base: {{weld: base}}, actuators: all}}
constraints:
- {{frame: hand, surface: !Plane {{point: [0.3, 0, 0], normal: [-1, 0, 0]}}, name: wall}}
outputs: [!PointCoordinates {{frame: hand, axes: z}}]
law:
  gains: !Poles {{all: [-4.0]}}
references: {{hand.z: {z}, wall.force: 5.0}}
start: {{positions: {positions}}}
"""


def reaching(folder, z, positions, kind="revolute"):
    parts = [link(name, 1.0) for name in ("base", "upper", "lower", "hand")]
    joints = [
        joint("one", "base", "upper", "0 1 0", (0.0, 0.0, 0.0), kind),
        joint("two", "upper", "lower", "0 1 0", (0.0, 0.0, 0.4), kind),
        '<joint name="mount" type="fixed"><origin xyz="0 0 0.4"/><parent link="lower"/>'
        '<child link="hand"/></joint>',
    ]
    (folder / "far.urdf").write_text(robot("far", *parts, *joints))
    (folder / "far.yaml").write_text(FAR.format(folder=folder, z=z, positions=positions))
    return load_scenario(folder / "far.yaml")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["revolute", "continuous"])
@pytest.mark.parametrize("two", some([1e-4, 2.7], first=1))
def test_a_start_near_a_singular_guess_stays_within_limits(kind, two, tmp_path):
    """From a straight arm Newton's method goes far, and turns joints often."""
    scenario = reaching(tmp_path, 0.4, f"{{two: {two}}}", kind)
    completed = complete_scenario(scenario).scenario
    loop, context = build_scenario(completed)
    q = loop.plant.state(loop.plant.GetMyContextFromRoot(context))[:2]
    assert np.all(np.abs(q) < 2.9 if kind == "revolute" else np.abs(q) < 2 * np.pi)
    one, both = q[0], q.sum()
    reached = 0.4 * np.array([np.sin(one) + np.sin(both), np.cos(one) + np.cos(both)])
    np.testing.assert_allclose(reached, [0.3, 0.4], atol=1e-9)


CRANK = """
robot: {{file: {folder}/crank.urdf, base: {{weld: base}}, actuators: []}}
constraints:
- !RevoluteLoopJoint {{frame_a: rod, frame_b: slider, point_a: [0.5, 0, 0], axis: y, planar: true}}
start: {{positions: {{crank: {crank}, rod: {rod}, slide: {slide}}}}}
"""


@pytest.mark.parametrize(("crank", "rod", "slide"), [(-1.2, -0.46, -0.28), (2.28, 1.87, 0.1)])
def test_a_mechanism_without_drive_starts_within_a_turn_of_what_is_given(
    crank, rod, slide, tmp_path
):
    """Newton's method ends a whole turn of the crank, or of the rod, away from these."""
    parts = [link(name, 1.0) for name in ("base", "crank", "rod", "slider")]
    joints = [
        joint("crank", "base", "crank", "0 1 0", (0.0, 0.0, 0.0), "continuous"),
        joint("rod", "crank", "rod", "0 1 0", (0.2, 0.0, 0.0), "continuous"),
        joint("slide", "base", "slider", "1 0 0", (0.0, 0.0, 0.0), "prismatic"),
    ]
    (tmp_path / "crank.urdf").write_text(robot("crank", *parts, *joints))
    text = CRANK.format(folder=tmp_path, crank=crank, rod=rod, slide=slide)
    (tmp_path / "crank.yaml").write_text(text)
    loop, context = build_scenario(load_scenario(tmp_path / "crank.yaml"))
    q = loop.plant.state(loop.plant.GetMyContextFromRoot(context))[:3]
    assert np.all(np.abs(q[:2] - [crank, rod]) < np.pi)
    one, both = q[0], q[:2].sum()
    reached = [0.2 * np.cos(one) + 0.5 * np.cos(both), 0.2 * np.sin(one) + 0.5 * np.sin(both)]
    np.testing.assert_allclose(reached, [q[2], 0.0], atol=1e-9)


def test_a_start_outside_of_limits_is_refused(tmp_path):
    """Both postures that reach it turn joint one beyond a limit of 0.2 rad."""
    scenario = reaching(tmp_path, -0.4, "{one: 0.1, two: 0.1}")
    text = (tmp_path / "far.urdf").read_text()
    narrow = text.replace('lower="-2.9" upper="2.9"', 'lower="-0.2" upper="0.2"', 1)
    (tmp_path / "far.urdf").write_text(narrow)
    with pytest.raises(ScenarioError, match=r"start.*one = "):
        build_scenario(scenario)


def test_a_point_of_a_planar_arm_is_named_by_the_rows_that_move(tmp_path):
    """y of the hand is constant: one value is that of z."""
    scenario = reaching(tmp_path, 0.4, "{two: 0.3}")
    open_ = replace(scenario, outputs=[], references={"hand": 0.4, "wall.force": 5.0})
    named = complete_scenario(open_).scenario
    assert [output.axes for output in named.outputs] == ["z"]
    assert list(named.references) == ["hand", "wall.force"]
