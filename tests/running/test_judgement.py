"""Whether a run did its job: judged by the user's wish, and beside the prediction."""

import re

import numpy as np
import pytest

from drake_dae import Record, Signal
from drake_dae.analysis import LimitKind, SignalRange
from drake_dae.diagrams.record import Recorded
from drake_dae.running.judgement import ANALYZE, FindingKind, Outcome, RunSummary, late_rms
from drake_dae.systems.controller import PhaseChange

TIMES = np.linspace(0.0, 10.0, 1001)
WALL = Signal("wall.force", "N")


def force_range(least=1.0, kind=LimitKind.FORCE):
    beyond = 3.0 if least < 0.0 else None
    return SignalRange(WALL, kind, least, 4.0, 25.0, 5.0, 0.0, np.inf, beyond)


def run(y_error=0.0, force_error=0.0, force=20.0, unit=1.0):
    """A circle of 0.1 m with a force of 20 N: 1 % of what they move is 2 mm and 0.2 N."""
    desired = np.column_stack([unit * 0.1 * np.sin(TIMES), np.full(TIMES.size, 20.0)])
    error = np.column_stack(np.broadcast_arrays(unit * y_error, force_error, TIMES)[:2])
    signals = (Signal("tool.y", "m" if unit == 1.0 else "mm"), WALL)
    forces = np.broadcast_to(force, TIMES.shape)[:, None].copy()
    return Record(
        TIMES,
        {
            "desired_output": Recorded(desired, signals),
            "tracking_error": Recorded(error, signals),
            "constraint_force": Recorded(forces, (WALL,)),
        },
    )


PUSHES = (force_range(),)


def judged(record, predicted=None, ranges=PUSHES, reasons=("a reason",), **options):
    if predicted is None:
        predicted = np.zeros_like(record["tracking_error"])
    return RunSummary(record, predicted, ranges, reasons=reasons, **options)


def decaying(rate):
    return 0.05 * np.exp(-rate * TIMES)


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_an_error_that_decays_is_good_from_when_it_is_within_the_tolerance(unit):
    """0.05 e^-t falls below 1 % of 0.2 m at ln 25 = 3.22 s."""
    record = run(decaying(1.0), unit=unit)
    found = judged(record, record["tracking_error"])
    assert found.outcome is Outcome.GOOD
    y, force = found.outputs
    assert y.tolerance == pytest.approx(0.002 * unit, rel=1e-4)
    assert y.within_since == pytest.approx(np.log(25.0), abs=0.011)
    assert (force.tolerance, force.within_since, force.late_rms) == (0.2, 0.0, 0.0)
    # The mean of e^-2t from 5 to 10 s is (e^-10 - e^-20) / 10.
    expected = 0.05 * unit * np.sqrt((np.exp(-10.0) - np.exp(-20.0)) / 10.0)
    assert y.late_rms == pytest.approx(expected, rel=1e-4)
    (told,) = found.findings
    assert (told.signal.name, told.time) == ("tool.y", y.within_since)
    assert told.value == pytest.approx(0.05 * unit * np.exp(-5.0))


def test_far_from_the_path_is_bad_though_it_is_as_predicted():
    found = judged(run(0.079), np.column_stack([np.full(1001, 0.079), np.zeros(1001)]) * 0.0)
    assert found.outcome is Outcome.BAD
    assert re.match(r"BAD: tool\.y .*0\.079 m .*0\.002 m", str(found))
    first = found.findings[0]
    assert (first.kind, first.value) == (FindingKind.REFERENCE, 0.079)
    assert "a reason" in first.cause


def test_an_output_that_is_late_as_predicted_is_compared_where_it_is_at_its_reference():
    """0.2 exp(-0.8 t) is within 2 mm from 5.76 s on, and 3.7 mm in the middle of the run."""
    late = 0.2 * np.exp(-0.8 * TIMES)
    found = judged(run(late), np.column_stack([late, np.zeros_like(late)]))
    assert found.outcome is Outcome.GOOD
    assert found.findings[0].time == pytest.approx(np.log(100.0) / 0.8, abs=0.01)
    assert found.findings[0].value <= 0.002


def test_a_run_that_is_too_short_is_undecided():
    """0.05 e^(-0.1 t) is 18 mm at the end, as the gains say."""
    record = run(decaying(0.1))
    found = judged(record, record["tracking_error"])
    assert found.outcome is Outcome.UNDECIDED
    assert found.findings[0].signal.name == "tool.y"
    # A prediction that is left, or one that decays, is no such excuse.
    assert judged(run(0.08), record["tracking_error"]).outcome is Outcome.BAD
    assert judged(record).outcome is Outcome.BAD


def test_round_off_of_a_constant_reference_is_no_motion():
    """A spline over equal forces varies by 1e-15, of which 1 % is no tolerance."""
    record = run(force_error=1e-3)
    record["desired_output"][:, 1] += 1e-15 * 20.0 * np.sin(TIMES)
    assert judged(record).outputs[1].tolerance == pytest.approx(0.2)


@pytest.mark.parametrize("unit", [1.0, 1000.0])
@pytest.mark.parametrize(
    ("share", "accuracy", "outcome"),
    [(0.0099, None, "good"), (0.0101, None, "undecided"), (0.0101, 2e-3, "good")],
)
def test_what_nothing_explains_is_undecided(unit, share, accuracy, outcome):
    """An early deviation beyond 1 % of the output's size, or ten times the accuracy."""
    record = run(np.where(TIMES < 0.2, share * 0.1, 0.0), unit=unit)
    found = judged(record, reasons=(), accuracy=accuracy)
    assert found.outcome == outcome
    told = [one for one in found.findings if one.kind is FindingKind.PREDICTION]
    assert bool(told) is (outcome == "undecided")
    # What real contact explains is a remark, not a verdict.
    explained = judged(record, reasons=["the contact is compliant"], accuracy=accuracy)
    assert explained.outcome is Outcome.GOOD
    assert "compliant" not in str(explained)


def test_a_contact_that_is_lost():
    """At first it bounces, which is said; later it is a problem."""

    def lost(force, ranges=PUSHES):
        found = judged(run(force=force), ranges=ranges)
        return found, [one.text for one in found.findings if one.kind is FindingKind.CONTACT]

    found, told = lost(np.where((TIMES > 0.5) & (TIMES <= 0.6), 0.0, 20.0))
    assert found.outcome is Outcome.GOOD
    assert "wall.force was 0 for 0.1 s, first at 0.51 s" in told
    found, told = lost(np.where(TIMES > 8.0, 0.0, 20.0))
    assert found.outcome is Outcome.BAD
    assert "wall.force was 0 for 2 s, first at 8.01 s" in told
    assert lost(0.0)[0].outcome is Outcome.BAD
    # Before it is touched it is not lost, and a weld may pull.
    assert lost(np.where(TIMES < 4.0, 0.0, 20.0))[0].outcome is Outcome.GOOD
    assert lost(0.0, ranges=())[0].outcome is Outcome.GOOD


def test_a_limit_that_is_left_is_bad_with_its_numbers():
    found = judged(run(), ranges=[force_range(-0.5)])
    assert found.outcome is Outcome.BAD
    first = found.findings[0]
    assert (first.kind, first.signal, first.value) == (FindingKind.LIMIT, WALL, -0.5)
    assert (first.limit, first.time) == (0.0, 4.0)
    # A compliant contact, which records its whole force, pushes.
    compliant = run()
    signals = {**compliant.signals, "contact_force": Recorded(np.zeros((1001, 1)), (WALL,))}
    found = judged(Record(TIMES, signals), ranges=[force_range(-0.5)])
    assert found.outcome is Outcome.GOOD


def test_slower_references_are_advised_where_there_are_some():
    def advised(record=None, **options):
        options = {"ranges": [force_range(-0.5)]} | options
        return ANALYZE in judged(record or run(), **options).look_next

    free, nothing = run(), Recorded(np.zeros((TIMES.size, 0)), ())
    free = Record(TIMES, free.signals | {"desired_output": nothing, "tracking_error": nothing})
    assert advised()
    assert not advised(free)
    assert not advised(changes=BEGIN)
    assert not advised(ranges=[force_range(-0.5, LimitKind.POSITION)])


@pytest.mark.parametrize("value", [0.0, 0.5])
def test_a_range_of_width_0_has_no_share(value):
    beyond = 0.0 if value else None
    fixed = SignalRange(WALL, LimitKind.POSITION, 0.0, 0.0, value, 0.0, 0.0, 0.0, beyond)
    assert np.isnan(fixed.share)


def change(time, phase, place, reason, failed=False):
    return PhaseChange(time, phase, place, False, reason, 0.0, 0.1, 0.0, failed)


BEGIN = [change(0.0, "Approach", 0, "the task begins"), change(2.0, "Press", 1, "a force")]
AWAY = change(2.0, "away", 3, "Approach has waited 2 s for a force of 0.5 N", True)
LEAVE = "Press is ended by a force of 31 N"


@pytest.mark.parametrize(
    ("changes", "outcome", "words"),
    [
        ([*BEGIN, change(4.0, "done", 2, "the end of 2 s")], "good", r"4 s, in 2 phases$"),
        ([BEGIN[0], change(4.0, "done", 1, "the end")], "good", r"4 s, in 1 phase$"),
        (
            [*BEGIN, change(4.0, "held", 2, "the contact was lost", True)],
            "bad",
            r"4 s: the contact was lost$",
        ),
        (BEGIN, "undecided", r"phase 2, Press, .*2 s$"),
        # One that begins again.
        ([*BEGIN, *BEGIN, change(4.0, "done", 2, "why")], "good", r"4 s, in 4 phases, 2 "),
        # A way that was chosen for failure is a good end.
        ([BEGIN[0], AWAY, change(4.0, "done", 4, "a distance")], "good", r"4 s, in 2 phases$"),
        # One that leaves is bad where a phase has failed, and cannot become good any more.
        ([BEGIN[0], change(2.0, "leave", 1, LEAVE, True)], "bad", r"2 s: Press .*31 N$"),
        ([BEGIN[0], change(2.0, "leave", 1, LEAVE)], "undecided", "leave"),
        (
            [BEGIN[0], change(2.0, "leave", 1, LEAVE), change(3.0, "held", 2, "after a force")],
            "good",
            r"3 s: after a force$",
        ),
    ],
)
def test_a_task_is_judged_by_its_end(changes, outcome, words):
    found = judged(run(0.079), changes=changes)
    assert found.outcome == outcome
    assert re.match(rf"{outcome.upper()}: .*{words}", str(found))


def test_a_run_without_outputs():
    empty = Recorded(np.zeros((TIMES.size, 0)), ())
    names = ("desired_output", "tracking_error", "constraint_force")
    record = Record(TIMES, dict.fromkeys(names, empty))
    assert RunSummary(record, np.zeros((TIMES.size, 0))).outcome is Outcome.GOOD


def test_the_late_size_of_a_straight_line():
    """Of t on 0 .. 1 from 0.5 on: the root of the mean of t^2, (1 - 1/8) / (3 / 2)."""
    times = np.array([0.0, 0.3, 1.0])
    np.testing.assert_allclose(late_rms(times, times[:, None]), np.sqrt(7.0 / 12.0), rtol=1e-14)
