"""The command `identify`, and logs in CSV."""

import json
import re

import numpy as np
import pytest

from drake_dae import Record, load_scenario
from drake_dae.cli import main
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError

BARE = ("--set=write.plots=false", "--set=write.animation=false", "--set=duration=0.3")
HEAVY = ("--set=plant_parameters={link2.mass: 6.6}", "--rollout")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run whose plant has another mass than its law."""
    folder = tmp_path_factory.mktemp("runs") / "heavy"
    assert main(["simulate", "two_link_wall", "--out", str(folder), *BARE, *HEAVY]) == 0
    return folder


@pytest.fixture(scope="module")
def log(run):
    """The same as the log of a robot, with other names and without velocities."""
    record, path = Record.load(run / "record.npz"), run / "log.csv"
    columns = [
        record.time,
        *record["state"].T[:2],
        *record["control"].T,
        *record["constraint_force"].T,
    ]
    lines = ["stamp,a1,a2,tau1,tau2,push [N],mode"]
    lines += [",".join([*map(repr, map(float, row)), "auto"]) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([*lines, ""]))
    (run / "columns.yaml").write_text(
        "stamp: time\na1: state.joint1\na2: state.joint2\ntau1: control.joint1_motor\n"
        "tau2: control.joint2_motor\npush: constraint_force.wall.force\n"
    )
    return path


@pytest.mark.slow
def test_the_command_finds_what_the_plant_has_and_writes_its_scenario(run, tmp_path, capsys):
    out = tmp_path / "found.yaml"
    assert main(["identify", str(run), "--free", "link2.mass", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert str(out) in printed
    scenario = load_scenario(out)
    assert scenario.parameters["link2.mass"] == pytest.approx(6.6, rel=1e-6)
    assert not scenario.plant_parameters
    # The law's mass is where the search began.
    (row,) = [line.split() for line in printed.splitlines() if line.startswith("link2.mass")]
    assert row[-2:] == ["6", "kg"]


def test_a_bias_of_a_sensor_that_the_scenario_does_not_have_is_told_alone(run, tmp_path, capsys):
    out = tmp_path / "found.yaml"
    free = ["--free", "link2.mass,force.bias,position.bias[0]", "--out", str(out)]
    assert main(["identify", str(run), *free]) == 0
    assert "force.bias" in capsys.readouterr().out
    assert set(load_scenario(out).parameters) == {"link2.mass"}


def test_a_law_that_knows_what_was_found_follows_its_prediction(run, tmp_path):
    """The force of the law's own model is without error, that of the other one 2 N off."""
    largest = [np.abs(Record.load(run / "record.npz")["tracking_error"][-1, 1])]
    again = ["simulate", "two_link_wall", "--out", str(tmp_path), *BARE, "--rollout"]
    assert main([*again, "--set=parameters={link2.mass: 6.6}"]) == 0
    largest.append(np.abs(Record.load(tmp_path / "record.npz")["tracking_error"][-1, 1]))
    assert largest[0] > 1.0
    assert largest[1] < 1e-9
    assert main([*again, "--set=parameters={link2.mass: [1, 2]}"]) == 1


@pytest.mark.slow
def test_a_log_with_names_of_its_own_is_enough(run, log, capsys):
    arguments = ["identify", str(log), "--scenario", "two_link_wall", "--json"]
    columns = ["--columns", str(run / "columns.yaml")]
    assert main([*arguments, *columns, "--free", "link2.mass"]) == 0
    found = json.loads(capsys.readouterr().out)["parameters"]["link2.mass"]
    # Velocities at the beginnings of pieces are estimated, and forces need all of their digits.
    assert found["value"] == pytest.approx(6.6, rel=1e-5)
    assert found["interval"][0] < found["value"] < found["interval"][1]


def test_a_record_as_text_is_the_same_record(run, tmp_path):
    record = Record.load(run / "record.npz")
    record.to_csv(tmp_path / "record.csv")
    again = Record.from_csv(tmp_path / "record.csv")
    np.testing.assert_array_equal(again.time, record.time)
    assert list(again.signals) == list(record.signals)
    for name, recorded in record.signals.items():
        np.testing.assert_array_equal(again[name], recorded.values)
        assert again.signals[name].signals == recorded.signals


def test_units_stand_in_the_head_or_in_the_names_given(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t [s],x [mm],y\n0,1,2\n0.1,3,4\n")
    found = Record.from_csv(path, {"t": "time", "x": "state.x", "y [1]": "state.y [m]"})
    assert found.signals["state"].signals == (Signal("x", "mm"), Signal("y", "m"))
    np.testing.assert_array_equal(found["state"], [[1.0, 2.0], [3.0, 4.0]])


WRONG_LOGS = {
    "no time": ("a.b,c.d\n1,2\n", None, "needs one column 'time'"),
    "milliseconds": ("time [ms],a.b\n1,2\n", None, "times in ms"),
    "a text": ("time,a.b\n0,1\n1,on\n", None, "line 3 has 'on' where a number"),
    "a short line": ("time,a.b\n0\n", None, "line 2 has nothing where a number"),
    "twice": ("time,a.b,a.b\n0,1,2\n", None, "two columns 'a.b'"),
    "no signal": ("time,a\n0,1\n", None, "'<signal>.<name>'.*got 'a'"),
    "a missing column": (
        "time,a.b\n0,1\n",
        {"t": "time"},
        r"no column \[t\]; it has \[time, a.b\]",
    ),
    "back in time": ("time,a.b\n1,1\n0,2\n", None, "strictly increasing"),
    "semicolons": ("time;a.b\n0;1\n", None, "separates its columns by ';'"),
    "nothing": ("", None, "needs one column 'time'"),
}


@pytest.mark.parametrize("kind", WRONG_LOGS)
def test_a_log_that_is_none_is_refused(kind, tmp_path):
    text, columns, message = WRONG_LOGS[kind]
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(ModelError, match=message):
        Record.from_csv(tmp_path / "log.csv", columns)


def test_no_file_and_no_text_are_refused(tmp_path):
    with pytest.raises(ModelError, match="cannot be read: No such file"):
        Record.from_csv(tmp_path / "none.csv")
    (tmp_path / "log.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ModelError, match="cannot be read"):
        Record.from_csv(tmp_path / "log.csv")


WRONG_CALLS = {
    "a log without a scenario": (["LOG", "--columns", "COLUMNS"], "name that by --scenario"),
    "a record named twice": (["RUN", "RUN"], "named twice"),
    "settings without a scenario": (["RUN", "--set", "duration=1"], "--set changes the scenario"),
    "columns of a record": (["RUN", "--columns", "COLUMNS"], "of a .csv"),
    "no columns": (["LOG", "--columns", "LOG"], "line by line|YAML"),
    "no such parameter": (["RUN", "--free", "mass"], "no parameter to identify 'mass'"),
    "another scenario": (["RUN", "--scenario", "seven_joint_wall"], "no column .*joint3|joint1"),
}


@pytest.mark.parametrize("kind", WRONG_CALLS)
def test_a_call_that_makes_no_sense_is_one_sentence(kind, run, log, capsys):
    given, message = WRONG_CALLS[kind]
    places = {"RUN": run, "LOG": log, "COLUMNS": run / "columns.yaml"}
    arguments = [str(places.get(one, one)) for one in given]
    free = [] if "--free" in given else ["--free", "link2.mass"]
    assert main(["identify", *arguments, *free]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert re.search(message, error), error


@pytest.mark.slow
def test_a_run_with_sensors_of_a_bias_begins_without_it(tmp_path, capsys):
    folder = tmp_path / "run"
    sensors = [
        "--set=sampling={period: 0.001}",
        "--set=encoders={position_noise: 1e-5, position_bias: [0.0, 0.002]}",
        "--set=integrator={integration_scheme: runge_kutta3, use_error_control: false, "
        "max_step_size: 0.001}",
    ]
    assert (
        main(["simulate", "two_link_wall", "--out", str(folder), *BARE, *sensors, "--rollout"]) == 0
    )
    capsys.readouterr()
    out = tmp_path / "found.yaml"
    free = ["--free", "position.bias[1]", "--out", str(out)]
    assert main(["identify", str(folder), *free]) == 0
    printed = capsys.readouterr().out
    assert "1e-05 rad (1e-05 is stated), white" in printed
    (row,) = [line.split() for line in printed.splitlines() if line.startswith("position.bias")]
    assert float(row[1]) == pytest.approx(0.002, rel=0.02)
    assert row[-2:] == ["0", "rad"]
