"""Tasks that cannot be done as they are written: what is told before they run."""

import re

import numpy as np
import pytest
from arms import numbers, parse
from numpy.testing import assert_allclose
from runs import scenario

from drake_dae import build_scenario, load_scenario
from drake_dae.cli import main
from drake_dae.errors import ScenarioError
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.feasibility.feasibility import find_feasibility
from drake_dae.scenario.feasibility.holes import misfit
from drake_dae.scenario.model import completed_model

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


def test_a_start_behind_the_surface_is_refused_on_contact_that_gives_way(file):
    """Where the tool is by MultibodyPlant.

    With 1e4 N/m the force that counts as none, 0.5 N, presses it in by 0.05 mm.
    """
    soft = "plant=!CompliantContact {time_step: 0.001, stiffness: 1.0e4}"
    settings = [soft, "sampling={period: 0.001, delay: 0.001}"]
    wall = "constraints.0.surface.point=[{}, 0, 0]"
    plant = parse("two_link_arm")
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, [1.1653, -1.8326])
    reach = plant.GetFrameByName("tool").CalcPoseInWorld(context).translation()[0]
    inside = load_scenario(file, [*settings, wall.format(reach - 0.01)])
    with pytest.raises(
        ScenarioError,
        match=r"start\.positions put the point of 'wall' 0\.01 m behind .* Approach begins in fr",
    ):
        build_scenario(inside)
    with pytest.raises(ScenarioError, match=r"'wall' 0\.01 m behind its surface"):
        find_feasibility(inside)
    build_scenario(load_scenario(file, [*settings, wall.format(reach - 0.00003)]))
    with pytest.raises(ScenarioError, match="behind its surface"):
        build_scenario(load_scenario(file, [*settings, wall.format(reach - 0.00008)]))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            ["task.phases.4.depth=0.021"],
            r"task\.phases: Insert is 0\.021 m deep, and the peg of 'wall' \(plant\.pegs\) is 0\.",
        ),
        (
            ["plant.pegs=[]", "task.phases.4.depth=0.032"],
            r"task\.phases: Insert is 0\.032 m deep, and the tool is a ball .* 0\.03 m below",
        ),
    ],
)
def test_an_insertion_ends_where_its_tool_ends(settings, message):
    chosen = scenario("peg_in_hole", *settings)
    with pytest.raises(ScenarioError, match=message):
        build_scenario(chosen)
    with pytest.raises(ScenarioError, match=message):
        find_feasibility(chosen)


@pytest.mark.slow
def test_a_tool_that_is_thicker_than_its_hole_is_told():
    """A longer peg may pass the plate of 30 mm, and an equal one has no clearance."""
    text = r"Insert cannot enter the hole of 'wall': its radius is 0\.005 m, and that of the "
    for settings, message in (
        (["plant.pegs.0.length=0.05", "task.phases.4.depth=0.04"], "^$"),
        (["plant.pegs=[]", "plant.radius=0.006"], text + r"ball .* \(plant\.radius\) is 0\.006 m"),
    ):
        completed, model = completed_model(scenario("peg_in_hole", *settings))
        assert re.search(message, misfit(completed.scenario, model)), settings
    thick = scenario("peg_in_hole", "plant.pegs.0.radius=0.005", "duration=0.1")
    told = text + r"peg \(plant\.pegs\) is 0\.005 m"
    assert re.search(told, "\n".join(build_completed(thick)[0].notes))


@pytest.mark.slow
@pytest.mark.thorough
def test_a_tool_that_is_thicker_than_its_hole_is_a_problem():
    thick = scenario("peg_in_hole", "plant.pegs.0.radius=0.005", "duration=0.1")
    assert re.search("Insert cannot enter the hole", "\n".join(find_feasibility(thick).problems))


GUARDED = (
    "task.phases=[!Approach {speed: 0.1, over: 0.1}, !Press {force: 10, over: 0.1}, "
    "!Move {references: {tool.z: 0.35, wall.force: 10}, duration: 0.4, over: 0.2, "
    "guards: [{of: travel, most: 0.01}], on_failure: away}, !Release {}, "
    "!Retreat {name: away, distance: 0.01, over: 0.1}]"
)


@pytest.mark.parametrize(
    ("settings", "outcome"),
    [
        ([], r"the task was done at \S+ s, in 4 phases"),
        (["duration=0.5"], "the run ended during phase 5, away"),
    ],
)
def test_analysis_tells_which_guard_ends_a_phase(file, settings, outcome):
    needs = find_feasibility(load_scenario(file, [GUARDED, *settings])).task
    after = r".*; at 0\.4\d* s Move is ended by a travel of 0.01\S* m, .* away followed, as chosen"
    assert re.search(outcome + after, needs.outcome), needs.outcome


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "is_known"), [("", False), ("0.3", True)])
def test_friction_that_the_law_does_not_know_is_a_reason(
    file, friction, is_known, tmp_path, capsys
):
    """It pulls the tool back while it moves along the wall."""
    settings = [
        "plant=!MultibodyPlant {stiffness: 1.0e5, friction: 0.3}",
        "task.phases=[!Approach {}, !Press {force: 10}, "
        "!Move {references: {tool.z: 0.3, wall.force: 10}, duration: 0.5}]",
        "duration=2",
        *([f"constraints.0.friction={friction}"] if friction else []),
    ]
    command = ["simulate", str(file), "--out", str(tmp_path / "run"), "--rollout"]
    main([*command, *(part for text in settings for part in ("--set", text))])
    told = " ".join(capsys.readouterr().out.split())
    assert "Likely because" in told
    assert ("friction that the law does not know" in told) is not is_known
