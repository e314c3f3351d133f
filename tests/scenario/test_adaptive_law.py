"""The key `law: !Adaptive` of a scenario."""

import sysconfig
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from runs import roll, run_scenario, scenario

from drake_dae import build_scenario, load_scenario
from drake_dae.cli import main
from drake_dae.errors import ScenarioError
from drake_dae.scenario.rolled import roll_scenario

ROBOTS = "cmeel.prefix/share/example-robot-data/robots"

LAW = "law=!Adaptive {{parameters: {{link2.mass: 2.0}}{}}}"
HEAVY = "plant_parameters={link2.mass: 6.6}"
MEASURED = "force_feedback=!MeasuredForce {time_constant: 0.005}"
SAMPLED = "sampling={period: 1.0e-3}"
DRAKE = "plant=!CompliantContact {time_step: 0.001}"


def heavy(*settings: str, more: str = "", duration: float = 8.0):
    return scenario("two_link_wall", f"duration={duration}", HEAVY, LAW.format(more), *settings)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "more", "height", "force"),
    [
        ((), "", 1e-7, 1e-5),
        ((SAMPLED,), "", 6e-5, 0.02),
        ((MEASURED,), ", force_rate: 10.0", 1e-7, 0.06),
        ((DRAKE,), "", 6e-4, 0.2),
    ],
)
def test_it_learns_and_tracks(settings, more, height, force):
    """Without it 57 mm and 2.2 N; a measured force lags, and Drake's contact adds 0.4 mm."""
    _, record = roll(heavy(*settings, more=more))
    late = np.abs(record["tracking_error"][record.time > 6.0]).max(axis=0)
    assert late[0] < height
    assert late[1] < force
    assert record["parameter_estimate"][-1] == pytest.approx([6.6], abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "positions", "force"),
    [((), 1e-8, 1e-6), (("plant=!CompliantContact {time_step: 0.001, friction: 0.0}",), 2e-4, 0.1)],
)
def test_seven_joints_with_a_tool_half_as_heavy_again(settings, positions, force):
    """Without it 56 mm and 5.5 N, on the ideal wall and on Drake's."""
    tool = "plant_parameters={tool.mass: 1.1}", "law=!Adaptive {parameters: {tool.mass: 2.0}}"
    _, record = roll(scenario("seven_joint_wall", "duration=8.0", *tool, *settings))
    late = np.abs(record["tracking_error"][record.time > 6.0]).max(axis=0)
    assert late[:-1].max() < positions
    assert late[-1] < force
    assert record["parameter_estimate"][-1] == pytest.approx([1.1], abs=1e-3)


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::drake_dae.errors.GeometryWarning")
@pytest.mark.parametrize(
    ("file", "mass", "value"),
    [
        ("ur_description/urdf/ur5_robot.urdf", "forearm_link.mass", 2.275),
        ("panda_description/urdf/panda.urdf", "panda_link4.mass", 3.587895),
    ],
)
def test_it_learns_the_mass_of_a_link_of_a_vendors_arm(file, mass, value, tmp_path):
    """A fifth heavier than its file says, on the task of `drake-dae new`, by rollout.

    What is left after 8 s is less than a hundredth of what the tracking law leaves, which stays.
    """
    task, robots = tmp_path / "task.yaml", Path(sysconfig.get_path("purelib"), ROBOTS)
    assert main(["new", str(robots / file), "--out", str(task)]) == 0
    heavy_link = f"plant_parameters={{{mass}: {1.2 * value}}}"
    late = []
    for settings in ((), ("gains=null", f"law=!Adaptive {{parameters: {{{mass}: 20.0}}}}")):
        chosen = load_scenario(task, [heavy_link, *settings])
        loop, context = build_scenario(chosen)
        (known,) = (one.value for one in loop.plant.dae.parameters if one.name == mass)
        assert known == pytest.approx([value])
        found = roll_scenario(chosen, loop, context)
        assert found.failure is None
        record = found.record
        late.append(np.abs(record["tracking_error"][record.time > 8.0]).max(axis=0))
    assert record["parameter_estimate"][-1] == pytest.approx([1.2 * value], rel=1e-3)
    # Positions along the surface, in m, and the force, in N.
    assert late[0][:2].max() > 1e-3
    assert late[1][:2].max() < 1e-2 * late[0][:2].max()
    assert late[1][-1] < 1e-2 * late[0][-1]


@pytest.mark.slow
def test_a_scenario_rolls_out():
    chosen = heavy(SAMPLED, duration=0.2)
    _, _, expected = run_scenario(chosen)
    loop, context = build_scenario(chosen)
    rolled = roll_scenario(chosen, loop, context)
    assert rolled.failure is None
    assert_allclose(rolled.record["state"][-1], expected["state"][-1], rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("settings", "more", "why"),
    [
        (("gains=!Poles {all: [-5.0]}",), "", "gains: an adaptive law does not use it"),
        (("integral=[tool.z]",), "", "integral: an adaptive law"),
        (("observer={rate: 5.0}", SAMPLED), "", "observer: an adaptive law"),
        ((), ", force_rate: 10.0", "force_feedback: .* needs !MeasuredForce"),
        ((MEASURED,), "", "exactly with a force_rate"),
        ((), ", rate: -1.0", "law: rate must be positive"),
    ],
)
def test_what_it_cannot_use_is_refused(settings, more, why):
    with pytest.raises(ScenarioError, match=why):
        build_scenario(heavy(*settings, more=more))


def test_an_unknown_parameter_is_refused_with_the_known_ones():
    chosen = scenario("two_link_wall", "law=!Adaptive {parameters: {link9.mass: 1.0}}")
    with pytest.raises(ScenarioError, match=r"law: .* no parameter 'link9.mass'; it has \[link1"):
        build_scenario(chosen)
