"""Runs that a signal ends, at any moment: what they leave is readable and is what was simulated."""

import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress

import numpy as np
import pytest
from runs import scenario, some

from drake_dae import Record, simulate
from drake_dae.cli import main
from drake_dae.commands.runs import FILES, PART
from drake_dae.running.interruption import ENDING_SIGNALS
from drake_dae.scenario.build import build_scenario
from drake_dae.scenario.rolled import roll_scenario

SECONDS = 2.5
"""Of the run, by a clock; plots and animation follow."""

SETTINGS = ("duration=10", f"integrator.target_realtime_rate={10 / SECONDS}")


@pytest.fixture(scope="module")
def undisturbed():
    chosen = scenario("two_link_wall", "duration=10")
    loop, context = build_scenario(chosen)
    chosen.integrator.target_realtime_rate = 1e6  # Block by block, as in real time.
    simulate(loop.diagram, context, 10.0, chosen.integrator)
    return loop.record(context)


BARE = ("write.plots=false", "write.animation=false")

WITHOUT_PICTURES = ("scenario.yaml", "summary.txt", "record.npz")


def command(folder, extra, flags=()):
    """In a process of its own."""
    output = os.open(folder.with_suffix(".txt"), os.O_WRONLY | os.O_CREAT)
    for descriptor in (1, 2):
        os.dup2(output, descriptor)
    # The server that forks this process may have been started before a test set its signals.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    settings = [word for setting in SETTINGS + extra for word in ("--set", setting)]
    sys.exit(main(["simulate", "two_link_wall", "--out", str(folder), *flags, *settings]))


def interrupted(moments, parent, settings=()):
    """Runs it once for each (signal, s after the start), all at a time.

    Returns:
        (signal, exit code, folder) of each.
    """
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["drake_dae.commands.runs", "matplotlib.figure"])
    runs = []
    for number, (sent, after) in enumerate(moments):
        folder = parent / f"{sent.name}{number}"
        process = processes.Process(target=command, args=(folder, settings))
        process.start()
        runs.append((sent, after, folder, process))
    due, limit = {}, time.monotonic() + 120
    while len(due) < len(runs) or min(due.values()) < np.inf:
        assert time.monotonic() < limit
        for sent, after, folder, process in runs:
            scenario = folder / "scenario.yaml"
            if folder not in due and scenario.exists() and scenario.stat().st_size:
                due[folder] = time.monotonic() + after
            if time.monotonic() >= due.get(folder, np.inf):
                with suppress(ProcessLookupError):  # It has just ended.
                    os.kill(process.pid, sent)
                due[folder] = np.inf
        time.sleep(0.005)
    found = []
    for sent, _, folder, process in runs:
        process.join(60)
        found.append((sent, process.exitcode, folder))
    return found


def check(sent, code, folder, undisturbed, complete=FILES):
    output = folder.with_suffix(".txt").read_text()
    left = sorted(path.name for path in folder.iterdir())
    if sent == signal.SIGKILL:
        assert code in (0, -signal.SIGKILL)
    else:
        # After the last file is written, the process may end before the signal has come.
        assert code == 128 + sent or (code == 0 and left == sorted(complete)), output
        assert not [name for name in left if name.startswith(".")], left
        assert "record.npz" in left, output
        assert PART not in left
        assert "tracking error" in output
        assert "Traceback" not in output
    whole = folder / "record.npz"
    path = whole if whole.exists() else folder / PART
    if not path.exists():
        assert sent == signal.SIGKILL
        return 0
    record = Record.load(path)
    count = record.time.size
    np.testing.assert_array_equal(record.time, undisturbed.time[:count])
    # Where a run ends, its last row is the one after the projection.
    exact = count if path.name == PART else count - 1
    for name in undisturbed.signals:
        np.testing.assert_array_equal(record[name][:exact], undisturbed[name][:exact], name)
        assert record.signals[name].signals == undisturbed.signals[name].signals
        # A residual of 1e-9 m is taken away.
        np.testing.assert_allclose(record[name], undisturbed[name][:count], rtol=1e-6, atol=1e-6)
    return count


@pytest.mark.usefixtures("signals_of_a_shell")
@pytest.mark.slow
@pytest.mark.filterwarnings("always")
def test_each_signal_in_the_middle_of_a_run(undisturbed, tmp_path):
    moments = [(sent, 0.7 * SECONDS) for sent in (signal.SIGKILL, *ENDING_SIGNALS)]
    for sent, code, folder in interrupted(moments, tmp_path, BARE):
        count = check(sent, code, folder, undisturbed, WITHOUT_PICTURES)
        assert 0 < count < undisturbed.time.size
        if sent != signal.SIGKILL:
            assert code == 128 + sent
            assert sorted(path.name for path in folder.iterdir()) == sorted(WITHOUT_PICTURES)
    # A killed run is no obstacle to the next one.
    folder = tmp_path / "SIGKILL0"
    short = [f"--set={setting}" for setting in ("duration=0.1", *BARE)]
    assert main(["simulate", "two_link_wall", "--out", str(folder), *short]) == 1
    assert Record.load(folder / PART).time.size
    assert main(["simulate", "two_link_wall", "--out", str(folder), "--force", *short]) == 0
    assert sorted(path.name for path in folder.iterdir()) == sorted(WITHOUT_PICTURES)


@pytest.mark.usefixtures("signals_of_a_shell")
@pytest.mark.slow
@pytest.mark.thorough
def test_at_random_moments_of_run_and_plots(undisturbed, tmp_path):
    moments, signals = random.Random(13), (*ENDING_SIGNALS, signal.SIGKILL)
    chosen = [(sent, moments.uniform(0.1, 2.2 * SECONDS)) for sent in 3 * signals]
    counts = [
        check(*found, undisturbed) for found in interrupted(chosen, tmp_path, ("write.plots=true",))
    ]
    assert len(set(counts)) > 3


@pytest.mark.usefixtures("signals_of_a_shell")
@pytest.mark.slow
@pytest.mark.filterwarnings("always")
@pytest.mark.parametrize("compiled", some(["true", "false"]))
def test_a_killed_rollout_leaves_its_record_so_far(tmp_path, compiled):
    """Fixed steps of 10 us: seconds of machine code, and longer without."""
    fixed = ("integrator.use_error_control=false", "integrator.max_step_size=1e-5")
    chosen = ("duration=60", f"compiled={compiled}", *fixed, *BARE)
    processes, folder = multiprocessing.get_context("forkserver"), tmp_path / "killed"
    process = processes.Process(target=command, args=(folder, chosen, ["--rollout"]))
    process.start()
    part, limit = folder / PART, time.monotonic() + 60
    while not (part.exists() and part.stat().st_size > 10_000):
        assert time.monotonic() < limit
        assert process.is_alive(), folder.with_suffix(".txt").read_text()
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.join(60)
    assert process.exitcode == -signal.SIGKILL
    assert sorted(path.name for path in folder.iterdir()) == [PART, "scenario.yaml"]
    record = Record.load(part)
    assert 0.0 < record.time[-1] < 60.0
    short = scenario("two_link_wall", f"duration={record.time[-1]:.17g}", *chosen[1:])
    loop, context = build_scenario(short)
    whole = roll_scenario(short, loop, context).record
    count = record.time.size - 1  # The end of a run is projected.
    for name in whole.signals:
        np.testing.assert_allclose(record[name][:count], whole[name][:count], 1e-9, 1e-9)


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
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (128 + signal.Signals[sent], "interrupted\n")
