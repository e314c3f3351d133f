"""Tasks in scenario files: the shipped one, its pictures, and what is refused."""

from pathlib import Path

import pytest
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


@pytest.mark.slow
def test_a_rollout_of_a_task_reports_its_phases(file, tmp_path, capsys):
    told = []
    for number, more in enumerate(([], ["--rollout"])):
        words = ["--set", "write.animation=false", "--out", str(tmp_path / f"run {number}")]
        assert main(["simulate", str(file), *words, *more]) == 0
        lines = capsys.readouterr().out.splitlines()
        (first,) = [i for i, line in enumerate(lines) if line.startswith("0 s: Approach")]
        told.append([line.split(";")[0] for line in lines[first : first + 4]])
    assert told[0] == told[1]
    assert ": done, after" in told[1][-1]


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
