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
PHASES = {
    Move: "!Move {{references: {{tool.z: 0.34, wall.force: 10}}, duration: 1.5, {ends}}}",
    Dwell: "!Dwell {{duration: 1.5, {ends}}}",
    Wait: "!Wait {{for_signal: ready, within: 2, {ends}}}",
    Press: "!Press {{force: 12, over: 1.5, {ends}}}",
    Follow: "!Follow {{along: tool.z, length: 0.04, speed: 0.03, {ends}}}",
}
AWAY = "[{frame: tool, force: [-50, 0, 0], start_time: 2.0, end_time: 2.15}]"
ALONG = "[{frame: tool, force: [0, 0, 150], start_time: 2.0, end_time: 2.4}]"
JUMP = "!PointToPoint {{start: [10], end: [-30], start_time: 0.2, end_time: 0.21}}"
MOVE = "!Move {{references: {{tool.z: 0.4, wall.force: 10}}, duration: 1.5, {ends}}}"
BACK = "!Move {{references: {{tool.z: 0.3, wall.force: -30}}, over: 0.01, duration: 1.5, {ends}}}"
# Half of the length of the wall, pushes, and phases: as above, or led to the loss by themselves.
CAUSES = {
    "a push": (0.2, AWAY, PHASES),
    "a push over the edge": (0.02, ALONG, PHASES),
    "a wall that ends": (
        0.02,
        "[]",
        {Move: MOVE, Follow: PHASES[Follow].replace("0.04", "0.1")},
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
    text = phases[phase].format(ends=ends)
    signals = "{ready: 0}" if "ready" in text else "{}"
    filled = TEXT.format(half=half, pushes=pushes, phase=text, ends=ends, signals=signals)
    path.write_text(filled.replace("- !Retreat {", "- !Retreat {name: away, retries: 1, "))
    completed, loop = build_completed(load_scenario(path))
    context = start_scenario(completed.scenario, loop)
    found = roll_scenario(completed.scenario, loop, context)
    return loop.changes(found.context or context), found.failure


CASES = [
    ("a push", Press, "fail"),
    ("a push over the edge", Wait, "hold"),
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
        assert "the contact of" in str(failure)
        assert "is lost" in str(failure)
        return
    after = next(change for change in changes if "is lost" in change.reason)
    assert after.phase == words[reaction]
    if reaction != "approach":  # Then the wall may be lost again, at last for good.
        assert failure is None
        assert changes[-1].phase in ("held", "done")


def test_phases_that_hold_a_contact_are_those_above():
    """Others end before, by the loss, or without a contact."""
    for kind in (GuardedMove, Insert, Release):
        assert not kind.holds_contact
    assert Search.ends_by_loss
    assert all(kind.holds_contact for kind in PHASES)
