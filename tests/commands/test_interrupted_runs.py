"""Runs that a signal ends leave what was simulated; files appear when they are complete."""

import errno
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from command_line import QUICK, command
from runs import scenario, some

from drake_dae import Record, simulate
from drake_dae.cli import main
from drake_dae.commands.writing import complete
from drake_dae.running.interruption import ENDING_SIGNALS, end_at_once, ending_signals
from drake_dae.scenario.build import build_scenario
from drake_dae.scenario.judging import judge_run


@pytest.mark.usefixtures("signals_of_a_shell")
@pytest.mark.slow
def test_each_signal_in_the_middle_of_a_run(tmp_path):
    """Of 10 s that take 25 s by a clock."""
    words = ["simulate", "two_link_wall", "--set=duration=10", *QUICK]
    words += ["--set=integrator.target_realtime_rate=0.4"]
    folders = {sent: tmp_path / sent.name for sent in ENDING_SIGNALS}
    runs = {sent: command(*words, "--out", folder) for sent, folder in folders.items()}
    limit = time.monotonic() + 60
    while not all((folder / "scenario.yaml").exists() for folder in folders.values()):
        assert time.monotonic() < limit
        time.sleep(0.01)
    time.sleep(1.0)
    for sent, process in runs.items():
        process.send_signal(sent)

    chosen = scenario("two_link_wall", "duration=10")
    loop, context = build_scenario(chosen)
    chosen.integrator.target_realtime_rate = 1e6  # Block by block, as in real time.
    simulate(loop.diagram, context, 10.0, chosen.integrator)
    undisturbed = loop.record(context)
    for sent, process in runs.items():
        printed, _ = process.communicate(timeout=600)
        assert process.returncode == 128 + sent
        assert "tracking error" in printed
        left = sorted(path.name for path in folders[sent].iterdir())
        assert left == ["record.npz", "scenario.yaml", "summary.txt"]
        record = Record.load(folders[sent] / "record.npz")
        count = record.time.size
        assert 0 < count < undisturbed.time.size
        np.testing.assert_array_equal(record.time, undisturbed.time[:count])
        for name, signals in undisturbed.signals.items():
            assert record.signals[name].signals == signals.signals
            # Where a run ends, its last row is the one after the projection: a residual of 1e-9 m
            # is taken away.
            inner, last = undisturbed[name][: count - 1], undisturbed[name][count - 1]
            np.testing.assert_array_equal(record[name][:-1], inner, name)
            np.testing.assert_allclose(record[name][-1], last, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("sent", some([signal.SIGINT, signal.SIGTERM]))
def test_a_signal_while_a_run_is_judged_leaves_its_files(sent, tmp_path, monkeypatch, capsys):
    def judged(*arguments):
        signal.raise_signal(sent)
        return judge_run(*arguments)

    monkeypatch.setattr("drake_dae.commands.runs.judge_run", judged)
    words = ["simulate", "two_link_wall", "--set=duration=0.1", "--out", str(tmp_path / "run")]
    assert main(words) == 128 + sent
    left = sorted(path.name for path in (tmp_path / "run").iterdir())
    assert left == ["record.npz", "scenario.yaml", "summary.txt"]
    assert "tracking error" in capsys.readouterr().out


LOADING = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name.startswith("pydrake.common."):
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.{sent})

sys.meta_path.insert(0, Interrupting())
from drake_dae.cli import main
assert "pydrake" not in sys.modules
sys.exit(main(["plot", "nowhere"]))
"""


@pytest.mark.slow
@pytest.mark.usefixtures("signals_of_a_shell")
@pytest.mark.parametrize("sent", some(["SIGINT", "SIGTERM"]))
def test_a_signal_waits_while_drake_is_loaded(sent):
    """Its modules make an ImportError of a KeyboardInterrupt, and the command ended with that."""
    words = [sys.executable, "-c", LOADING.format(sent=sent)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=600)
    assert (done.returncode, done.stderr) == (128 + signal.Signals[sent], "interrupted\n")


def test_files_appear_when_they_are_complete(tmp_path):
    with complete(tmp_path / "new") as place:
        for name in ("one", "two"):
            (place / name).write_text(name)
            assert not (tmp_path / "new" / name).exists()
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["one", "two"]


@pytest.mark.parametrize("path", [None, "in its place", "elsewhere"])
def test_an_error_names_the_file(path, tmp_path):
    def fail(place):
        names = {None: (), "in its place": (str(place / "one"),), "elsewhere": ("/mesh.obj",)}
        raise OSError(errno.ENOSPC, "No space left on device", *names[path])

    with pytest.raises(OSError, match="No space left") as caught, complete(tmp_path, "one") as at:
        fail(at)
    assert caught.value.filename == ("/mesh.obj" if path == "elsewhere" else str(tmp_path / "one"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leaves_nothing_unfinished(sent, tmp_path):
    def write():
        with ending_signals(end_at_once), complete(tmp_path, "one") as place:
            (place / "one").write_text("1")
            signal.raise_signal(sent)

    with pytest.raises(KeyboardInterrupt) as ended:
        write()
    assert ended.value.args == (sent,)
    assert not list(tmp_path.iterdir())
