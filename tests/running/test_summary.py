"""What is told about a run, as text, as data and as figures, of a record made by hand."""

from dataclasses import replace

import numpy as np
import pytest

from drake_dae import Record, Signal
from drake_dae.analysis import LimitKind, SignalRange
from drake_dae.diagrams.record import Recorded
from drake_dae.running.judgement import RunStatistics, RunSummary
from drake_dae.studies.study import figures_of

OUTPUTS = [("tool.z", "m"), ("axis.y", "")]
PREDICTED = np.array([[0.05, 0.0], [-0.0625, 0.0], [0.00125, 0.0]])


def record(**changes):
    values = {
        "state": ([[0.0, 1.0], [0.5, -2.0], [0.25, 3.0]], [("q", "rad"), ("q_w", "rad/s")]),
        "tracking_error": ([[0.05, 0.0], [-0.0625, 2e-14], [0.001, -1e-14]], OUTPUTS),
        "desired_output": ([[0.5, 0.0], [0.25, 0.0], [0.0, 0.0]], OUTPUTS),
        "constraint_force": ([[20.0], [24.9996], [15.25]], [("wall.force", "N")]),
        "constraint_residual": (
            [[0.0, 0.0], [3e-12, -4.44e-11], [0, 0]],
            [("wall", "m"), ("wall'", "m/s")],
        ),
        "control": ([[1.0, -3.0], [2.5, 40.0], [-7.25, 5.0]], [("motor1", "N m"), ("motor2", "N")]),
    } | changes
    return Record(
        np.array([0.0, 0.4, 1.0]),
        {
            name: Recorded(np.array(rows, dtype=float), tuple(Signal(*pair) for pair in signals))
            for name, (rows, signals) in values.items()
        },
    )


def limited(kind, name, unit, least, largest, low, high):
    beyond = 0.4 if least < low or largest > high else None
    return SignalRange(Signal(name, unit), kind, least, 1.0, largest, 0.4, low, high, beyond)


RANGES = [
    limited(LimitKind.FORCE, "wall.force", "N", 15.25, 24.9996, 0.0, np.inf),
    limited(LimitKind.CONTROL, "motor1", "N m", -7.25, 2.5, -10.0, 10.0),
    limited(LimitKind.CONTROL, "motor2", "N", -3.0, 40.0, -np.inf, np.inf),
    limited(LimitKind.POSITION, "q", "rad", 0.0, 0.5, -1.5, 1.0),
]
RAN = RunStatistics(simulated_time=1.0, wall_time=0.25, steps=123, interrupted=None)


def summary(run=None, ranges=RANGES, statistics=RAN, **options):
    run = run or record()
    return RunSummary(run, PREDICTED, ranges, statistics=statistics, **options)


def table(text, head):
    """The rows below a head, as lists of words."""
    lines = text.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(head))
    stop = next((i for i in range(start, len(lines)) if not lines[i]), len(lines))
    return [line.split() for line in lines[start + 1 : stop]]


def test_the_first_line_judges_and_the_last_says_what_to_change():
    over = limited(LimitKind.CONTROL, "motor1", "N m", -7.25, 2.5, -7.0, 7.0)
    found = summary(ranges=[over])
    told = replace(found, statistics=None).text.splitlines()
    assert told[0].startswith("BAD: motor1 has 7.25 N m at 1 s, 1.04 times")
    assert "drake-dae analyze" in told[-1]
    assert found.missed


def test_data_says_the_same():
    found = summary()
    data = found.data
    assert data["outcome"] == "good"
    assert found.text.startswith(data["reason"][:60])
    outputs = {one["name"]: one for one in data["outputs"]}
    assert outputs["tool.z"]["largest"] == 0.0625
    assert outputs["tool.z"]["off_prediction"] == pytest.approx(0.00025)
    rows = {one["name"]: one for one in data["forces_and_controls"]}
    assert rows["motor1"]["least"] == {"value": -7.25, "time": 1.0}
    assert rows["motor2"]["high"] is None
    assert data["residual"] == {"m": 3e-12, "m/s": 4.44e-11}
    assert (data["steps"], data["missed"], data["interrupted"]) == (123, False, False)


def test_cut_off_controls_say_for_how_long():
    excess = ([[0.0, 0.0], [3.0, 0.0], [0.0, 0.0]], [("motor1", "N m"), ("motor2", "N")])
    (row,) = [r for r in table(summary(record(excess=excess)).text, "force") if r[0] == "motor1"]
    assert row[-2:] == ["0.4", "s"]


def test_identified_parameters_that_differ_from_the_law_or_that_are_named():
    signals = [("wall.friction", ""), ("wall.rpy[1]", "rad"), ("load.mass", "kg")]
    found = record(
        identified=([[0.5, 0.0, 1.0], [0.3, 0.0, 1.0], [0.25, 0.015, 1.0]], signals),
        identified_deviation=([[0.2, 0.1, 1.0], [0.1, 0.1, 1.0], [0.01, 0.01, 0.9]], signals),
    )
    text = summary(found).text
    assert "wall.friction = 0.25 +- 0.01" in text
    assert "wall.rpy[1]" not in text  # It is within two deviations of the 0 before.
    assert "load.mass" not in text
    text = replace(summary(found), named=["wall.rpy", "load.mass"]).text
    assert "wall.rpy[1] = 0.015 +- 0.01 rad" in text
    assert "load.mass: this motion" in text


def test_figures_by_hand():
    beyond = limited(LimitKind.POSITION, "q2", "rad", -1.2, 0.0, -1.0, 2.0)
    assert figures_of(record(), [*RANGES, beyond]) == {
        "largest error of tool.z [m]": 0.0625,
        "final error of tool.z [m]": 0.001,
        "late error of tool.z [m]": pytest.approx(0.03, abs=5e-4),
        "largest error of axis.y": 2e-14,
        "final error of axis.y": -1e-14,
        "late error of axis.y": pytest.approx(1e-14, rel=0.5),
        "least wall.force [N]": 15.25,
        "largest wall.force [N]": 24.9996,
        "largest motor1 [N m]": 7.25,
        "largest motor2 [N]": 40.0,
        "margin of motor1 [N m]": 2.75,
        "margin of q [rad]": 0.5,
        "margin of q2 [rad]": pytest.approx(-0.2),
        "largest residual": 4.44e-11,
        "end [s]": 1.0,
    }
