"""Tasks in scenario files: told, touching, on a wall that moves, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from arms import parse
from runs import some
from scenario_texts import task_text

from drake_dae import build_scenario, load_scenario, shipped_model
from drake_dae.cli import main
from drake_dae.errors import ScenarioError
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.judging import find_feasibility
from drake_dae.scenario.rolled import roll_scenario
from drake_dae.scenario.start import start_scenario

SHORT = task_text("""
  - !Approach {speed: 0.1, over: 0.1}
  - !Press {force: 10, over: 0.1}
  - !Move {references: {tool.z: 0.31, wall.force: 12}, duration: 0.2, over: 0.2}
""")


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    return path


@pytest.mark.slow
def test_command_runs_a_task_in_drakes_own_contact(file, tmp_path, capsys):
    """Its animation tells the phases."""
    words = ["--set", "plant=!MultibodyPlant {radius: 1.0e-5}", "--set", "duration=0.3"]
    assert main(["simulate", str(file), *words, "--out", str(tmp_path / "run")]) == 0
    told = capsys.readouterr().out
    assert "wall.distance" in told
    assert "\n0 s: Approach, " in told
    assert ": Press, " in told
    page = (tmp_path / "run" / "animation.html").read_text()
    assert '"phases": [[0.0, "Approach"], [0.' in page


def test_analysis_of_a_task_knows_its_robot(file):
    """Not its motion."""
    found = find_feasibility(load_scenario(file))
    assert found.problems == ()
    assert found.analysis.structure is not None


@pytest.mark.slow
@pytest.mark.parametrize("mass", some([None, 5.0]))
def test_a_touch_lasts_up_to_the_computed_speed(file, mass):
    """The speed, without a bounce, is a quarter of that at which the contact opens again, or more.

    A touch that falls between samples is felt with a force of up to k v T, which helps to keep the
    contact; so the computed speed may be below the largest one, and is not above it.
    """
    settings = ["law.constraint_damping=null", "law.gains=null"]
    settings += ["task.gains=null", "task.phases.0.speed=null", "duration=1.5"]
    settings.append("constraints.0.surface.point=[1.183, 0, 0]")  # 3 mm before it
    if mass:
        settings.append(f"robot.payloads=[{{frame: tool, mass: {mass}}}]")
    computed = build_completed(load_scenario(file, settings))[0].scenario.task.phases[0].speed
    assert 1e-3 < computed < 0.049  # Less than the default.

    def least_force(speed):
        completed, loop = build_completed(
            load_scenario(file, [*settings, f"task.phases.0.speed={speed}", "task.retries=0"])
        )
        context = start_scenario(completed.scenario, loop)
        rolled = roll_scenario(completed.scenario, loop, context)
        changes = loop.changes(rolled.record)
        touched = changes[1].time
        near = (rolled.record.time >= touched) & (rolled.record.time < touched + 0.4)
        return rolled.record["constraint_force"][near, 0].min()

    assert least_force(computed) > 0.0
    assert least_force(4.0 * computed) == 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("task.phases=[]", "task: "),
        ("task.phases.0.speed=-1", r"task\.phases\.0: .*speed.*-1"),
        ("task.phases.1.if_lost=wait", r"Press: if_lost: .*'wait'"),
        ("task.phases.2.references={tool.x: 1}", r"Move: .*'tool\.x'"),
        ("task.contact=floor", r"task\.contact: 'floor'"),
        ("task.gains={all: [5]}", r"task\.gains: .*Hurwitz"),
        ("references={tool.z: 0.3}", "references: "),
        ("start.errors={tool.z: 0.1}", r"start\.errors: "),
        ("law.integral=[wall.force]", "integral: .*wall.force"),
    ],
)
def test_what_does_not_fit_is_named_by_its_key(file, change, message):
    with pytest.raises(ScenarioError, match=message):
        build_scenario(load_scenario(file, [change]))


def test_a_task_does_not_start_outside_of_limits(tmp_path):
    """A joint stands at 0 where nothing is said of it."""
    urdf = Path(shipped_model("two_link_arm.urdf")).read_text()
    limits = 'lower="-3.1416" upper="3.1416"'
    assert limits in urdf
    (tmp_path / "bent.urdf").write_text(urdf.replace(limits, 'lower="0.5" upper="3.1416"'))
    words = SHORT.replace("package://drake_dae_models/two_link_arm.urdf", "bent.urdf")
    file = tmp_path / "bent.yaml"
    file.write_text(words)
    build_scenario(load_scenario(file))
    file.write_text(words.replace("joint1: 1.1653, ", ""))
    with pytest.raises(ScenarioError, match=r"start: .*joint1 = 0 rad"):
        build_scenario(load_scenario(file))


MOVING = """
robot: {file: package://drake_dae_models/two_link_arm.urdf}
constraints:
- {name: wall, frame: tool, surface: !Plane {point: [1.2, 0, 0], normal: [-1, 0, 0]}}
outputs: [{frame: tool, axes: z}]
law:
  gains: !Poles {all: [-20]}
  constraint_damping: !Poles {all: [-250]}
exogenous:
  wall.position: [!Sinusoids {offset: 1.2, amplitudes: [0.02], frequencies: [3.0]}, 0, 0]
plant: !CompliantContact {radius: 1.0e-5}
task:
  phases:
  - !Approach {speed: 0.03}
  - !Press {force: 15.0}
  - !Move {references: {tool.z: 0.4, wall.force: 20}, duration: 1.0, over: 0.5}
  - !Release {}
  - !Retreat {distance: 0.03}
start: {positions: {joint1: 1.1653, joint2: -1.8326}}
duration: 4.5
"""


@pytest.fixture
def moving(file):
    file.write_text(MOVING)
    return file


@pytest.mark.slow
def test_a_task_follows_a_wall_that_moves(moving):
    """The places of tool and wall by MultibodyPlant and by the sine.

    20 N press it 0.2 mm into the wall, of 1e5 N/m; its steps of 1 ms leave some 10 um.
    """
    chosen = load_scenario(moving)
    loop, context = build_scenario(chosen)
    done = roll_scenario(chosen, loop, context)
    record, changes = done.record, loop.changes(done.record)
    names = ["Approach", "Press", "Move", "Release", "Retreat", "done"]
    assert [change.phase for change in changes] == names
    plant = parse("two_link_arm")
    own, frame = plant.CreateDefaultContext(), plant.GetFrameByName("tool")
    places = []
    for state in record["state"]:
        plant.SetPositions(own, state[: plant.num_positions()])
        places.append(frame.CalcPoseInWorld(own).translation()[0])
    gap = 1.2 + 0.02 * np.sin(3.0 * record.time) - np.array(places)
    touch, leave, end = changes[1].time, changes[4].time, changes[5].time
    touches = (record.time > touch) & (record.time < leave)
    pressed = record["constraint_force"][touches, 0] / 1e5
    np.testing.assert_allclose(gap[touches], -pressed, atol=1e-5)
    moves = (record.time > changes[2].time + 0.7) & (record.time < changes[3].time)
    np.testing.assert_allclose(record["tracking_error"][moves, 1], 0.0, atol=0.5)
    np.testing.assert_allclose(gap[record.time > end], 0.03, atol=5e-5)
    np.testing.assert_allclose(record["distance"][:, 0], gap, atol=1e-9)
    # The speed of the touch is that towards the wall as it moves.
    approach = (record.time > 0.8) & (record.time < touch)
    np.testing.assert_allclose(
        np.diff(gap[approach]) / np.diff(record.time[approach]), -0.03, atol=5e-3
    )


def test_a_task_does_not_begin_at_rest_on_a_wall_that_moves(moving):
    chosen = load_scenario(moving, ["task.phases=[!Press {force: 15}]"])
    with pytest.raises(ScenarioError, match="task"):
        build_scenario(chosen)
