"""Records as MCAP logs, and logs of robots in MCAP."""

import json

import numpy as np
import pytest

from drake_dae import Record
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.simulation.records.record import Recorded

TIME = np.array([0.0, 1e-3, 2e-3])
SIGNALS = {
    "control": Recorded(
        np.array([[1.0, -2.0], [0.1, 3e-17], [5.0, 6.0]]), (Signal("a", "N m"), Signal("b"))
    ),
    "felt.force": Recorded(np.array([[1.0], [np.nan], [3.0]]), (Signal("x[0]", "N"),)),
}
POSE = (
    "geometry_msgs/Wrench wrench\n" + 80 * "=" + "\nMSG: geometry_msgs/Wrench\nfloat64[3] force\n"
)


@pytest.fixture
def mcap():
    return pytest.importorskip("mcap.writer")


def test_a_record_as_mcap_is_the_same_record(mcap, tmp_path):
    signals = {"control": SIGNALS["control"]}
    Record(TIME, signals).to_mcap(tmp_path / "run.mcap")
    found = Record.from_mcap(tmp_path / "run.mcap")
    # MCAP counts in ns.
    np.testing.assert_allclose(found.time, TIME, atol=1e-12)
    np.testing.assert_array_equal(found["control"], SIGNALS["control"].values)
    assert found.signals["control"].signals == SIGNALS["control"].signals


def test_what_is_no_number_is_null_in_json_and_nan_again(mcap, tmp_path):
    Record(TIME, {"force": SIGNALS["felt.force"]}).to_mcap(tmp_path / "run.mcap")
    assert b"NaN" not in (tmp_path / "run.mcap").read_bytes()
    found = Record.from_mcap(tmp_path / "run.mcap", {"/force.x[0]": "constraint_force.x [kN]"})
    np.testing.assert_array_equal(found["constraint_force"], SIGNALS["felt.force"].values)
    assert found.signals["constraint_force"].signals == (Signal("x", "kN"),)


def robot_log(mcap, path):
    """Joints each 2 ms from 10 ms on, a force each 3 ms from 11 ms on, as JSON."""
    writer = mcap.Writer(str(path))
    writer.start()
    for topic, first, step in (("/joints", 10, 2), ("/force", 11, 3)):
        channel = writer.register_channel(topic, "json", 0)
        for i in range(5):
            ms = first + i * step
            data = (
                {"header": {"frame": "base"}, "position": [ms, -ms]}
                if topic == "/joints"
                else {"z": ms}
            )
            writer.add_message(channel, ms * 10**6, json.dumps(data).encode(), ms * 10**6)
    writer.finish()


def test_rows_are_those_of_the_first_topic_with_the_last_message_of_others(mcap, tmp_path):
    robot_log(mcap, tmp_path / "log.mcap")
    columns = {"/joints.position[1]": "state.joint1 [rad]", "/force.z": "constraint_force.wall"}
    found = Record.from_mcap(tmp_path / "log.mcap", columns)
    np.testing.assert_allclose(found.time, [0.012, 0.014, 0.016, 0.018])
    np.testing.assert_array_equal(found["state"][:, 0], [-12, -14, -16, -18])
    np.testing.assert_array_equal(found["constraint_force"][:, 0], [11, 14, 14, 17])
    assert found.signals["state"].signals == (Signal("joint1", "rad"),)


def test_messages_of_ros_2_are_read(mcap, tmp_path):
    ros = pytest.importorskip("mcap_ros2.writer")
    with open(tmp_path / "bag.mcap", "wb") as file:
        writer = ros.Writer(file)
        schema = writer.register_msgdef("geometry_msgs/WrenchStamped", POSE)
        for i in range(3):
            message = {"wrench": {"force": [1.0 * i, 2.0, 3.0]}}
            writer.write_message("/ft/raw", schema, message, 10**6 * i, 10**6 * i)
        writer.finish()
    found = Record.from_mcap(tmp_path / "bag.mcap", {"/ft/raw.wrench.force[0]": "measured_force.x"})
    np.testing.assert_array_equal(found["measured_force"][:, 0], [0.0, 1.0, 2.0])


WRONG = {
    "no topic": (
        {"/joints.position[0]": "state.q", "/torque.z": "control.u"},
        "no ./torque.z.*/joints",
    ),
    "no field": ({"/joints.velocity[0]": "state.q"}, "no ./joints.velocity.0.*position.0"),
    "no signal": ({"/joints.position[0]": "q"}, "must become '<signal>.<name>'"),
    "times": ({"/joints.position[0]": "time"}, "times are those of the messages"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_columns_that_are_none_are_refused(kind, mcap, tmp_path):
    robot_log(mcap, tmp_path / "log.mcap")
    columns, message = WRONG[kind]
    with pytest.raises(ModelError, match=message):
        Record.from_mcap(tmp_path / "log.mcap", columns)


def test_no_mcap_and_a_time_before_zero_are_refused(mcap, tmp_path):
    (tmp_path / "log.mcap").write_text("time,a.b\n")
    for name, text in (("log.mcap", "cannot be read as MCAP"), ("none.mcap", "No such file")):
        with pytest.raises(ModelError, match=text):
            Record.from_mcap(tmp_path / name)
    with pytest.raises(ModelError, match="no times before 0 s"):
        Record(TIME - 1.0, SIGNALS).to_mcap(tmp_path / "run.mcap")
