"""Losing the contact on purpose, in every phase that holds it: each task ends as it was chosen."""

import pytest

from drake_dae import Approach, Dwell, Move, Press, Release, Retreat, load_scenario
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.rolled import roll_scenario
from drake_dae.scenario.start import start_scenario

TEXT = """
robot: {{file: package://drake_dae_models/two_link_arm.urdf}}
constraints:
- name: wall
  frame: tool
  surface: !Plane {{point: [1.2, 0, 0.3], normal: [-1, 0, 0]}}
  friction: 0.0
outputs:
- {{frame: tool, axes: z}}
sampling: {{period: 0.001, delay: 0.001}}
start: {{positions: {{joint1: 1.1653, joint2: -1.8326}}}}
plant: !CompliantContact
  radius: 1.0e-5
  stiffness: 1.0e5
  friction: 0.2
  disturbances: {pushes}
task:
  retries: 1
  patience: 0.05
  signals: {signals}
  phases:
  - !Approach {{speed: 0.02, over: 0.1, within: 6, on_failure: hold}}
  - !Press {{force: 10, over: 0.1, {ends}}}
  - {phase}
  - !Release {{over: 0.2, within: 3, on_failure: hold}}
  - !Retreat
    {{name: away, distance: 0.02, tolerance: 2.0e-3, within: 5, on_failure: hold, retries: 1}}
duration: 12
"""
READY = "until: [{{of: signal, name: ready, above: 0.5}}]"
PHASES = {
    Move: "!Move {{references: {{tool.z: 0.34, wall.force: 10}}, duration: 1.5, {ends}}}",
    Dwell: f"!Dwell {{{{{READY}, within: 2, {{ends}}}}}}",
    Press: "!Press {{force: 12, over: 1.5, {ends}}}",
}
AWAY = "[{frame: tool, force: [-50, 0, 0], start_time: 2.0, end_time: 2.15}]"
# Pushes, and phases: as above, or led to the loss by themselves.
CAUSES = {
    "a push": (AWAY, PHASES),
    "a reference that jumps": (
        "[]",
        {
            Move: "!Move {{references: {{wall.force: -30}}, over: 0.01, duration: 1.5, {ends}}}",
        },
    ),
}


def ended(path, cause, phase, reaction):
    """The phase changes of a task whose contact is lost."""
    pushes, phases = CAUSES[cause]
    ends = f"if_lost: {reaction}, on_failure: {reaction}"
    text = phases[phase].format(ends=ends)
    signals = "{ready: 0}" if "ready" in text else "{}"
    path.write_text(TEXT.format(pushes=pushes, phase=text, ends=ends, signals=signals))
    completed, loop = build_completed(load_scenario(path))
    context = start_scenario(completed.scenario, loop)
    found = roll_scenario(completed.scenario, loop, context)
    assert found.failure is None
    return loop.changes(found.record)


CASES = [("a push", Press, "approach"), ("a reference that jumps", Move, "hold")]


@pytest.mark.slow
@pytest.mark.parametrize(("cause", "phase", "reaction"), CASES)
def test_a_lost_contact_ends_as_it_was_chosen(cause, phase, reaction, tmp_path):
    """By a push away, or by a force that is wanted away from the wall."""
    changes = ended(tmp_path / "task.yaml", cause, phase, reaction)
    words = {"hold": "held", "approach": "Approach", "away": "away"}
    after = next(change for change in changes if "is lost" in change.reason)
    assert after.phase == words[reaction]
    assert after.failed
    assert after.time > 2.0 or cause != "a push"
    if reaction != "approach":  # Then the wall may be lost again, at last for good.
        assert changes[-1].phase in ("held", "done")


def test_phases_that_hold_a_contact_are_those_above():
    """Others end before, or without a contact."""
    assert not any(kind.holds_contact for kind in (Approach, Release, Retreat))
    assert all(kind.holds_contact for kind in PHASES)
