"""Many runs on a GPU, one in each thread, by the source of runs side by side."""

from importlib import import_module
from typing import Any

import numpy as np

from drake_dae.errors import ModelError
from drake_dae.running.rollout.lanes.batch import ENDLESS, RunBatch
from drake_dae.running.rollout.lanes.library import can_run, source
from drake_dae.running.rollout.problems import Problems
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.run import Settings

BLOCK = 64
"""The number of threads of a block; larger blocks are no faster, and leave processors without work
where there are few runs."""

OPTIONS = ("-std=c++17", "--fmad=true")
"""Of NVRTC."""

THREADS = 1 << 16
"""The largest number of threads under error control; each makes one run after the other."""

_GET = 'pip install "drake_dae[cuda]" on a machine with an NVIDIA GPU, or leave out device="cuda"'


def find_device() -> Any:
    """Returns CuPy, after it has found a GPU.

    Raises:
        ModelError: It is not installed, or there is no GPU.
    """
    try:
        cupy = import_module("cupy")
    except ImportError:
        raise ModelError(f'device="cuda" needs CuPy, which is not installed; {_GET}') from None
    try:
        count = int(cupy.cuda.runtime.getDeviceCount())
    except Exception:  # CuPy's own, of a driver that is missing or too old.
        count = 0
    if not count:
        raise ModelError(f'device="cuda" needs an NVIDIA GPU, and CuPy finds none; {_GET}')
    return cupy


def run_on_device(program: RolloutProgram, problems: Problems, settings: Settings) -> RunBatch:
    """Runs a diagram many times on a GPU.

    Args:
        program: The diagram.
        problems: The runs.
        settings: How to step; its `look` is not called.

    Raises:
        ModelError: There is no GPU, or the diagram does not run side by side.
    """
    cupy = find_device()
    if not can_run(program):
        raise ModelError(
            f'{program.name} does not run with device="cuda": a block in it changes at times that '
            "a run locates, or Drake steps it, or it has an operation that lanes do not support"
        )
    kernel = program.kept(
        "device", lambda: cupy.RawModule(code=source(program), options=OPTIONS)
    ).get_function("run_on_device")
    batch = RunBatch(program, problems, settings, ENDLESS)
    on_device = {name: cupy.asarray(array) for name, array in batch.arrays.items()}
    structure = batch.structure({name: array.data.ptr for name, array in on_device.items()})
    argument = cupy.asarray(np.frombuffer(bytes(structure), dtype=np.uint8))
    threads = len(problems) if settings.tableau else min(len(problems), THREADS)
    kernel((-(-threads // BLOCK),), (BLOCK,), (argument,))
    for name in ("states", "held", "rows", "runs", "endings"):
        batch.arrays[name][...] = on_device[name].get()
    return batch
