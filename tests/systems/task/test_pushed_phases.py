"""Phases besides those that hold a point on a plane: pushed away, or against what they lead.

`test_lost_contacts.py` has the phases that hold a contact. Each case ends as it was chosen.
"""

import pytest
from test_screw import ROBOT, TEXT

from drake_dae import load_scenario
from drake_dae.scenario.build import build_completed
from drake_dae.scenario.rolled import roll_scenario
from drake_dae.scenario.start import start_scenario

ARM = """
robot: {{file: package://drake_dae_models/two_link_arm.urdf}}
constraints:
- {{name: wall, frame: tool, surface: {{point: [1.2, 0, 0], normal: [-1, 0, 0]}}}}
outputs: [{{frame: tool, axes: z}}]
gains: {{all: [-25]}}
sampling: {{period: 0.001}}
plant: !Unilateral {{restitution: {{wall: 0.0}}}}
plant_disturbances: [{{frame: tool, force: {force}, start_time: {start}, end_time: {end}}}]
task:
  gains: {{all: [-8]}}
  patience: 0.05
  phases:
{phases}
start: {{positions: {{joint1: 1.1653, joint2: -1.8326}}}}
duration: 6
integrator: {{integration_scheme: runge_kutta3, max_step_size: 0.001, use_error_control: false}}
"""
AWAY, TOWARDS = [-50, 0, 0], [60, 0, 0]
PRESSES = ["!Approach {speed: 0.04, over: 0.1}", "!Press {force: 10, over: 0.1}"]
ENDS = "!Retreat {distance: 0.02, name: away, retries: 1}"


def changes_of(path, text):
    """The changes of phase and the error of a rollout."""
    path.write_text(text)
    completed, loop = build_completed(load_scenario(path))
    context = start_scenario(completed.scenario, loop)
    found = roll_scenario(completed.scenario, loop, context)
    return loop.changes(found.context or context), found.failure


def first(cases):
    """The first case; the others are thorough."""
    one, *others = cases
    return [one, *(pytest.param(other, marks=pytest.mark.thorough) for other in others)]


def told(changes):
    return [change.phase for change in changes]


# Phases that lead to a contact or away from it, a push in N during some time in s, what follows.
FREE = {
    "an approach is pushed away, comes again, and touches": (
        ["!Approach {speed: 0.04, over: 0.1, within: 5}", "!Release {over: 0.1}", ENDS],
        (AWAY, 0.2, 0.3),
        ["Approach", "Release", "away", "done"],
        "a force of 0.5 N",
    ),
    "a guarded move is pushed against the wall, and has felt it": (
        [
            "!GuardedMove {distance: 0.1, speed: 0.02, over: 0.1, force: 3}",
            "!Release {over: 0.1}",
            ENDS,
        ],
        (TOWARDS, 0.2, 0.6),
        ["GuardedMove", "Release", "away", "done"],
        "a force of 3 N",
    ),
    "a release is pushed away, and the force is gone": (
        [*PRESSES, "!Release {over: 1.5}", ENDS],
        (AWAY, 1.2, 1.3),
        ["Approach", "Press", "Release", "away", "done"],
        "no more than 0.5 N",
    ),
    "an insertion is pushed out, lags, and is given up": (
        ["!Insert {depth: 0.01, speed: 0.01, lag: 0.005, over: 0.1, if_late: away}", ENDS],
        (AWAY, 0.2, 0.4),
        ["Insert", "away", "done"],
        "Insert lags 0.005",
    ),
    "a retreat is pushed back to the wall, and goes again": (
        [*PRESSES, "!Release {over: 0.2}", ENDS],
        (TOWARDS, 1.2, 1.3),
        ["Approach", "Press", "Release", "away", "done"],
        "a distance within",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", first(FREE))
def test_a_push_while_no_contact_is_held_ends_as_chosen(case, tmp_path):
    phases, (force, start, end), expected, reason = FREE[case]
    lines = "\n".join(f"  - {phase}" for phase in phases)
    text = ARM.format(force=force, start=start, end=end, phases=lines)
    changes, failure = changes_of(tmp_path / "task.yaml", text)
    assert failure is None
    assert told(changes) == expected
    assert any(reason in change.reason for change in changes)


SCREWS = {
    "stops": (
        "lag: 0.1, if_lost: stop",
        ["Press", "Screw", "held"],
        "the contact of Screw is lost",
    ),
    "fails": ("lag: 0.1, if_lost: fail", ["Press", "Screw"], "the contact of Screw is lost"),
    "pulls back": (
        "lag: 0.1, if_lost: pull",
        ["Press", "Screw", "pull", "away", "done"],
        "the contact of Screw is lost",
    ),
    # By default the advance lags before the patience of the task has passed.
    "is late": ("if_late: stop", ["Press", "Screw", "held"], "or the bit slips"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", first(SCREWS))
def test_a_bit_that_is_pushed_off_its_screw_ends_as_chosen(case, tmp_path):
    """With 80 N along the axis while the screw turns, against the 20 N that press it."""
    ends, expected, reason = SCREWS[case]
    (tmp_path / "driver.urdf").write_text(ROBOT)
    text = TEXT.replace("acceleration: 50", f"acceleration: 50, {ends}")
    text = text.replace("  phases:", "  patience: 0.05\n  gains: {all: [-8]}\n  phases:")
    last = "!Release {name: pull, over: 0.1, retries: 1}", ENDS
    pull = "".join(f"  - {phase}\n" for phase in last) if "pull" in ends else ""
    text = text.replace("duration: 2.5", f"{pull}duration: 4")
    text += (
        "plant: !Unilateral {restitution: {screw: 0.0}}\n"
        "plant_disturbances: [{frame: bit, force: [0, 0, 80], start_time: 0.4, end_time: 0.6}]\n"
    )
    changes, failure = changes_of(tmp_path / "screw.yaml", text)
    assert told(changes) == expected
    assert reason in (str(failure) if case == "fails" else changes[2].reason)
    assert (failure is None) is (case != "fails")
