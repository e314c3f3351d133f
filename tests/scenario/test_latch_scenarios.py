"""The scenarios hand_over and tool_change: an object passes from hand to hand, tools change."""

import numpy as np
import pytest

from drake_dae import build_scenario, load_scenario, simulate
from drake_dae.errors import ScenarioError
from drake_dae.scenario.rolled import roll_scenario


def rolled(name, *changes):
    scenario = load_scenario(name, list(changes))
    loop, context = build_scenario(scenario)
    found = roll_scenario(scenario, loop, context)
    assert found.failure is None
    return found.record, loop.changes(found.context)


def columns(record, signal, prefix):
    """The columns whose names begin with a prefix."""
    names = [entry.name for entry in record.signals[signal].signals]
    return record[signal][:, [i for i, name in enumerate(names) if name.startswith(prefix)]]


@pytest.mark.thorough
def test_a_box_passes_from_hand_to_hand():
    """The box stays within 1e-7 m of its path, of 0.16 m; the forces obey Newton's law of the box.

    The accuracy of a step is 1e-8. The box of 4 kg swings along y: the hands exert m (a - g).
    """
    record, changes = rolled("hand_over")
    assert [change.phase for change in changes][-1] == "done"
    off = np.abs(columns(record, "tracking_error", "object_"))
    assert np.max(off) < 1e-7
    led = np.abs(record["tracking_error"] - record["predicted_error"])
    assert np.max(led) < 1e-6
    force = columns(record, "constraint_force", "left.f") + columns(
        record, "constraint_force", "right.f"
    )
    # In the box's axes, which turn a little. Rows are 5.5 ms apart, which leaves 0.1 N.
    names = [entry.name for entry in record.signals["state"].signals]
    rates = record["state"][:, [names.index(f"object_{axis}") + len(names) // 2 for axis in "xyz"]]
    acceleration = np.gradient(rates, record.time, axis=0)
    needed = 4.0 * (acceleration - [0.0, 0.0, -9.81])
    sizes = [np.linalg.norm(values[2:-2], axis=1) for values in (force, needed)]
    np.testing.assert_allclose(*sizes, atol=0.1)
    np.testing.assert_allclose(-force[-1], [0.0, 0.0, 4.0 * 9.81], atol=1e-3)
    mode = record["mode"]
    assert {tuple(row) for row in mode.tolist()} == {(0.0, 1.0), (1.0, 1.0), (1.0, 0.0)}


@pytest.mark.thorough
def test_a_tool_changes_with_its_payload():
    """At rest the arm carries 1.2 kg, then nothing, then 3 kg."""
    record, changes = rolled("tool_change")
    assert [change.phase for change in changes][-1] == "done"
    driver = columns(record, "constraint_force", "driver_arm.fz")[:, 0]
    grinder = columns(record, "constraint_force", "grinder_arm.fz")[:, 0]
    above = np.searchsorted(record.time, changes[1].time)  # The arm comes to rest there.
    assert driver[above] == pytest.approx(-1.2 * 9.81, abs=0.05)
    assert driver[-1] == 0.0 == grinder[0]
    assert grinder[-1] == pytest.approx(-3.0 * 9.81, abs=1e-4)
    assert np.max(np.abs(record["tracking_error"] - record["predicted_error"])) < 1e-6


@pytest.mark.thorough
def test_on_drakes_welds_the_box_stays_within_a_tenth_of_a_millimeter():
    """At 1 kHz the held control leaves 42 micrometers of the swing, and 53 microradians."""
    scenario = load_scenario("hand_over", ["plant=!MultibodyPlant {}"])
    loop, context = build_scenario(scenario)
    simulate(loop.diagram, context, scenario.duration, scenario.integrator)
    record = loop.record(context)
    assert [change.phase for change in loop.changes(context)][-1] == "done"
    assert np.max(np.abs(columns(record, "tracking_error", "object_"))) < 1e-4
    final = columns(record, "constraint_force", "right.f")[-1]
    np.testing.assert_allclose(final, [0.0, 0.0, -4.0 * 9.81], atol=1e-3)


@pytest.mark.parametrize(
    ("change", "key", "text"),
    [
        ("task.contact=right", "task.contact", "its phases name the latches"),
        ("task.phases.1.contact=hook", "task", "no latch 'hook'"),
        (
            "force_feedback=!MeasuredForce {gain: 1.0, time_constant: 0.01}",
            "force_feedback",
            "takes no measured force",
        ),
    ],
)
def test_keys_that_do_not_fit_latches_are_refused(change, key, text):
    with pytest.raises(ScenarioError, match=text) as caught:
        build_scenario(load_scenario("hand_over", [change]))
    assert caught.value.problems[0][0].startswith(key)
