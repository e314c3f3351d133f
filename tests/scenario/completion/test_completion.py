"""Outputs that complete those of a scenario, and starts that are found."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from arms import arm, tool_at_start
from pydrake.multibody.tree import JacobianWrtVariable
from runs import run_scenario, scenario, scenario_model

from drake_dae import (
    CircleReference,
    ConstantReference,
    ForceCombination,
    JointPositions,
    PointCoordinates,
    build_scenario,
    load_scenario,
)
from drake_dae.errors import ScenarioError
from drake_dae.robots import Touch
from drake_dae.scenario import complete_scenario
from drake_dae.scenario.parts import Start
from drake_dae.scenario.postures import Postures, tool_axis
from drake_dae.scenario.scenario import TiltFromNormalForm, save_scenario

# tool.z = 0.35 m on the wall at 1.2 m, by the law of cosines with two links of 1 m.
REACH = np.hypot(1.2, 0.35)
HELD = np.arctan2(0.35, 1.2) + np.arccos(REACH / 2), -2 * np.arccos(REACH / 2)

FORCE = ConstantReference((20.0,))


def left_out(name="seven_joint_wall", **changes):
    """A shipped scenario without outputs and start; its references are force alone."""
    open_ = {"outputs": [], "start": Start(), "references": {"wall.force": FORCE}}
    return replace(scenario(name), **(open_ | changes))


def names(completed):
    return [s.name for s in scenario_model(completed.scenario).position_signals]


def test_the_arm_on_the_wall_gets_the_outputs_and_the_start_that_were_chosen_by_hand():
    """They are those of the shipped file: the elbow and the hand of the redundant arm are held."""
    by_hand = scenario("seven_joint_wall")
    written = {name: by_hand.references[name] for name in ("tool.y", "tool.z")}
    open_ = left_out(references={**written, "wall.force": by_hand.references["wall.force"]})
    completed = complete_scenario(open_)
    assert completed.scenario.outputs == [
        PointCoordinates("tool", "yz"),
        TiltFromNormalForm("wall", "z", "xy"),
        JointPositions(["joint3", "joint7"]),
    ]
    found = completed.scenario.start.positions
    # Four decimals are written; the file's own numbers have as many.
    assert {k: v for k, v in found.items() if v} == pytest.approx(by_hand.start.positions, abs=2e-4)
    assert completed.notes[0].startswith("outputs completed by tool.y, tool.z, wall.tilt_x")
    assert completed.notes[1].startswith("start found: {joint1: 0, joint2: -0.1938")


@pytest.mark.slow
def test_a_completed_scenario_runs_as_predicted_and_reads_back_complete(tmp_path):
    completed = complete_scenario(left_out(duration=0.3)).scenario
    save_scenario(completed, tmp_path / "run.yaml")
    again = load_scenario(tmp_path / "run.yaml")
    assert again == completed
    assert complete_scenario(again).scenario is again
    errors = replace(again, start=replace(again.start, errors={"tool.y": 0.01}))
    loop, _, record = run_scenario(errors)
    off = np.abs(record["tracking_error"] - loop.predicted_error(record)).max(axis=0)
    assert off.max() < 1e-7  # The integrator's accuracy is 1e-8.


@pytest.mark.slow
def test_what_references_name_becomes_an_output():
    """A circle of the tool is along the surface; a joint that is named is steered."""
    circle = CircleReference([0.0, 0.6], 0.1, period=5.0)
    named = left_out(references={"tool": circle, "joint3": 0.2, "wall.force": FORCE})
    completed = complete_scenario(named)
    assert names(completed)[:3] == ["tool.y", "tool.z", "joint3"]
    assert completed.scenario.start.positions["joint3"] == 0.2
    place = tool_at_start(
        completed.scenario
    ).translation()  # Where the circle begins, with 1e-4 rad.
    np.testing.assert_allclose(place[1:], [0.1, 0.6], atol=2e-4)


def test_independence_is_the_angle_between_contact_and_output_in_the_metric_of_kinetic_energy():
    """For one output z and one contact x it is sqrt(1 - c^2), c = J M^-1 P^T of unit rows."""
    from drake_dae.robots import ConstraintSet, force_rows

    model = scenario_model(scenario("two_link_wall"))
    links, bound = model.links, ConstraintSet(model.constraints)
    height = model.outputs[0].expression(links)
    S = force_rows(model.forces, bound, links)
    q = np.array([1.2, -1.6])
    plant = links.plant
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    M = plant.CalcMassMatrixViaInverseDynamics(context)
    tool, world = plant.GetFrameByName("tool"), plant.world_frame()
    kind = JacobianWrtVariable.kV
    x, _, z = plant.CalcJacobianTranslationalVelocity(context, kind, tool, [0, 0, 0], world, world)
    c = x @ np.linalg.solve(M, z)
    c /= np.sqrt((x @ np.linalg.solve(M, x)) * (z @ np.linalg.solve(M, z)))
    for unit in (1.0, 1e3):  # In metres and in millimetres.
        posture = Postures(links, bound, unit * height, S, [], {}).at(q)
        assert posture.independence([0]) == pytest.approx(np.sqrt(1 - c**2), rel=1e-10)
    # Friction jams the contact where mu times the mobility across exceeds that along the normal.
    touch = model.constraints[0].touch(links)
    point, out = links.position("tool", touch.point), links.rotation("tool")[:, 2]
    posture = Postures(links, bound, point, S, [(touch, out)], {}).at(q)
    along, across = (x @ np.linalg.solve(M, row) for row in (x, z))
    critical = posture.critical_friction(0, range(3))
    assert critical == pytest.approx(along / abs(across), rel=1e-10)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        # The arm reaches 1.5 m at most from its shoulder.
        pytest.param(
            {"references": {"tool": ConstantReference([0.0, 3.0])}},
            "references: .*tool.z = 3",
            marks=pytest.mark.slow,
        ),
        ({"outputs": [PointCoordinates("tool", "y")]}, "references: missing: tool.y"),
        (
            {"references": {"tool": ConstantReference((0.0,) * 4), "wall.force": FORCE}},
            "references.tool: 4",
        ),
        ({"references": {f"joint{k}": 0.0 for k in range(1, 8)}}, "references: joint1"),
        ({"references": {"tol.y": 0.0, "wall.force": FORCE}}, "references.tol.y: "),
        (
            {
                "forces": ["wall.force", ForceCombination({"wall.force": 2.0}, "twice")],
                "references": {"wall.force": 10.0, "twice": 20.0},
            },
            "outputs or forces: .*wall.force, twice",
        ),
    ],
)
def test_references_that_fit_no_completion_are_refused(changes, message):
    with pytest.raises(ScenarioError, match=f"^{message}"):
        build_scenario(left_out(**changes))


def test_a_planar_arm_gets_the_direction_that_it_can_move_in():
    """Two joints on a wall leave one output, and y is none: the scenario as shipped comes out."""
    by_hand = scenario("two_link_wall")
    completed = complete_scenario(replace(by_hand, outputs=[])).scenario
    assert completed.outputs == by_hand.outputs
    assert completed.references == by_hand.references
    assert completed.start.positions == pytest.approx(
        dict(zip(("joint1", "joint2"), HELD, strict=True)), abs=1e-4
    )


def test_a_robot_that_is_only_simulated_gets_no_outputs():
    still = left_out("slider_crank", forces=[], references={})
    assert complete_scenario(still).scenario is still


@pytest.mark.parametrize(("axis", "sign"), [("x", 1.0), ("y", -1.0), ("z", 1.0)])
def test_a_tool_sticks_out_along_the_axis_that_leads_to_its_point(axis, sign):
    """From the last joint that moves, which is less than 1 m away from the frame."""
    links = arm("two_link").model.links
    point = [0.1, -0.2, 0.3]
    point["xyz".index(axis)] = 5.0 * sign
    touch = Touch("tool", tuple(point), ca.SX([0.0, 0.0, 1.0]), lambda place: place[2])
    assert tool_axis(links, touch) == ("xyz".index(axis), sign)
