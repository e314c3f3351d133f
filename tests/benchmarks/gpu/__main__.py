"""Writes rollouts for a machine that has a GPU, and no Drake: python tests/benchmarks/gpu FOLDER.

There, `python FOLDER` runs them on the GPU and on the processor, compares both with the results of
this machine, and prints a table. It needs NumPy, CuPy and gcc. The GPU gets what
`rollout(..., device="cuda")` gives it: the same source, options and arguments.
"""

import ctypes
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

from drake_dae import build_scenario, load_scenario, rollout, start_values
from drake_dae.running.rollout.asked import RolloutRequest
from drake_dae.running.rollout.lanes.batch import ENDLESS, RunBatch
from drake_dae.running.rollout.lanes.device import BLOCK, OPTIONS, THREADS
from drake_dae.running.rollout.lanes.library import OPTIONS as OF_PROCESSOR
from drake_dae.running.rollout.lanes.library import source
from drake_dae.running.rollout.problems import problems_of

STEPS = (
    "integrator.integration_scheme=runge_kutta3",
    "integrator.use_error_control=false",
    "integrator.max_step_size=0.001",
)
SAMPLED = ("sampling={period: 0.001, delay: 0.0002}", "encoders={position_noise: 1e-6}")
HEAVIER = ("plant_parameters.link3.mass=6.9",)
ERROR = ("integrator.accuracy=1e-6",)
CASES = {
    "seven": ("7 joints, RK3", "seven_joint_wall", STEPS, 0.2, 270_336),
    "heavier": (
        "7 joints, a heavier plant, RK3",
        "seven_joint_wall",
        STEPS + HEAVIER,
        0.2,
        270_336,
    ),
    "sampled": ("7 joints, law at 1 kHz, RK3", "seven_joint_wall", STEPS + SAMPLED, 0.2, 270_336),
    "arms": ("two arms with a box, RK3", "two_arms", STEPS, 0.1, 67_584),
    "link": ("2 links, to 1e-6", "two_link_wall", ERROR, 1.0, 1_000_000),
    "adaptive": ("7 joints, to 1e-6", "seven_joint_wall", ERROR, 1.0, 131_072),
}
"""Short name -> title, scenario, settings, duration in s, number of runs on the GPU."""

DIFFERENT = 256
"""The number of different starts; the runs repeat them."""


def main(folder: Path) -> None:
    """Writes all cases into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(Path(__file__).with_name("there.py"), folder / "__main__.py")
    for name, (title, *case, count) in CASES.items():
        code, arrays, layout = _case(*case)
        about = {"title": title, "count": count, **layout}
        (folder / name).with_suffix(".cu").write_text(code, encoding="utf-8")
        (folder / name).with_suffix(".json").write_text(json.dumps(about), encoding="utf-8")
        np.savez_compressed((folder / name).with_suffix(".npz"), **arrays)
        print(title, layout["operations"], flush=True)


def _case(
    name: str, settings: tuple[str, ...], duration: float
) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """Returns the source, the arrays and the numbers of one case, with results of this machine."""
    chosen = load_scenario(name, settings)
    loop, context = build_scenario(chosen)
    start, parameters = start_values(loop, context)
    states, random = loop.plant.structure.system.num_states, np.random.default_rng(0)
    starts = np.tile(start, (DIFFERENT, 1))
    for row in starts:
        near = row[:states] + 0.02 * random.uniform(-1.0, 1.0, states)
        row[:states] = loop.plant.structure.manifold.settle(near)
    times = np.array([0.0, duration])
    runs = rollout(loop, starts, parameters, times, config=chosen.integrator, compiled=True)
    assert all(run.failure is None for run in runs)
    request = RolloutRequest.of(loop, times, chosen.integrator, True, None, None)
    problems = problems_of(request.program, starts, parameters, times, None)
    program = request.program.twins if problems.with_twins().all() else request.program
    batch = RunBatch(program, problems, request.settings, ENDLESS)
    fields = batch.structure(dict.fromkeys(batch.arrays, 0))
    columns = [name for name, signals in program.signals.items() for _ in signals]
    arrays = {f"given {name}": array for name, array in batch.arrays.items()}
    expected = np.stack([run._rows for run in runs])
    arrays |= {"expected": expected, "steps": np.array([run.steps for run in runs])}
    pointers = [name for name, kind in fields._fields_ if kind is ctypes.c_void_p]
    layout = {
        "fields": [(name, kind.__name__) for name, kind in fields._fields_],
        "numbers": {n: getattr(fields, n) for n, _ in fields._fields_ if n not in pointers},
        "operations": {n: f.n_instructions() for n, f in program.compiled.staged.items()},
        "residuals": [i for i, name in enumerate(columns) if name == "constraint_residual"],
        "on_device": {"options": OPTIONS, "block": BLOCK, "threads": THREADS},
        "on_processor": OF_PROCESSOR,
    }
    return source(program), arrays, layout


if __name__ == "__main__":
    main(Path(sys.argv[1]))
