"""Whether a run did its job: the verdict by the user's wish, not by the prediction."""

import re

import numpy as np
import pytest

from drake_dae import Record
from drake_dae.dae.system.signals import Signal
from drake_dae.simulation.job import JobOutcome, judge_job, late_rms
from drake_dae.simulation.records.record import Recorded
from drake_dae.systems.control.phase_change import PhaseChange

TIMES = np.linspace(0.0, 10.0, 1001)
SIGNALS = (Signal("tool.y", "m"), Signal("wall.force", "N"))


def run(y_error=0.0, force_error=0.0, force=20.0, unit=1.0):
    """A circle of 0.1 m with a force of 20 N: 1 % of what they move is 2 mm and 0.2 N."""
    desired = np.column_stack([unit * 0.1 * np.sin(TIMES), np.full(TIMES.size, 20.0)])
    error = np.column_stack(np.broadcast_arrays(unit * y_error, force_error, TIMES)[:2])
    signals = (Signal("tool.y", "m" if unit == 1.0 else "mm"), SIGNALS[1])
    return Record(
        TIMES,
        {
            "desired_output": Recorded(desired, signals),
            "tracking_error": Recorded(error, signals),
            "constraint_force": Recorded(
                np.broadcast_to(force, TIMES.shape)[:, None].copy(), SIGNALS[1:]
            ),
        },
    )


def decaying(rate, start=0.05):
    return start * np.exp(-rate * TIMES)


def judged(record, predicted=None, **options):
    if predicted is None:
        predicted = np.zeros_like(record["tracking_error"])
    return judge_job(record, predicted, pushing=frozenset({"wall.force"}), **options)


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_an_error_that_decays_is_good_from_when_it_is_within_the_tolerance(unit):
    """0.05 e^-t falls below 1 % of 0.2 m at ln 25 = 3.22 s."""
    record = run(decaying(1.0), unit=unit)
    found = judged(record, record["tracking_error"])
    assert found.outcome is JobOutcome.GOOD
    y, force = found.outputs
    assert y.tolerance == pytest.approx(0.002 * unit, rel=1e-4)
    assert y.since == pytest.approx(np.log(25.0), abs=0.011)
    assert (force.tolerance, force.since, force.rms) == (0.2, 0.0, 0.0)
    # The mean of e^-2t from 5 to 10 s is (e^-10 - e^-20) / 10.
    expected = 0.05 * unit * np.sqrt((np.exp(-10.0) - np.exp(-20.0)) / 10.0)
    assert y.rms == pytest.approx(expected, rel=1e-4)
    assert y.largest == pytest.approx(0.05 * unit * np.exp(-5.0))
    assert "3.22 s" in str(found)


def test_far_from_the_path_is_bad_though_it_is_as_predicted():
    """A run beside its path is no success, though plant and law agree."""
    record = run(0.079)
    found = judged(record)
    assert found.outcome is JobOutcome.BAD
    assert re.match(r"BAD: tool\.y .*0\.079 m .*0\.002 m", str(found))


def test_near_the_path_is_good_though_it_is_not_as_predicted():
    found = judged(run(6e-7, np.where(TIMES < 0.2, -20.0, 0.01)))
    assert found.outcome is JobOutcome.GOOD
    assert re.search(r"wall\.force .*0\.01 of 0\.2 N", str(found))


def test_an_output_that_is_late_as_predicted_is_compared_where_it_is_at_its_reference():
    """0.2 exp(-0.8 t) is within 2 mm from 5.76 s on, and 3.7 mm in the middle of the run."""
    late = 0.2 * np.exp(-0.8 * TIMES)
    found = judged(run(late), np.column_stack([late, np.zeros_like(late)]))
    assert found.outcome is JobOutcome.GOOD
    text = re.search(r"([0-9.]+) s on.*tool\.y .* ([0-9.]+) of", str(found))
    assert float(text[1]) == pytest.approx(np.log(100.0) / 0.8, abs=0.01)
    assert float(text[2]) <= 0.002


def test_an_error_that_comes_back_is_bad():
    found = judged(run(np.where((TIMES > 7.0) & (TIMES < 7.5), 0.01, 0.0)))
    assert found.outcome is JobOutcome.BAD
    assert re.search(r"tool\.y .*7\.5 s, .*0\.01 m", str(found))


def test_a_run_that_is_too_short_is_undecided():
    """0.05 e^(-0.1 t) is 18 mm at the end, as the gains say."""
    record = run(decaying(0.1))
    found = judged(record, record["tracking_error"])
    assert found.outcome is JobOutcome.UNDECIDED
    assert "tool.y" in str(found)
    # A prediction that is left, or one that decays, is no such excuse.
    left = run(0.08)
    assert judged(left, record["tracking_error"]).outcome is JobOutcome.BAD
    assert judged(record).outcome is JobOutcome.BAD


def test_what_is_predicted_late_may_be_late():
    """0.05 e^(-0.45 t) is within 2 mm at 7.15 s."""
    record = run(decaying(0.45))
    assert judged(record, record["tracking_error"]).outcome is JobOutcome.GOOD
    assert judged(record).outcome is JobOutcome.BAD


def test_the_users_tolerances_come_first():
    record = run(1e-4)
    assert judged(record).outcome is JobOutcome.GOOD
    found = judged(record, tolerances={"tool.y": 5e-5})
    assert found.outcome is JobOutcome.BAD
    assert judged(record, tolerances={"tool.y": 2e-4}).outcome is JobOutcome.GOOD


def test_round_off_of_a_constant_reference_is_no_motion():
    """A spline over equal forces varies by 1e-15, of which 1 % is no tolerance."""
    record = run(force_error=1e-3)
    record["desired_output"][:, 1] += 1e-15 * 20.0 * np.sin(TIMES)
    found = judged(record)
    assert found.outputs[1].tolerance == pytest.approx(0.2)
    assert found.outcome is JobOutcome.GOOD


def test_a_contact_that_is_lost():
    """At first it bounces, which is said; later it is a problem."""
    bounces = run(force=np.where((TIMES > 0.5) & (TIMES <= 0.6), 0.0, 20.0))
    assert judged(bounces).outcome is JobOutcome.GOOD
    assert "wall.force was 0 for 0.1 s, first at 0.51 s" in str(judged(bounces))
    lost = judged(run(force=np.where(TIMES > 8.0, 0.0, 20.0)))
    assert lost.outcome is JobOutcome.BAD
    assert "wall.force was 0 for 2 s, first at 8.01 s" in str(lost)
    assert "wall.force is 0 all the time" in str(judged(run(force=0.0)))
    # Before it is touched it is not lost, and a weld may pull.
    late = run(force=np.where(TIMES < 4.0, 0.0, 20.0))
    assert judged(late).outcome is JobOutcome.GOOD
    weld = run(force=0.0)
    assert judge_job(weld, np.zeros_like(weld["tracking_error"])).outcome is JobOutcome.GOOD


def test_violations_and_early_ends_are_bad():
    found = judged(run(), violations=["joint3 would leave the joint limits"])
    assert found.outcome is JobOutcome.BAD
    assert str(found) == "BAD: joint3 would leave the joint limits."
    assert "broke off at 10 s" in str(judged(run(), is_cut_short=True))


def change(time, phase, place, reason, chosen="next", failed=False):
    return PhaseChange(time, phase, place, False, reason, 0.0, 0.1, 0.0, chosen, failed)


def test_a_task_is_judged_by_its_end():
    begin = [change(0.0, "Approach", 0, "the task begins"), change(2.0, "Press", 1, "a force")]
    done = change(4.0, "done", 2, "the end of 2 s")
    found = judged(run(0.079), changes=[*begin, done])
    assert (found.outcome, found.outputs) == (JobOutcome.GOOD, ())
    assert re.match(r"GOOD: .*4 s, in 2 phases\.$", str(found))
    one = judged(run(), changes=[begin[0], change(4.0, "done", 1, "the end of 4 s")])
    assert re.match(r"GOOD: .*4 s, in 1 phase\.$", str(one))
    held = judged(
        run(), changes=[*begin, change(4.0, "held", 2, "the contact was lost", "hold", True)]
    )
    assert re.match(r"BAD: .*4 s: the contact was lost\.$", str(held))
    going_on = judged(run(), changes=begin)
    assert going_on.outcome is JobOutcome.UNDECIDED
    assert re.search(r"phase 2, Press, .*2 s", str(going_on))


def test_a_task_that_begins_again_says_so():
    names = ["Approach", "Press", "Approach", "Press", "done"]
    changes = [
        change(1.0 * i, name, place, "why")
        for i, (name, place) in enumerate(zip(names, [0, 1, 0, 1, 2], strict=True))
    ]
    found = str(judged(run(), changes=changes))
    assert re.match(r"GOOD: .*4 s, in 4 phases, 2 ", found)


def test_a_way_that_was_chosen_for_failure_is_a_good_end():
    begin = change(0.0, "Approach", 0, "the task begins", "")
    away = change(2.0, "away", 3, "Approach has waited 2 s for a force of 0.5 N", "away", True)
    found = judged(run(), changes=[begin, away, change(4.0, "done", 4, "a distance")])
    assert found.outcome is JobOutcome.GOOD
    assert re.search(r"4 s, in 2 phases; .*2 s Approach .*away", str(found))


@pytest.mark.parametrize("failed", [True, False])
def test_a_task_that_leaves_is_bad_where_a_phase_has_failed(failed):
    begin = change(0.0, "Press", 0, "the task begins", "")
    leave = change(2.0, "leave", 1, "Press is ended by a force of 31 N", "leave", failed)
    held = change(3.0, "held", 2, "after a force of no more than 0.5 N", "stop", failed)
    found = judged(run(), changes=[begin, leave, held])
    wanted = r"BAD: .*2 s, .*: Press .*31 N\.$" if failed else r"GOOD: .*3 s: .*0\.5 N\.$"
    assert re.match(wanted, str(found))
    # A run that ends meanwhile cannot become good any more.
    cut = judged(run(), changes=[begin, leave])
    assert cut.outcome is (JobOutcome.BAD if failed else JobOutcome.UNDECIDED)


def test_a_run_without_outputs():
    empty = Recorded(np.zeros((TIMES.size, 0)), ())
    names = ("desired_output", "tracking_error", "constraint_force")
    record = Record(TIMES, dict.fromkeys(names, empty))
    assert judge_job(record, np.zeros((TIMES.size, 0))).outcome is JobOutcome.GOOD


def test_plain_data():
    found = judged(run()).to_dict()
    assert found["outcome"] == "good"
    assert found["outputs"]["wall.force"] == {
        "unit": "N",
        "tolerance": 0.2,
        "within_since": 0.0,
        "largest": 0.0,
        "rms": 0.0,
    }


def test_the_late_size_of_a_straight_line():
    """Of t on 0 .. 1 from 0.5 on: the root of the mean of t^2, (1 - 1/8) / (3 / 2)."""
    times = np.array([0.0, 0.3, 1.0])
    np.testing.assert_allclose(late_rms(times, times[:, None]), np.sqrt(7.0 / 12.0), rtol=1e-14)
