"""How studies gain from cores, reported and never judged; the start of processes is in it."""

import resource
import time

import numpy as np
import pytest
from runs import scenario

from drake_dae import sweep
from drake_dae.running.rollout.run import num_cores
from drake_dae.studies import make_variations


def starts(count):
    return make_variations({"start.errors.tool.z": np.linspace(-0.05, 0.05, count)})


def children():
    """What processes that have ended took of the processor, in s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@pytest.mark.parametrize(("runs", "rollout"), [(300, False), (3000, True)])
def test_two_processes(runs, rollout, report, tmp_path):
    chosen = scenario("two_link_wall")
    # Machine code is kept.
    sweep(chosen, starts(60), tmp_path / "first.db", workers=1, rollout=rollout)
    wall, used = {}, {}
    for workers in (1, 2):
        began, before = time.perf_counter(), children()
        file = tmp_path / f"{workers}.db"
        sweep(chosen, starts(runs), file, workers=workers, rollout=rollout)
        wall[workers], used[workers] = time.perf_counter() - began, children() - before
    report(
        f"two_link_wall: study of {runs} {'rollouts' if rollout else 'runs'}",
        {
            "1 process [s]": f"{wall[1]:.1f}",
            "2 processes [s]": f"{wall[2]:.1f}",
            f"ratio on {num_cores()} cores": f"{wall[1] / wall[2]:.2f} (>1.8)",
            "processor time a run, 2 over 1": f"{used[2] / used[1]:.2f}",
        },
    )


def test_ten_thousand_rollouts(report, tmp_path):
    """10 s of the 2-link wall each, from its building to the table, on all cores."""
    began = time.perf_counter()
    file = tmp_path / "runs.db"
    study = sweep(scenario("two_link_wall"), starts(10_000), file, rollout=True)
    wall = time.perf_counter() - began
    assert study.table()["outcome"] == ["finished"] * 10_000
    report("two_link_wall: 10,000 rollouts", {f"on {num_cores()} cores [s]": f"{wall:.1f} (<60)"})
