"""Files that a user names: what is none, or holds what it should not, is refused in a sentence."""

import os
import signal
import tracemalloc
import zipfile

import numpy as np
import pytest
from runs import scenario

from drake_dae import CsvReference, MeasuredSurface, Record, load_scenario, new_scenario
from drake_dae.dae import Signal
from drake_dae.errors import DrakeDaeError, ModelError, ScenarioError
from drake_dae.files import read_bytes, read_text
from drake_dae.scenario.robot_file.reading import read_robot
from drake_dae.scenario.robot_file.robot import Robot

SIZE = (0.4, 0.3)

READERS = {
    "a path": ("csv", lambda file: CsvReference(str(file), ["y"]).derivatives([0])),
    "heights in .csv": ("csv", lambda file: MeasuredSurface(SIZE, file=file)),
    "a mesh": ("obj", lambda file: MeasuredSurface(file=file)),
    "another mesh": ("stl", lambda file: MeasuredSurface(file=file)),
    "a scenario": ("yaml", load_scenario),
    "a robot": ("urdf", lambda file: new_scenario(str(file))),
    "a record": ("npz", Record.load),
    "a record of a run that was killed": ("part", Record.load),
}


@pytest.fixture
def in_time():
    """Ends what waits for ever."""

    def late(*_):
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("what", READERS)
@pytest.mark.parametrize("kind", ["pipe", "/dev/zero", "folder", "loop of links", "nothing"])
def test_what_is_no_file_is_refused_at_once(what, kind, in_time, tmp_path):
    ending, read = READERS[what]
    file = tmp_path / f"data.{ending}"
    if kind == "pipe":
        os.mkfifo(file)
    elif kind == "folder":
        file.mkdir()
    elif kind != "nothing":
        file.symlink_to(file if kind == "loop of links" else kind)
    with pytest.raises(DrakeDaeError) as refused:
        read(file)
    assert len(str(refused.value)) < 300


def test_a_file_is_read_whole_or_not_at_all(tmp_path):
    file = tmp_path / "text"
    file.write_bytes(b"\xef\xbb\xbfone\r\ntwo\rthree\n")
    assert read_text(file) == "one\ntwo\nthree\n"
    assert len(read_bytes(file, most=18)) == 18
    with pytest.raises(OSError, match="17"):
        read_bytes(file, most=17)


# Heights.


@pytest.mark.parametrize(
    "text",
    [
        "0,0.1,0.2\n0.3,0.4,0.5\n",
        "0\t0.1\t0.2\n0.3\t0.4\t0.5",
        "  0 0.1   0.2\n\n0.3 0.4 5e-1\n",
        "\ufeff+0;.1;0.2\r\n0.3; 0.4; 0.5\r\n",
    ],
)
def test_each_way_to_write_a_table_of_heights_is_read(text, tmp_path):
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    rows = [[0.0, 0.1, 0.2], [0.3, 0.4, 0.5]]
    found = MeasuredSurface(SIZE, file=tmp_path / "a.csv")
    wanted = MeasuredSurface(SIZE, heights=rows)
    places = np.linspace(-0.2, 0.2, 5), np.linspace(-0.15, 0.15, 5)
    np.testing.assert_array_equal(found.fit.heights(*places), wanted.fit.heights(*places))


# Records.


def test_a_record_that_unpacks_to_gigabytes_is_refused_before_it_is_read(tmp_path):
    file = tmp_path / "record.npz"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in ("time.npy", "a.npy", "b.npy"):
            with archive.open(name, "w") as entry:
                for _ in range(80):
                    entry.write(bytes(10 << 20))
    tracemalloc.start()
    with pytest.raises(ModelError, match="2,516,582,400"):
        Record.load(file)
    assert tracemalloc.get_traced_memory()[1] < 10 << 20
    tracemalloc.stop()


# Robots.

MJCF = "<mujoco>{}<worldbody><body name='b'><joint/><geom size='1'/></body></worldbody></mujoco>"
SDF = (
    "<sdf version='1.9'><model name='m'><include><uri>{}</uri></include><link name='a'/></model>"
    "</sdf>"
)
INCLUDE = '<include file="{}"/>'.format
ADD = "directives:\n- add_directives: {{file: 'package://mine/{}'}}\n".format


@pytest.mark.parametrize(
    ("files", "chain"),
    [
        (
            {"a.xml": MJCF.format(INCLUDE("b.xml")), "b.xml": MJCF.format(INCLUDE("a.xml"))},
            "a.xml -> b.xml -> a.xml",
        ),
        ({"a.sdf": SDF.format("package://mine/a.sdf")}, "a.sdf -> a.sdf"),
        (
            {"a.dmd.yaml": ADD("b.dmd.yaml"), "b.dmd.yaml": ADD("a.dmd.yaml")},
            "a.dmd.yaml -> b.dmd.yaml -> a.dmd.yaml",
        ),
        (
            {"0.xml": MJCF.format(2 * INCLUDE("1.xml"))}
            | {f"{i}.xml": MJCF.format(2 * INCLUDE(f"{i + 1}.xml")) for i in range(1, 30)}
            | {"30.xml": MJCF.format("")},
            "1000",
        ),
    ],
)
def test_a_robot_that_includes_itself_is_refused(files, chain, tmp_path):
    (tmp_path / "package.xml").write_text("<package format='2'><name>mine</name></package>")
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    with pytest.raises((ModelError, ScenarioError)) as refused:
        read_robot(Robot(file=str(tmp_path / next(iter(files)))))
    assert chain in str(refused.value)


# Names.


@pytest.mark.parametrize(
    "setting",
    [
        'constraints.0.name="\\ud800"',
        'description="half \\udfff of a letter"',
        'plant.parameters={"\\udc80.mass": 1}',
    ],
)
def test_a_name_that_no_file_can_hold_is_refused(setting):
    with pytest.raises(ScenarioError, match=r"\\ud"):
        scenario("two_link_wall", setting)


def test_a_signal_has_a_name_that_a_file_can_hold():
    with pytest.raises(ModelError, match=r"'\\ud800'"):
        Signal("\ud800")
    assert Signal("\u00fc \U0001f916").derivative(1).name == "\u00fc \U0001f916'"
