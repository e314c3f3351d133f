"""The table of a run."""

import signal

import casadi as ca
import numpy as np
import pytest
from arms import arm
from two_arms import two_arms

from drake_dae import ExpressionOutput, Record, RobotModel
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.robots.links.textbook import LinkExpressions
from drake_dae.simulation.records.record import Recorded
from drake_dae.simulation.simulate import RunStatistics
from drake_dae.simulation.summary import Limits, shortfalls, summary
from drake_dae.simulation.verdict import TrackingResult, judge


def record(**changes):
    values = {
        "state": ([[0.0, 1.0], [0.5, -2.0], [0.25, 3.0]], [("q", "rad"), ("q_w", "rad/s")]),
        "tracking_error": (
            [[0.05, 0.0], [-0.0625, 2e-14], [0.001, -1e-14]],
            [("tool.z", "m"), ("axis.y", "")],
        ),
        "desired_output": (
            [[0.5, 0.0], [0.25, 0.0], [0.0, 0.0]],
            [("tool.z", "m"), ("axis.y", "")],
        ),
        "constraint_force": ([[20.0], [24.9996], [15.25]], [("wall.force", "N")]),
        "constraint_residual": ([[0.0, 0.0], [3e-12, -4.44e-11], [0, 0]], [("y", "m"), ("y'", "")]),
        "control": ([[1.0, -3.0], [2.5, 40.0], [-7.25, 5.0]], [("motor1", "N m"), ("motor2", "N")]),
    } | changes
    return Record(
        np.array([0.0, 0.4, 1.0]),
        {
            name: Recorded(np.array(rows, dtype=float), tuple(Signal(*pair) for pair in signals))
            for name, (rows, signals) in values.items()
        },
    )


PREDICTED = np.array([[0.05, 0.0], [-0.0625, 0.0], [0.00125, 0.0]])


def table(text, head):
    """The rows below a head, as lists of words."""
    lines = text.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(head))
    stop = next((i for i in range(start, len(lines)) if not lines[i]), len(lines))
    return [line.split() for line in lines[start + 1 : stop]]


def test_every_figure():
    run = RunStatistics(simulated_time=1.0, wall_time=0.25, steps=123, interrupted=None)
    text = summary(record(), PREDICTED, Limits(np.array([10.0, np.inf])), run)
    # Beside axes of length one 2e-14 is round-off.
    assert table(text, "tracking error  unit")[:2] == [
        # From -0.05192 at 0.5 s to 0.001 at 1 s.
        ["tool.z", "m", "0.05", "0.0625", "0.001", "0.03", "0.00025"],
        ["axis.y", "1", "0", "0", "0", "0", "0"],
    ]
    assert "off prediction by: the largest deviation from the predicted error" in text
    assert table(text, "constraint force  unit") == [["wall.force", "N", "15.25", "25"]]
    assert table(text, "control") == [
        ["motor1", "N", "m", "-7.25", "2.5", "10"],
        ["motor2", "N", "-3", "40", "none"],
    ]
    assert "constraint residual  4.4e-11 at most" in text
    assert "simulated            1 s in 123 steps, 0.25 s, 4.0 times real time" in text
    assert "interrupted" not in text
    assert "failed" not in text
    assert "limits" not in text
    assert "-0" not in text.replace("-0.0625", "")
    assert all(line == line.rstrip() for line in text.splitlines())


def test_columns_stand_below_their_heads():
    lines = summary(record(), PREDICTED).splitlines()
    head, first, second, *_ = lines
    for title in ("start", "largest", "final", "late rms", "off prediction by"):
        end = head.index(title) + len(title)
        for row in (first, second):
            assert row[end - 1] != " "
            assert row[end : end + 1] in ("", " ")


def test_what_a_reader_must_not_miss():
    pulling = ([[20.0], [-0.5], [15.25]], [("wall.force", "N")])
    limits = Limits(np.array([7.0, 40.0]), (np.array([-1.0, -2.0]), np.array([0.4, 3.0])))
    text = summary(record(constraint_force=pulling), PREDICTED, limits)
    (force,) = table(text, "constraint force")
    assert " ".join(force).endswith("pulls: a real contact would open")
    first, second = table(text, "control")
    assert " ".join(first).endswith("over its limit")
    assert second[-1] == "40"
    assert "joint limits         q goes from 0 to 0.5 rad, its limits are -1 and 0.4" in text
    # On its limit is not beyond it.
    assert "q_w" not in text


def test_interrupted_and_failed():
    run = RunStatistics(simulated_time=1.0, wall_time=0.5, steps=12, interrupted=signal.SIGINT)
    assert "interrupted          the record ends there" in summary(record(), PREDICTED, run=run)
    text = summary(record(), PREDICTED, failure="singular there")
    assert "failed               the record ends at 1 s: singular there" in text
    assert "simulated" not in text


def verdict(text):
    return " ".join(text.split("\n\n")[-1].split())


EXACT = {"tracking_error": (PREDICTED.tolist(), [("tool.z", "m"), ("axis.y", "")])}


def test_a_good_run_is_called_so():
    """2e-9 m beside a motion of 0.5 m, at an accuracy of 1e-8."""
    near = np.add(PREDICTED, [[0.0, 0.0], [2e-9, 0.0], [0.0, 0.0]])
    run = record(tracking_error=(near.tolist(), [("tool.z", "m"), ("axis.y", "")]))
    assert verdict(summary(run, PREDICTED, accuracy=1e-8)) == (
        "Tracked as predicted: errors stay within 2e-09 m of the predicted ones (tool.z is the "
        "farthest off); the integrator's accuracy is 1e-08."
    )
    assert verdict(summary(run, PREDICTED)).endswith("farthest off); the steps are fixed.")


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_a_verdict_is_the_same_in_metres_and_millimetres(unit):
    def in_units(off):
        near = unit * np.add(PREDICTED, [[0.0, 0.0], [off, 0.0], [0.0, 0.0]])
        signals = [("tool.z", "m" if unit == 1.0 else "mm"), ("axis.y", "")]
        desired = [[0.5 * unit, 0.0], [0.25 * unit, 0.0], [0.0, 0.0]]
        run = record(tracking_error=(near.tolist(), signals), desired_output=(desired, signals))
        return judge(run, unit * PREDICTED, 1e-8)

    offs = (4e-6, 6e-6, 4.9e-3, 5.1e-3)
    assert [in_units(off).tracking for off in offs] == [
        TrackingResult.AS_PREDICTED,
        TrackingResult.NEARLY,
        TrackingResult.NEARLY,
        TrackingResult.OFF,
    ]
    found = in_units(0.05)
    assert found.worst is not None
    assert (found.worst.name, found.time) == ("tool.z", 0.4)
    assert found.off == pytest.approx(0.05 * unit)
    assert found.share == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("accuracy", "wanted"),
    [
        (None, TrackingResult.NEARLY),
        (1e-6, TrackingResult.NEARLY),
        (1e-3, TrackingResult.AS_PREDICTED),
    ],
)
def test_a_coarse_integrator_is_judged_by_what_it_was_asked_for(accuracy, wanted):
    """An error of 2e-3 of its size is within ten times an accuracy of 1e-3."""
    near = np.add(PREDICTED, [[0.0, 0.0], [1e-3, 0.0], [0.0, 0.0]])
    run = record(tracking_error=(near.tolist(), [("tool.z", "m"), ("axis.y", "")]))
    assert judge(run, PREDICTED, accuracy).tracking is wanted


def test_round_off_of_an_output_that_is_zero_is_no_drift():
    """A moment of 3e-15 N m beside motors of 7 N m is 0, and judged beside these."""
    signals = [("tool.z", "m"), ("grasp.mx", "N m")]
    noise = PREDICTED + np.array([0.0, 3e-15])
    run = record(
        tracking_error=(noise.tolist(), signals),
        desired_output=([[0.5, 0.0], [0.25, 0.0], [0.0, 0.0]], signals),
    )
    text = summary(run, PREDICTED)
    assert table(text, "tracking error  unit")[1] == ["grasp.mx", "N", "m", *"00000"]
    assert verdict(text).startswith("Tracked as predicted")
    run["tracking_error"][1, 1] = 0.1
    assert judge(run, PREDICTED).share == pytest.approx(0.1 / 7.25)


def test_a_run_that_drifted_says_where_and_why():
    run = record(tracking_error=([[0.05, 0.0], [0.0, 0.0], [0.0, 0.0]], [("a", "m"), ("b", "")]))
    reasons = ["the law is sampled"]
    text = verdict(summary(run, PREDICTED, reasons=reasons))
    assert text == (
        "Not tracked as predicted: from 0.4 s on the error of a is off the predicted one, by up to "
        "0.062 m, 12 % of its size. Likely because the law is sampled."
    )
    text = verdict(summary(run, PREDICTED, accuracy=1e-3))
    assert text.endswith("If a finer one changes nothing, plant and law differ.")


def test_a_run_that_settled_says_so():
    later = PREDICTED + np.array([[0.1, 0.0], [2e-3, 0.0], [1e-3, 0.0]])
    run = record(tracking_error=(later.tolist(), [("a", "m"), ("b", "")]))
    text = verdict(summary(run, PREDICTED, reasons=["the law is sampled"]))
    assert text.endswith(
        "Likely because the law is sampled. In the second half of the run none is off by more than "
        "0.4 % of its size."
    )


def test_a_run_that_failed_is_not_called_good():
    text = verdict(summary(record(**EXACT), PREDICTED, failure="singular there"))
    assert text.startswith("The run ended early, at 1 s; up to there: Tracked as predicted")
    grown = record(tracking_error=([[0.05, 0], [0, 0], [9.0, 0]], [("a", "m"), ("b", "")]))
    text = verdict(summary(grown, PREDICTED, failure="singular there"))
    assert text.endswith(
        "by up to 9 m, 18 times its size. Likely because of what ended it, see above."
    )
    run = RunStatistics(simulated_time=1.0, wall_time=0.5, steps=12, interrupted=signal.SIGINT)
    text = verdict(summary(record(**EXACT), PREDICTED, run=run))
    assert text.startswith("Interrupted at 1 s; up to there: ")


def test_what_no_robot_would_do_is_a_shortfall():
    pulling = ([[20.0], [-0.5], [15.25]], [("wall.force", "N")])
    limits = Limits(np.array([7.0, 40.0]), (np.array([-1.0, -2.0]), np.array([0.4, 3.0])))
    opens, *others = shortfalls(record(constraint_force=pulling, **EXACT), limits)
    assert opens.startswith("wall.force would open at t = 0.4 s")
    assert "0.5 N" in opens
    assert others == ["motor1 would exceed the limits", "q would leave the joint limits"]
    # A compliant contact, which records its whole force, pushes.
    compliant = record(constraint_force=pulling, contact_force=([[0.0]] * 3, [("f", "N")]), **EXACT)
    assert shortfalls(compliant, limits)[0] == "motor1 would exceed the limits"


def test_the_phases_of_a_task():
    """Roots of the mean squares of straight lines in the second half of each phase."""
    phases = ([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [("0 Press", ""), ("1 Move", "")])
    rows = table(summary(record(phase=phases), PREDICTED), "phase  from [s]")
    assert [row[:4] for row in rows[:2]] == [
        ["Press", "0", "0.4", "0.038"],
        ["Move", "0.4", "1", "0.001"],
    ]


def test_without_contact():
    none = {
        "constraint_force": (np.zeros((3, 0)), []),
        "constraint_residual": (np.zeros((3, 0)), []),
    }
    text = summary(record(**none), PREDICTED)
    assert "constraint force" not in text
    assert "constraint residual  0 at most" in text


def test_a_signal_that_is_missing_is_named():
    run = record()
    del run.signals["constraint_residual"]
    with pytest.raises(ModelError, match="'constraint_residual'"):
        summary(run, PREDICTED)


def test_limits_of_a_robot():
    limits = Limits.of(arm("two_link").model)
    np.testing.assert_array_equal(limits.control, [300.0, 120.0])
    np.testing.assert_array_equal(limits.state[0], [-3.1416, -2.7925, -3.0, -3.0])
    np.testing.assert_array_equal(limits.state[1], [3.1416, 2.7925, 3.0, 3.0])


def test_constraints_determine_which_forces_are_unilateral():
    wall, grasp = (Limits.of(model) for model in (arm("two_link").model, two_arms()))
    (force,) = arm("two_link").model.dae.constraint_input_signals
    assert not wall.can_pull(force)
    assert grasp.pushing == frozenset()
    assert grasp.can_pull(Signal("grasp.fx", "N"))


def test_limits_of_a_textbook_robot():
    q, v = ca.SX.sym("q"), ca.SX.sym("v")
    links = LinkExpressions(q, v, ca.SX.eye(1), ca.SX(0), effort_limits=np.array([3.0]))
    output = ExpressionOutput(lambda links: links.q, [Signal("q", "rad")])
    limits = Limits.of(RobotModel(links, [], [output]))
    np.testing.assert_array_equal(limits.control, [3.0])
    assert limits.state is None
