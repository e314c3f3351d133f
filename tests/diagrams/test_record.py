"""The record of a run, in memory and on disk."""

import csv
import subprocess
import sys

import numpy as np
import pytest
from pydrake.systems.framework import BasicVector, DiagramBuilder, LeafSystem, TriggerType
from pydrake.systems.primitives import LogVectorOutput, Multiplexer
from runs import run_scenario, same_records, scenario

from drake_dae import Record, load_scenario, simulate
from drake_dae.dae import Signal
from drake_dae.diagrams.record import Recorded
from drake_dae.errors import ModelError
from drake_dae.scenario.shipped import find_scenario


@pytest.fixture(scope="module")
def run():
    return run_scenario(scenario("two_link_wall", "duration=0.5"))


def small():
    """Two signals, one of size 0, as of a robot without contact."""
    return Record(
        np.array([0.0, 0.1, 0.3]),
        {
            "state": Recorded(
                np.arange(6.0).reshape(3, 2) / 7.0, (Signal("q", "rad"), Signal("ß,'", ""))
            ),
            "constraint_force": Recorded(np.zeros((3, 0)), ()),
        },
    )


def test_every_signal_with_name_and_unit(run):
    _, _, record = run
    named = {name: [(s.name, s.unit) for s in r.signals] for name, r in record.signals.items()}
    assert named == {
        "state": [
            ("joint1", "rad"),
            ("joint2", "rad"),
            ("joint1_w", "rad/s"),
            ("joint2_w", "rad/s"),
        ],
        "constraint_force": [("wall.force", "N")],
        "constraint_residual": [("wall.distance", "m"), ("wall.distance'", "m/s")],
        "controlled_output": [("tool.z", "m"), ("wall.force", "N")],
        "control": [("joint1_motor", "N m"), ("joint2_motor", "N m")],
        "reference": [
            ("tool.z", "m"),
            ("tool.z'", "m/s"),
            ("tool.z''", "m/s^2"),
            ("wall.force", "N"),
        ],
        "desired_output": [("tool.z", "m"), ("wall.force", "N")],
        "tracking_error": [("tool.z", "m"), ("wall.force", "N")],
    }
    for name, recorded in record.signals.items():
        assert recorded.values.shape == (record.time.size, len(recorded.signals)), name


def test_signals_belong_together(run):
    """Each row is one moment: what the ports say at the recorded time and state."""
    loop, context, record = run
    replay = context.Clone()
    assert np.all(np.diff(record.time) > 0.0)
    assert (record.time[0], record.time[-1]) == (0.0, 0.5)
    for row in (0, record.time.size // 2, -1):
        replay.SetTime(record.time[row])
        loop.plant.set_state(loop.plant.GetMyContextFromRoot(replay), record["state"][row])
        for name in loop.signals:
            value = loop.diagram.GetOutputPort(name).Eval(replay)
            np.testing.assert_array_equal(record[name][row], value, err_msg=name)
        error = loop.diagram.GetOutputPort("tracking_error").Eval(replay)
        # The controller finds the force by another way: round-off of 20 N.
        np.testing.assert_allclose(record["tracking_error"][row], error, atol=1e-12)
    difference = record["controlled_output"] - record["desired_output"]
    np.testing.assert_array_equal(record["tracking_error"], difference)


def test_the_last_row_is_after_the_projection(run):
    _, _, record = run
    residual = np.abs(record["constraint_residual"])
    # Round-off of 1 m; the steps before leave 1e-10 at an accuracy of 1e-8.
    assert np.max(residual[-1]) < 1e-14
    assert np.max(residual[1:-1]) > 1e-12


def test_saved_and_loaded(run, tmp_path):
    for name, record in {"run": run[2], "small": small()}.items():
        record.save(tmp_path / f"{name}.npz")
        same_records(Record.load(tmp_path / f"{name}.npz"), record)


def test_numpy_alone_reads_it(tmp_path):
    small().save(tmp_path / "record.npz")
    program = """
import sys, numpy
record = numpy.load("record.npz")
print(record["time"].tolist(), (record["state"] * 7).tolist(), record["state.names"].tolist(),
      record["state.units"].tolist(), record["constraint_force"].shape)
assert not any(name.startswith(("drake_dae", "pydrake")) for name in sys.modules)
"""
    command = [sys.executable, "-W", "error", "-X", "utf8", "-c", program]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, encoding="utf-8")
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == (
        "[0.0, 0.1, 0.3] [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]] ['q', \"ß,'\"] ['rad', ''] (3, 0)"
    )


def test_what_is_no_record(tmp_path):
    assert "state" in small()
    assert "sate" not in small()
    with pytest.raises(ModelError, match="'sate'"):
        small()["sate"]
    (tmp_path / "text.npz").write_text("hello")
    np.save(tmp_path / "array.npy", np.zeros(3))
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    for name in ("text.npz", "array.npy", "other.npz", "gone.npz"):
        with pytest.raises(ModelError, match=name):
            Record.load(tmp_path / name)


def test_numbers_of_a_user_are_checked_and_copied():
    time, values = np.array([0.0, 1.0]), np.array([[1.0], [2.0]])
    record = Record(time, {"x": Recorded(values, (Signal("a"),))})
    values[0], time[0] = 9.0, -1.0
    assert (record.time[0], record["x"][0, 0]) == (0.0, 1.0)
    record = Record([0, 1], {"x": Recorded([[1], [2]], (Signal("a"),))})
    assert record["x"].dtype == float
    for wrong in (
        [["1"], ["2"]],
        [[True], [False]],
        [[1j], [2]],
        [[1.0], [None]],
        [[1.0], [2.0, 3.0]],
        np.ma.masked_array([[1.0], [2.0]], [[True], [False]]),
        [1.0, 2.0],
    ):
        with pytest.raises(ModelError, match="'x'"):
            Record([0, 1], {"x": Recorded(wrong, (Signal("a"),))})


class Failing(LeafSystem):
    """Two outputs; the second fails after a number of evaluations."""

    def __init__(self, good):
        super().__init__()
        self.good = good
        self.DeclareContinuousState(1)
        self.DeclareVectorOutputPort("first", 1, lambda c, out: out.SetFromVector([c.get_time()]))
        self.DeclareVectorOutputPort("second", BasicVector(2), self.second)

    def DoCalcTimeDerivatives(self, context, derivatives):
        derivatives.get_mutable_vector().SetFromVector([1.0])

    def second(self, context, output):
        self.good -= 1
        if self.good < 0:
            raise ArithmeticError
        output.SetFromVector([1.0, context.get_time()])


@pytest.mark.parametrize("good", [0, 1, 3])
def test_of_a_run_that_failed_while_it_was_logged(good):
    """The sample in which a signal failed is left out."""
    builder = DiagramBuilder()
    system = builder.AddSystem(Failing(good))
    ports = [system.GetOutputPort(name) for name in ("first", "second")]
    stacked = builder.AddSystem(Multiplexer([port.size() for port in ports]))
    for index, port in enumerate(ports):
        builder.Connect(port, stacked.get_input_port(index))
    log = LogVectorOutput(stacked.get_output_port(), builder, {TriggerType.kPerStep})
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    config = load_scenario(find_scenario("two_link_wall")).integrator
    config.use_error_control, config.max_step_size = False, 0.25
    with pytest.raises(ArithmeticError):
        simulate(diagram, context, 2.0, config)
    signals = {"first": [Signal("a")], "second": [Signal("b"), Signal("c")]}
    record = Record.from_log(log, signals, context)
    np.testing.assert_array_equal(record.time, np.arange(good) / 4)
    np.testing.assert_array_equal(record["first"][:, 0], record.time)
    assert record["second"].shape == (good, 2)
    with pytest.raises(ModelError, match=r"2.*3"):
        Record.from_log(log, {"second": signals["second"]}, context)


# For other tools, and to look at.


def test_a_dataframe_has_the_numbers_below_names_and_units(run):
    _, _, record = run
    frame = record.to_dataframe()
    assert frame.index.name == "time [s]"
    np.testing.assert_array_equal(frame.index, record.time)
    assert list(frame.columns.levels[0]) == sorted(record.signals)
    assert list(frame["control"].columns) == ["joint1_motor [N m]", "joint2_motor [N m]"]
    assert list(frame["controlled_output"].columns) == ["tool.z [m]", "wall.force [N]"]
    for name in record.signals:
        np.testing.assert_array_equal(frame[name], record[name])
    assert small().to_dataframe().shape == (3, 2)


def test_csv_reads_back_to_the_last_digit(tmp_path):
    small().to_csv(tmp_path / "record.csv")
    with open(tmp_path / "record.csv", encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["time [s]", "state.q [rad]", "state.ß,'"]
    np.testing.assert_array_equal(
        np.array(rows, dtype=float), np.column_stack([small().time, small()["state"]])
    )


def test_without_the_extra_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ModelError, match=r"pandas.*\[data\]"):
        small().to_dataframe()
