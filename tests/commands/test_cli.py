"""The command: what it prints, what it leaves, and how it ends."""

import gc
import os
import pty
import re
import signal
import subprocess
import sys
import time
import warnings
import webbrowser
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from recordings import animation

import drake_dae
from drake_dae import Record, load_scenario
from drake_dae.cli import main
from drake_dae.commands import analyze, simulate
from drake_dae.commands.run_folder import FILES
from drake_dae.errors import NonMinimumPhaseWarning, ScenarioError
from drake_dae.pictures import view
from drake_dae.pictures.plots import PATHS, PLOTS
from drake_dae.scenario.shipped import DEFAULT_SCENARIO, find_scenario, shipped_scenarios

QUICK = ["--set", "write.plots=false", "--set", "write.animation=false"]
BARE = [*QUICK, "--set", "write.record=false"]
SHORT = ["--set", "duration=0.2"]


def command(*arguments, **options):
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-m", "drake_dae", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def error_line(capsys):
    """The one line on stderr."""
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    return line


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The default scenario, as `make demo` runs it but for its length."""
    folder = tmp_path_factory.mktemp("demo") / "run"
    process = command("simulate", "--out", folder, "--set", "duration=2")
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    return folder, out, err


# What it leaves.


def test_the_run_folder_is_complete(demo):
    folder, _, _ = demo
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)
    for name in PLOTS:
        data = (folder / name).read_bytes()
        assert data.startswith(b"\x89PNG")
        assert data.endswith(b"IEND\xaeB`\x82")


def test_it_prints_the_summary(demo):
    folder, out, err = demo
    text = (folder / "summary.txt").read_text()
    assert text in out
    assert out.splitlines()[0].startswith(f"{DEFAULT_SCENARIO}: built in ")
    written, watch = out.splitlines()[-2:]
    assert written == f"written to {folder}/: {', '.join(FILES)}"
    assert watch == f"watch it: drake-dae view {folder}"
    assert "Tracked as predicted: errors stay within" in text
    assert re.search(r"simulated +2 s in \d+ steps, [\d.]+ s, [\d.]+ times real time", text)
    for name in ("tool.y", "tool.z", "joint7", "wall.force", "joint1_motor"):
        assert name in text
    # Lines of progress are for runs that last.
    assert err == ""


def test_the_record_is_that_of_the_scenario(demo):
    folder, _, _ = demo
    record = Record.load(folder / "record.npz")
    assert (record.time[0], record.time[-1]) == (0.0, 2.0)
    np.testing.assert_allclose(
        record["constraint_force"][:, 0], 20.0 + 5.0 * np.sin(2.0 * record.time), atol=1e-9
    )


def test_the_page_holds_the_animation(demo):
    folder, _, _ = demo
    tracks = animation((folder / "animation.html").read_text())
    links = {path.split("/")[-1] for path, name in tracks if path.startswith("/drake/visualizer/")}
    assert {f"link{i}" for i in range(1, 8)} <= links
    assert ("/contact/wall/force", "position") in tracks
    for track in tracks.values():
        assert len(track.times) == 65  # 2 s at 32 frames a second.
    hand = tracks["/drake/visualizer/seven_joint_arm/link7", "position"].values
    assert np.ptp(hand[:, 1]) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "link", "force"),
    [("two_arms", "right/link7", "grasp.fx"), ("five_bar", "five_bar/right2", "pin.fx")],
)
def test_a_closed_loop_of_links(name, link, force, tmp_path, capsys):
    """Without a surface there is none to draw, but the force that closes the loop is."""
    assert main(["simulate", name, "--out", str(tmp_path), "--set", "duration=0.5"]) == 0
    files = sorted(path.name for path in tmp_path.iterdir())
    assert files == sorted({*FILES} - {PATHS})  # Nothing moves on a surface.
    tracks = animation((tmp_path / "animation.html").read_text())
    assert np.ptp(tracks[f"/drake/visualizer/{link}", "position"].values) > 0.01
    assert (f"/contact/{force.split('.')[0]}/force", "position") in tracks
    printed = capsys.readouterr().out
    assert force in printed
    # Round-off of forces that shall be zero is no contact that opens.
    assert "pulls" not in printed


@pytest.mark.slow
def test_the_scenario_as_run_gives_the_same_record(demo, tmp_path):
    folder, _, _ = demo
    path = folder / "scenario.yaml"
    assert path.read_text().splitlines()[0] == (
        f"# Scenario as run by drake-dae {drake_dae.__version__}"
    )
    assert load_scenario(path) == load_scenario(find_scenario(DEFAULT_SCENARIO), ["duration=2"])
    assert main(["simulate", str(path), "--out", str(tmp_path), *QUICK]) == 0
    first, second = (Record.load(p / "record.npz") for p in (folder, tmp_path))
    np.testing.assert_array_equal(first.time, second.time)
    for name in first.signals:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


@pytest.mark.parametrize(
    ("settings", "left"),
    [
        (BARE, ["scenario.yaml", "summary.txt"]),
        (QUICK, ["record.npz", "scenario.yaml", "summary.txt"]),
    ],
)
def test_it_writes_what_is_asked_for(settings, left, tmp_path, capsys):
    arguments = ["simulate", "two_link_wall", "--out", str(tmp_path), *SHORT]
    assert main([*arguments, *settings]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == left
    capsys.readouterr()


@pytest.mark.slow
def test_without_out_each_run_gets_a_new_folder_below_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for _ in range(3):
        assert main(["simulate", "two_link_wall", *SHORT, *BARE]) == 0
    folders = [path.name for path in (tmp_path / "runs").iterdir()]
    assert len(folders) == 3
    assert all(re.fullmatch(r"two_link_wall-\d{8}-\d{6}(-\d)?", name) for name in folders)
    capsys.readouterr()


def test_view_opens_the_animation(demo, monkeypatch, capsys):
    folder, _, _ = demo
    opened = []
    monkeypatch.setattr(webbrowser, "open", lambda address: not opened.append(address))
    assert main(["view", str(folder)]) == 0
    assert opened == [(folder / "animation.html").resolve().as_uri()]
    assert capsys.readouterr().out == f"opened {opened[0]}\n"
    monkeypatch.setattr(webbrowser, "open", lambda _: False)
    assert main(["view", str(folder)]) == 1
    assert error_line(capsys) == f"error: found no browser here; open {opened[0]} in one"


def test_view_says_what_is_missing(demo, tmp_path, capsys):
    folder, _, _ = demo
    run = tmp_path / "run"
    run.mkdir()
    for path, text in (
        (folder.parent / "runn", f"no folder '.*runn'; there is {folder}$"),
        (tmp_path / "none", r"no folder '.*none'$"),
        (folder / "summary.txt", "is a file; name the folder of a run"),
        (run, "'.*run' is no folder of a run: `drake-dae simulate --out FOLDER` makes one"),
    ):
        assert main(["view", str(path)]) == 1
        assert re.search(text, error_line(capsys))
    for name in ("scenario.yaml", "outputs.png"):
        (run / name).touch()
    assert main(["view", str(run)]) == 1
    assert "has no animation.html; it has the pictures outputs.png. A run" in error_line(capsys)


def test_open_shows_the_animation_at_the_end(tmp_path, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr(webbrowser, "open", lambda address: not opened.append(address))
    short = ["simulate", "two_link_wall", "--set", "duration=0.05", "--set", "write.plots=false"]
    assert main([*short, "--out", str(tmp_path), "--open"]) == 0
    assert opened == [(tmp_path / "animation.html").as_uri()]
    page = (tmp_path / "animation.html").read_text()
    described = load_scenario(find_scenario("two_link_wall")).description
    assert f"<title>two_link_wall: {described}</title>" in page
    capsys.readouterr()
    assert main([*short, *QUICK, "--out", str(tmp_path), "--open"]) == 1
    assert error_line(capsys) == (
        "error: write.animation: --open shows the animation: leave it true"
    )
    assert len(opened) == 1


# Folders that are there already.


@pytest.mark.slow
def test_an_earlier_run_moves_away_and_other_files_stay(tmp_path, capsys):
    arguments = ["simulate", "two_link_wall", "--out", str(tmp_path), *SHORT]
    assert main([*arguments, *QUICK]) == 0
    (tmp_path / "notes.txt").write_text("mine")
    assert main([*arguments, *BARE]) == 0
    # Nothing of the first run stands beside the summary of the second.
    left = ["notes.txt", "scenario.yaml", "summary.txt"]
    assert sorted(path.name for path in tmp_path.iterdir()) == left
    assert "notes.txt" not in capsys.readouterr().out


@pytest.mark.parametrize("name", ["scenario.yaml", "controls.png"])
def test_files_of_others_are_never_overwritten(name, tmp_path, capsys):
    (tmp_path / name).write_text("mine")
    assert main(["simulate", "two_link_wall", "--out", str(tmp_path), *SHORT, *BARE]) == 1
    assert re.search(rf"error: .*{name}, not from an earlier run", error_line(capsys))
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"


def test_a_scenario_is_not_overwritten_by_its_own_run(tmp_path, capsys):
    path = tmp_path / "scenario.yaml"
    text = find_scenario("two_link_wall").read_text()
    path.write_text(f"# My wall.\n{text}")
    assert main(["simulate", str(path), "--out", str(tmp_path), *SHORT, *BARE]) == 1
    assert "not from an earlier run" in error_line(capsys)
    assert path.read_text() == f"# My wall.\n{text}"


def test_a_folder_that_cannot_be_written_to(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        assert main(["simulate", "two_link_wall", "--out", str(folder), *SHORT, *BARE]) == 1
        assert re.search(
            rf"error: ('{folder}' is a file|cannot write to '{folder}': )", error_line(capsys)
        )


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder(tmp_path, capsys):
    tmp_path.chmod(0o500)
    assert main(["simulate", "two_link_wall", "--out", str(tmp_path), *SHORT, *BARE]) == 1
    assert "Permission denied" in error_line(capsys)


# Mistakes.


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["two_link_wal"], "error: no scenario file 'two_link_wal'; did you mean 'two_link_wall'?"),
        (["two_link_wall", "--set", "duration=-1"], "error: duration: .* positive, got -1"),
        (["two_link_wall", "--set", "duration"], "error: --set duration: expected key=value"),
        (
            ["two_link_wall", "--set", "outputs.0.frame=tol"],
            "error: outputs.0: .*did you mean 'tool'",
        ),
        (["two_link_wall", "--set", "robot.file=x.urdf"], "error: robot.file: no file '.*x.urdf'"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(arguments, line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", *arguments]) == 1
    assert re.match(line, error_line(capsys))
    assert list(tmp_path.iterdir()) == []


def test_each_mistake_in_a_scenario_has_its_line(capsys):
    assert main(["simulate", "two_link_wall", "--set", "duration=0", "--set", "foo=1"]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("error: duration: ")
    assert second.startswith("error: scenario: has no key 'foo'; ")


@pytest.mark.slow
def test_a_reference_out_of_reach_ends_the_run_and_keeps_the_record(tmp_path, capsys):
    """The arm is stretched out at z = 1.6 m, which the reference passes after 0.13 s."""
    move = "references.tool.z=!PointToPoint {start: [0.3], end: [3], end_time: 0.3}"
    arguments = ["simulate", "two_link_wall", "--out", str(tmp_path), "--set", "duration=0.5"]
    assert main([*arguments, "--set", move, "--set", "write.plots=false"]) == 1
    assert re.match(r"error: .* at t = 0\.1\d+ s, state \[", error_line(capsys))
    record = Record.load(tmp_path / "record.npz")
    assert 0.1 < record.time[-1] < 0.2
    assert 1.0 < record["controlled_output"][-1, 0] < 1.6
    text = (tmp_path / "summary.txt").read_text()
    assert re.search(r"failed +the record ends at 0\.1\d+ s: ", text)
    assert "simulated" not in text
    assert animation((tmp_path / "animation.html").read_text())


def test_an_error_while_writing_is_one_line(tmp_path, monkeypatch, capsys):
    def fill(self, path):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(Record, "save", fill)
    assert main(["simulate", "two_link_wall", "--out", str(tmp_path), *SHORT, *QUICK]) == 1
    reason = "No space left on device; record.part has the record up to 0.2 s"
    assert error_line(capsys) == f"error: {tmp_path}/record.npz: {reason}"
    # The record is there in its other form, and nothing unfinished stays.
    left = ["record.part", "scenario.yaml", "summary.txt"]
    assert sorted(path.name for path in tmp_path.iterdir()) == left
    assert Record.load(tmp_path / "record.part").time[-1] == 0.2


@pytest.mark.slow
@pytest.mark.parametrize("room", [0, 5000])
def test_a_full_disk_keeps_what_fits_and_prints_the_summary(room, tmp_path, monkeypatch, capsys):
    """Room for so many bytes, and nowhere a file that is cut off."""

    def fill(*_arguments, **_options):
        raise OSError(28, "No space left on device")

    def write(file, data, at):
        if at >= room:
            fill()
        return pwrite(file, data[: room - at], at)

    pwrite = os.pwrite
    monkeypatch.setattr(os, "pwrite", write)
    monkeypatch.setattr(np, "savez_compressed", fill)
    monkeypatch.setattr(Figure, "savefig", fill)
    monkeypatch.setattr(simulate, "animate", fill)
    arguments = ["simulate", "two_link_wall", "--out", str(tmp_path), "--set", "duration=5"]
    assert main(arguments) == 1
    out, err = capsys.readouterr()
    assert "simulated            5 s in" in out
    lines = err.splitlines()
    reason = "No space left on device"
    kept = "; record.part has the record up to " if room else ""
    assert lines[0].startswith(f"error: {tmp_path}/record.npz: {reason}{kept}")
    rest = [f"error: {tmp_path}/{name}: {reason}" for name in (PLOTS[0], "animation.html")]
    assert lines[1:] == rest
    left = {path.name for path in tmp_path.iterdir()}
    assert left >= {"scenario.yaml", "summary.txt"}
    if room:
        record = Record.load(tmp_path / "record.part")
        assert 0.1 < record.time[-1] < 5.0
        assert lines[0].endswith(f" {record.time[-1]:.6g} s")


@pytest.mark.slow
def test_the_reason_of_a_failure_is_printed_too_when_files_fail(tmp_path, monkeypatch, capsys):
    def fill(self, path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Record, "save", fill)
    move = "references.tool.z=!PointToPoint {start: [0.3], end: [3], end_time: 0.3}"
    arguments = ["simulate", "two_link_wall", "--out", str(tmp_path), "--set", "duration=0.5"]
    assert main([*arguments, "--set", move, *QUICK]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert "record.npz: No space left on device; record.part has the record up to 0.1" in first
    assert "cannot go on at t = 0.1" in second


@pytest.mark.slow
def test_a_terminal_without_letters_of_a_name(tmp_path):
    out = tmp_path / "größe \N{SNOWMAN}"
    process = command(
        *("simulate", "two_link_wall", "--out", out, *SHORT, *BARE),
        env=os.environ | {"PYTHONIOENCODING": "ascii"},
    )
    printed, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert r"gr\xf6\xdfe \u2603/: scenario.yaml, summary.txt" in printed
    assert (out / "summary.txt").exists()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="asks Linux which ports listen")
def test_no_port_listens_while_a_run_goes_on_that_nobody_watches(tmp_path, monkeypatch, capsys):
    def listening():
        """Inodes of the sockets of this process that listen."""
        gc.collect()  # The systems of an earlier animation hold its server.
        own = {os.readlink(link) for link in Path("/proc/self/fd").iterdir() if link.exists()}
        rows = (line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:])
        return {row[9] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in own}

    def watched(*arguments, **options):
        seen.append(listening())
        result = drake_dae.simulate(*arguments, **options)
        seen.append(listening())
        return result

    seen = [listening()]
    monkeypatch.setattr(simulate, "simulate", watched)
    arguments = ["simulate", "two_link_wall", "--out", str(tmp_path), *SHORT]
    assert main([*arguments, "--set", "write.plots=false"]) == 0
    assert (tmp_path / "animation.html").exists()
    assert seen[1:] == [seen[0], seen[0]]
    assert main([*arguments, *QUICK, "--meshcat"]) == 0
    assert len(seen[3] - seen[0]) == 1
    capsys.readouterr()


def test_all_is_there_but_an_animation_that_finds_no_port(tmp_path, monkeypatch, capsys):
    def full(parameters):
        raise RuntimeError("Meshcat failed to open a websocket port.")

    monkeypatch.setattr(view, "Meshcat", full)
    arguments = ["simulate", "two_link_wall", "--out", str(tmp_path), *SHORT]
    assert main([*arguments, "--set", "write.plots=false"]) == 1
    reason = "no port for Meshcat: Meshcat failed to open a websocket port."
    assert error_line(capsys) == f"error: {tmp_path}/animation.html: {reason}"
    left = ["record.npz", "scenario.yaml", "summary.txt"]
    assert sorted(path.name for path in tmp_path.iterdir()) == left


# Ctrl-C.


@pytest.mark.slow
def test_ctrl_c_ends_with_130_and_complete_files(tmp_path):
    """The run would last a minute; it is interrupted after about half a second."""
    process = command(
        *("simulate", "two_link_wall", "--out", tmp_path / "run"),
        *("--set", "duration=60", "--set", "integrator.target_realtime_rate=1"),
    )
    assert process.stdout.readline().startswith("two_link_wall: built")
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 130, err
    assert err == ""
    assert "interrupted          the record ends there" in out
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == sorted(FILES)
    record = Record.load(tmp_path / "run" / "record.npz")
    assert 0.1 < record.time[-1] < 10.0
    tracks = animation((tmp_path / "run" / "animation.html").read_text())
    end = tracks["/contact/wall/force", "position"].times[-1]
    assert record.time[-1] <= end <= record.time[-1] + 1 / 32
    for name in PLOTS:
        assert (tmp_path / "run" / name).read_bytes().endswith(b"IEND\xaeB`\x82")


def test_ctrl_c_in_the_middle_of_a_step_keeps_the_record(tmp_path, monkeypatch, capsys):
    """As a second Ctrl-C does, or one while the files are written."""

    def stop(diagram, context, *_arguments, **_options):
        drake_dae.simulate(diagram, context, 0.1, load_scenario(scenario).integrator)
        raise KeyboardInterrupt

    scenario = find_scenario("two_link_wall")
    monkeypatch.setattr(simulate, "simulate", stop)
    assert main(["simulate", "two_link_wall", "--out", str(tmp_path), *QUICK]) == 130
    assert capsys.readouterr().err == "interrupted\n"
    assert Record.load(tmp_path / "record.npz").time[-1] == 0.1
    assert "interrupted in the middle of a step" in (tmp_path / "summary.txt").read_text()


# The rest of the command line.


@pytest.mark.slow
def test_cache(tmp_path, monkeypatch, capsys):
    """A run with a flag that fills it; no other flag does."""
    monkeypatch.setenv("DRAKE_DAE_CACHE", str(tmp_path / "code"))
    monkeypatch.delenv("CC", raising=False)
    short = ["simulate", "two_link_wall", "--set", "duration=0.05", *BARE]
    for flag in ("auto", "false"):
        assert main([*short, "--out", str(tmp_path / flag), "--compiled", flag]) == 0
    capsys.readouterr()
    assert main(["cache"]) == 0
    printed = capsys.readouterr().out
    assert f"{tmp_path}/code: 0 files, 0.0 MB\n" in printed
    assert re.search(r"^compiler +(cc$|none: no C compiler)", printed, flags=re.MULTILINE)
    if "none" not in printed:
        assert main([*short, "--out", str(tmp_path / "run"), "--compiled", "true"]) == 0
        assert "compiled: true" in (tmp_path / "run" / "scenario.yaml").read_text()
        capsys.readouterr()
        assert main(["cache"]) == 0
        assert re.search(r"code: [5-9] files, 0\.\d MB", capsys.readouterr().out)
    assert main(["cache", "--clear"]) == 0
    assert re.search(r"removed from .*: \d files", capsys.readouterr().out)
    assert not list((tmp_path / "code").glob("*"))
    monkeypatch.setenv("DRAKE_DAE_CACHE", str(tmp_path / "run" / "scenario.yaml"))
    (tmp_path / "run").mkdir(exist_ok=True)
    (tmp_path / "run" / "scenario.yaml").touch()
    assert main(["cache"]) == 1
    assert "is no folder" in error_line(capsys)


def test_no_compiler_is_a_warning(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("DRAKE_DAE_CACHE", str(tmp_path / "code"))
    monkeypatch.setenv("CC", "no-such-compiler")
    short = ["simulate", "two_link_wall", "--set", "duration=0.05", *BARE]
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main([*short, "--out", str(tmp_path / "run"), "--compiled", "true"]) == 0
    (line,) = capsys.readouterr().err.splitlines()  # Once, though for each of the functions.
    assert line.startswith("warning: no C compiler: CC names 'no-such-compiler'")
    assert main(["cache"]) == 0
    assert "none: no C compiler" in capsys.readouterr().out


def test_list(capsys):
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(shipped_scenarios())
    assert {"seven_joint_wall", "seven_joint_dome", "two_link_wall"} <= set(shipped_scenarios())
    told = [line.split(maxsplit=1)[1] for line in lines]
    assert told == [load_scenario(path).description for path in shipped_scenarios().values()]
    starts = {len(line) - len(line.split(maxsplit=1)[1]) for line in lines}
    assert len(starts) == 1


def test_version(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["--version"])
    assert caught.value.code == 0
    assert capsys.readouterr().out == f"{drake_dae.__version__}\n"


@pytest.mark.parametrize("arguments", [[], ["simulat"], ["simulate", "a", "b"]])
def test_a_wrong_command_line(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert "usage: drake-dae" in capsys.readouterr().err


@pytest.mark.slow
def test_a_reader_that_has_enough():
    """`drake-dae list | head -1`"""
    with command("list") as process:
        process.stdout.close()
        assert process.wait(timeout=30) == 1
        assert process.stderr.read() == ""


@pytest.mark.slow
def test_meshcat_tells_where_and_runs_in_real_time(tmp_path, capsys):
    arguments = ["simulate", "two_link_wall", "--meshcat", "--out", str(tmp_path), *QUICK]
    began = time.perf_counter()
    assert main([*arguments, "--set", "duration=0.5"]) == 0
    assert time.perf_counter() - began > 0.5
    captured = capsys.readouterr()
    assert re.search(r"^watch at http://localhost:\d+$", captured.out, re.MULTILINE)
    assert captured.err == ""
    assert load_scenario(tmp_path / "scenario.yaml").integrator.target_realtime_rate == 1.0


@pytest.mark.slow
def test_a_bar_on_a_terminal(tmp_path):
    """One that does not know its width, as in some containers."""
    ours, theirs = pty.openpty()
    settings = ["--set", "duration=0.5", "--set", "integrator.target_realtime_rate=1"]
    process = subprocess.Popen(
        [sys.executable, "-m", "drake_dae", "simulate", "two_link_wall", *BARE, *settings],
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
        stderr=theirs,
        env=os.environ | {"PYTHONUTF8": "1"},
    )
    os.close(theirs)
    shown = b""
    try:
        while part := os.read(ours, 4096):
            shown += part
    except OSError:
        pass  # Linux says so when the other end is closed.
    os.close(ours)
    assert process.wait(timeout=30) == 0
    steps = shown.decode().rstrip().split("\r")
    assert len(steps) > 3
    assert re.search(r"100%\|.*\| 0\.50/0\.50 s, \d+\.\d x real time", steps[-1])


@pytest.mark.filterwarnings("always")
def test_warnings_are_printed_like_errors_without_the_line_of_code(monkeypatch, capsys):
    """`analyze` tells of unstable zero dynamics in its report, and does not warn of them too."""

    def warn(name):
        warnings.warn("two tanks: non-minimum phase", NonMinimumPhaseWarning, stacklevel=1)
        raise ScenarioError(("", "empty"))

    for command_of in (simulate, analyze):
        monkeypatch.setattr(command_of, "find_scenario", warn)
    assert main(["simulate", "two_tanks"]) == 1
    assert capsys.readouterr().err == "warning: two tanks: non-minimum phase\nerror: empty\n"
    assert main(["analyze", "two_tanks"]) == 1
    assert capsys.readouterr().err == "error: empty\n"


def test_a_rollout_leaves_the_files_of_a_run(tmp_path, capsys):
    """With fixed steps the record is that of the simulation, to 1e-12 of forces of some 10 N."""
    steps = ["integrator.integration_scheme=runge_kutta3", "integrator.use_error_control=false"]
    steps += ["integrator.max_step_size=0.001", "duration=0.05", "write.plots=false"]
    settings = [text for setting in steps for text in ("--set", setting)]
    for folder, options in (("drake", []), ("rollout", ["--rollout"])):
        arguments = ["simulate", "two_link_wall", "--out", str(tmp_path / folder), *options]
        assert main([*arguments, *settings, "--set", "write.animation=false"]) == 0
    records = [Record.load(tmp_path / name / "record.npz") for name in ("drake", "rollout")]
    assert {path.name for path in (tmp_path / "drake").iterdir()} == {
        path.name for path in (tmp_path / "rollout").iterdir()
    }
    for name in records[0].signals:
        difference = records[0][name][:49] - records[1][name][:49]
        assert np.max(np.abs(difference)) < 1e-11
    assert "50 steps" in capsys.readouterr().out


def test_a_rollout_that_fails_keeps_its_record(tmp_path, capsys):
    settings = ["--set", "references.tool.z.amplitudes=[3.0]", "--set", "compiled=false"]
    assert main(["simulate", "two_link_wall", "--rollout", "--out", str(tmp_path), *settings]) == 1
    assert "the simulation cannot go on at t = 0.38" in capsys.readouterr().err
    assert 0.3 < Record.load(tmp_path / "record.npz").time[-1] < 0.4
