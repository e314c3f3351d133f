"""Many runs on a GPU, one in each thread, by the same source as side by side on the processor."""

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
"""So many threads are a block: each has some hundred live numbers."""

THREADS = 1 << 16
"""At most so many threads take runs under error control, each after it has ended one."""

_GET = 'pip install "drake_dae[cuda]" on a machine with an NVIDIA GPU, or leave out device="cuda"'


def find_device() -> Any:
    """CuPy, where it finds a GPU.

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
        problems: What to run.
        settings: How to step; nothing looks at these runs while they go on.

    Raises:
        ModelError: There is no GPU, or the diagram does not run side by side.
    """
    cupy = find_device()
    if not can_run(program):
        raise ModelError(
            f'{program.name} does not run with device="cuda": a block in it changes at moments '
            "that are found, or is stepped by Drake, or has an operation that lanes do not know"
        )
    options = ("-std=c++17", "--fmad=true")
    kernel = program.kept(
        "device", lambda: cupy.RawModule(code=source(program), options=options)
    ).get_function("run_on_device")
    many = RunBatch(program, problems, settings, ENDLESS)
    there = {name: cupy.asarray(array) for name, array in many.arrays.items()}
    batch = many.batch({name: array.data.ptr for name, array in there.items()})
    given = cupy.asarray(np.frombuffer(bytes(batch), dtype=np.uint8))
    threads = len(problems) if settings.tableau else min(len(problems), THREADS)
    kernel((-(-threads // BLOCK),), (BLOCK,), (given,))
    for name in ("states", "held", "rows", "runs", "endings"):
        many.arrays[name][...] = there[name].get()
    return many
