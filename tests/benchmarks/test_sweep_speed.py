"""How studies gain from cores, reported and never judged; the start of processes is in it."""

import time

import numpy as np
from runs import scenario

from drake_dae import grid_variations, sweep
from drake_dae.diagrams.sweep.processes import cores

RUNS = 300


def test_two_processes(report, tmp_path):
    chosen = scenario("two_link_wall")
    variations = grid_variations({"start.errors.tool.z": np.linspace(-0.05, 0.05, RUNS)})
    sweep(chosen, variations[:60], tmp_path / "first.jsonl", workers=1)  # Machine code is kept.
    seconds = {}
    for workers in (1, 2):
        began = time.perf_counter()
        sweep(chosen, variations, tmp_path / f"{workers}.jsonl", workers=workers)
        seconds[workers] = time.perf_counter() - began
    report(
        f"two_link_wall: study of {RUNS} runs",
        {
            "1 process [s]": f"{seconds[1]:.1f}",
            "2 processes [s]": f"{seconds[2]:.1f}",
            f"ratio on {cores()} cores": f"{seconds[1] / seconds[2]:.2f} (>1.8)",
        },
    )
