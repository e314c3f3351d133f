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
from drake_dae.commands.runs import FILES
from drake_dae.running.interruption import ENDING_SIGNALS
from drake_dae.scenario.build import build_scenario

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


def command(folder, extra):
    """In a process of its own."""
    output = os.open(folder.with_suffix(".txt"), os.O_WRONLY | os.O_CREAT)
    for descriptor in (1, 2):
        os.dup2(output, descriptor)
    # The server that forks this process may have been started before a test set its signals.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    settings = [word for setting in SETTINGS + extra for word in ("--set", setting)]
    sys.exit(main(["simulate", "two_link_wall", "--out", str(folder), *settings]))


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
    # After the last file is written, the process may end before the signal has come.
    assert code == 128 + sent or (code == 0 and left == sorted(complete)), output
    assert not [name for name in left if name.startswith(".")], left
    assert "record.npz" in left, output
    assert "tracking error" in output
    assert "Traceback" not in output
    record = Record.load(folder / "record.npz")
    count = record.time.size
    np.testing.assert_array_equal(record.time, undisturbed.time[:count])
    # Where a run ends, its last row is the one after the projection.
    for name in undisturbed.signals:
        np.testing.assert_array_equal(
            record[name][: count - 1], undisturbed[name][: count - 1], name
        )
        assert record.signals[name].signals == undisturbed.signals[name].signals
        # A residual of 1e-9 m is taken away.
        np.testing.assert_allclose(record[name], undisturbed[name][:count], rtol=1e-6, atol=1e-6)
    return count


@pytest.mark.usefixtures("signals_of_a_shell")
@pytest.mark.slow
@pytest.mark.filterwarnings("always")
def test_each_signal_in_the_middle_of_a_run(undisturbed, tmp_path):
    moments = [(sent, 0.7 * SECONDS) for sent in ENDING_SIGNALS]
    for sent, code, folder in interrupted(moments, tmp_path, BARE):
        count = check(sent, code, folder, undisturbed, WITHOUT_PICTURES)
        assert 0 < count < undisturbed.time.size
        assert code == 128 + sent
        assert sorted(path.name for path in folder.iterdir()) == sorted(WITHOUT_PICTURES)


@pytest.mark.usefixtures("signals_of_a_shell")
@pytest.mark.slow
@pytest.mark.thorough
def test_at_random_moments_of_run_and_plots(undisturbed, tmp_path):
    moments = random.Random(13)
    chosen = [(sent, moments.uniform(0.1, 2.2 * SECONDS)) for sent in 4 * ENDING_SIGNALS]
    counts = [
        check(*found, undisturbed) for found in interrupted(chosen, tmp_path, ("write.plots=true",))
    ]
    assert len(set(counts)) > 3


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
