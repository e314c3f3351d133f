"""Losing the contact on purpose, in every phase that touches: each task ends as it was chosen."""

import pytest

from drake_dae import (
    Dwell,
    Follow,
    GuardedMove,
    Insert,
    Move,
    Press,
    Release,
    Screw,
    Search,
    Wait,
    load_scenario,
)
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.rolled import roll_scenario
from drake_dae.scenario.start import start_scenario

TEXT = """
robot: {{file: package://drake_dae_models/two_link_arm.urdf}}
constraints:
- name: wall
  frame: tool
  surface: !Plate {{point: [1.2, 0, 0.3], normal: [-1, 0, 0], half_widths: [0.2, {half}]}}
  friction: 0.0
outputs:
- {{frame: tool, axes: z}}
sampling: {{period: 0.001, delay: 0.001}}
start: {{positions: {{joint1: 1.1653, joint2: -1.8326}}}}
plant: !CompliantContact {{radius: 1.0e-5, stiffness: 1.0e5, friction: 0.2}}
plant_disturbances: {pushes}
task:
  retries: 1
  patience: 0.05
  signals: {signals}
  phases:
  - !Approach {{speed: 0.02, over: 0.1, within: 6, on_failure: stop}}
  - !Press {{force: 10, over: 0.1, {ends}}}
  - {phase}
  - !Release {{over: 0.2, within: 3, on_failure: stop}}
  - !Retreat {{distance: 0.02, tolerance: 2.0e-3, within: 5, on_failure: stop}}
duration: 12
"""
ROBOT = """
<robot name="gantry">
  <link name="world"/>
  {parts}
</robot>
"""
PART = """
  <link name="{child}"><inertial><mass value="3"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01"
    iyz="0" izz="0.01"/></inertial></link>
  <joint name="{axis}" type="prismatic"><parent link="{parent}"/><child link="{child}"/>
    <axis xyz="{direction}"/><limit lower="-2" upper="2" effort="500" velocity="2"/></joint>
  <transmission name="{axis}"><type>transmission_interface/SimpleTransmission</type>
    <joint name="{axis}"/><actuator name="{axis}"/></transmission>
"""
GANTRY = ROBOT.format(
    parts="".join(
        PART.format(axis=axis, parent=parent, child=child, direction=direction)
        for axis, parent, child, direction in (
            ("x", "world", "bridge", "1 0 0"),
            ("y", "bridge", "carriage", "0 1 0"),
            ("z", "carriage", "tool", "0 0 1"),
        )
    )
)
# A phase that turns an output in rad, and one that needs two outputs along the wall.
SETTINGS = {
    Screw: [
        "outputs=[!JointPositions {joints: [joint2]}]",
        "constraints.0.surface.point=[1.2, 0, 0.2064]",
    ],
    Search: [
        "robot.file=gantry.urdf",
        "outputs=[{frame: tool, axes: yz}]",
        "start.positions={x: 1.18, z: 0.3}",
    ],
}
PHASES = {
    Move: "!Move {{references: {{tool.z: 0.34, wall.force: 10}}, duration: 1.5, {ends}}}",
    Dwell: "!Dwell {{duration: 1.5, {ends}}}",
    Wait: "!Wait {{for_signal: ready, within: 2, {ends}}}",
    Press: "!Press {{force: 12, over: 1.5, {ends}}}",
    Follow: "!Follow {{along: tool.z, length: 0.04, speed: 0.03, {ends}}}",
    Screw: (
        "!Screw {{turn: joint2, pitch: 1.0e-6, turns: 0.0006, speed: 0.002, acceleration: 5, "
        "lag: 0.5, {ends}}}"
    ),
    # A loss is its success. It neither falls nor comes to its end.
    Search: (
        "!Search {{outputs: tool.yz, pattern: line, heading: 1.5707963, radius: 0.06, speed: 0.01, "
        "depth: 0.1, {ends}}}"
    ),
}
AWAY = "[{frame: tool, force: [-50, 0, 0], start_time: 2.0, end_time: 2.15}]"
ALONG = "[{frame: tool, force: [0, 0, 150], start_time: 2.0, end_time: 2.4}]"
JUMP = "!PointToPoint {{start: [10], end: [-30], start_time: 0.2, end_time: 0.21}}"
MOVE = "!Move {{references: {{tool.z: 0.4, wall.force: 10}}, duration: 1.5, {ends}}}"
BACK = "!Move {{references: {{tool.z: 0.3, wall.force: -30}}, over: 0.01, duration: 1.5, {ends}}}"
# Half of the length of the wall, pushes, and phases: as above, or led to the loss by themselves.
CAUSES = {
    "a push": (0.2, AWAY, PHASES),
    "a push over the edge": (
        0.02,
        ALONG,
        # The arm of the Screw, whose outputs do not hold it along the wall, would swing away.
        {kind: text for kind, text in PHASES.items() if kind is not Screw}
        | {
            Move: PHASES[Move].replace("0.34", "0.31"),
            Follow: PHASES[Follow].replace("0.04", "0.015").replace("0.03", "0.01"),
        },
    ),
    "a wall that ends": (
        0.02,
        "[]",
        {
            Move: MOVE,
            Follow: PHASES[Follow].replace("0.04", "0.1"),
            Screw: PHASES[Screw].replace("0.0006", "0.05").replace("0.002", "0.3"),
            Search: PHASES[Search].replace("0.01", "0.05"),
        },
    ),
    "a reference that jumps": (
        0.2,
        "[]",
        {Move: BACK, Press: f"!Press {{{{force: {JUMP}, over: 0.5, {{ends}}}}}}"},
    ),
}
ENDINGS = ("stop", "hold", "approach", "fail", "away")


def ended(path, cause, phase, reaction):
    """The phase changes of a task whose contact is lost, and the error of its run."""
    half, pushes, phases = CAUSES[cause]
    ends = f"if_lost: {reaction}, on_failure: {reaction}"
    if phase is Search:
        ends = f"on_success: {reaction}, on_failure: away"
    text = phases[phase].format(ends=ends)
    signals = "{ready: 0}" if "ready" in text else "{}"
    others = f"if_lost: {reaction}, on_failure: {reaction}"
    filled = TEXT.format(half=half, pushes=pushes, phase=text, ends=others, signals=signals)
    if phase is Search:  # The robot is free after it.
        filled = filled.replace("  - !Release {over: 0.2, within: 3, on_failure: stop}\n", "")
    (path.parent / "gantry.urdf").write_text(GANTRY)
    path.write_text(filled.replace("- !Retreat {", "- !Retreat {name: away, retries: 1, "))
    completed, loop = build_completed(load_scenario(path, SETTINGS.get(phase, [])))
    context = start_scenario(completed.scenario, loop)
    found = roll_scenario(completed.scenario, loop, context)
    return loop.changes(found.context or context), found.failure


CASES = [
    ("a push", Press, "fail"),
    ("a wall that ends", Follow, "away"),
    ("a reference that jumps", Move, "stop"),
]
MORE = [
    (cause, phase, reaction)
    for cause, (*_, phases) in CAUSES.items()
    for phase in phases
    for reaction in ENDINGS
    if (cause, phase, reaction) not in CASES
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cause", "phase", "reaction"),
    [*CASES, *(pytest.param(*case, marks=pytest.mark.thorough) for case in MORE)],
)
def test_a_lost_contact_ends_as_it_was_chosen(cause, phase, reaction, tmp_path):
    """By a push away, or along the wall over its edge; an edge on the way; a force that is wanted
    away from the wall.
    """
    changes, failure = ended(tmp_path / "task.yaml", cause, phase, reaction)
    words = {"stop": "held", "hold": "held", "approach": "Approach", "away": "away"}
    if reaction == "fail":
        assert failure is not None
        assert ("its contact" if phase is Search else "the contact of") in str(failure)
        assert "is lost" in str(failure)
        return
    after = next(change for change in changes if "is lost" in change.reason)
    assert after.phase == words[reaction]
    assert after.failed is not (phase is Search)
    assert after.time > 2.0 or not cause.startswith("a push")
    if reaction != "approach":  # Then the wall may be lost again, at last for good.
        assert failure is None
        assert changes[-1].phase in ("held", "done")


def test_phases_that_hold_a_contact_are_those_above():
    """Others end before, by the loss, or without a contact."""
    for kind in (GuardedMove, Insert, Release):
        assert not kind.holds_contact
    assert Search.ends_by_loss
    assert all(kind.holds_contact for kind in PHASES)
