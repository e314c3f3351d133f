"""Runs what tests/benchmarks/gpu wrote: python FOLDER, on a machine with an NVIDIA GPU and gcc."""

import ctypes
import json
import os
import subprocess
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
HEAD = (
    "| case | runs | steps/s on the GPU | of one core | of all cores | GPU over one core "
    "| compile | difference | residual |\n|---|---|---|---|---|---|---|---|---|"
)


class Case:
    """One case: its source, its arguments and the results of the machine that wrote it."""

    def __init__(self, place: Path) -> None:
        self.about = json.loads(place.with_suffix(".json").read_text(encoding="utf-8"))
        self.source = place.with_suffix(".cu").read_text(encoding="utf-8")
        arrays = np.load(place.with_suffix(".npz"))
        self.expected, self.steps = arrays["expected"], arrays["steps"]
        self.given = {n.removeprefix("given "): arrays[n] for n in arrays.files if "given " in n}

    def arguments(self, count: int) -> dict[str, Any]:
        """The arrays of some runs, which repeat those that were written."""
        arrays, old = {n: array.copy() for n, array in self.given.items()}, len(self.expected)
        for name in ("states", "held", "rows", "runs", "endings", "parameters", "noise"):
            if len(arrays[name]) == old:
                times = (-(-count // old), *[1] * (arrays[name].ndim - 1))
                arrays[name] = np.tile(arrays[name], times)[:count]
        arrays["rows"][...] = np.nan
        return arrays

    def structure(self, count: int, addresses: dict[str, int]) -> ctypes.Structure:
        """The Batch of the source."""
        fields = [(name, getattr(ctypes, kind)) for name, kind in self.about["fields"]]
        batch = type("Batch", (ctypes.Structure,), {"_fields_": fields})
        return batch(**{**self.about["numbers"], "num_runs": count}, **addresses)

    def num_steps(self, count: int) -> int:
        """The number of steps of some runs."""
        return int(np.tile(self.steps, -(-count // len(self.steps)))[:count].sum())

    def check(self, rows: np.ndarray, endings: np.ndarray) -> tuple[float, float]:
        """The largest difference, relative to a signal's largest value, and the last residual."""
        assert not endings.any(), f"{np.count_nonzero(endings)} runs did not reach their end"
        assert np.isfinite(rows).all()
        scale = np.maximum(1.0, np.abs(self.expected).max(axis=(0, 1)))
        errors = [
            (np.abs(some - self.expected[: len(some)]) / scale).max()
            for some in np.split(rows, range(len(self.expected), len(rows), len(self.expected)))
        ]
        return float(max(errors)), float(np.abs(rows[:, -1, self.about["residuals"]]).max())


def on_gpu(cupy: Any, case: Case, repeat: int = 3) -> tuple[float, float, tuple[float, float]]:
    """Returns steps/s, the time to compile in s, and the differences."""
    count, device = case.about["count"], case.about["on_device"]
    started = time.perf_counter()
    module = cupy.RawModule(code=case.source, options=tuple(device["options"]))
    kernel = module.get_function("run_on_device")
    compiling = time.perf_counter() - started
    arrays = case.arguments(count)
    fixed = case.about["numbers"]["stages"] > 0
    threads = count if fixed else min(count, device["threads"])
    seconds = []
    for _ in range(repeat):
        there = {name: cupy.asarray(array) for name, array in arrays.items()}
        batch = case.structure(count, {name: array.data.ptr for name, array in there.items()})
        argument = cupy.asarray(np.frombuffer(bytes(batch), dtype=np.uint8))
        begin, end = cupy.cuda.Event(), cupy.cuda.Event()
        begin.record()
        kernel((-(-threads // device["block"]),), (device["block"],), (argument,))
        end.record()
        end.synchronize()
        seconds.append(cupy.cuda.get_elapsed_time(begin, end) / 1e3)
    checked = case.check(there["rows"].get(), there["endings"].get())
    return case.num_steps(count) / min(seconds), compiling, checked


def on_processor(case: Case, threads: int, seconds: float = 0.2, repeat: int = 5) -> float:
    """Returns steps/s of this machine's processor, by the same source."""
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder, "code.c"), Path(folder, "code.so")
        source.write_text(case.source, encoding="utf-8")
        options = ["-std=gnu11", "-O1", "-march=native", *case.about["on_processor"]]
        command = ["gcc", *options, "-shared", "-fPIC", str(source), "-o", str(library), "-lm"]
        subprocess.run(command, check=True)
        run = ctypes.CDLL(str(library)).run_lanes
    count = 512 * threads
    while _seconds(case, run, count, threads) < seconds:
        count *= 2
    return case.num_steps(count) / min(_seconds(case, run, count, threads) for _ in range(repeat))


def _seconds(case: Case, run: Any, count: int, threads: int) -> float:
    arrays = case.arguments(count)
    batch = case.structure(count, {name: array.ctypes.data for name, array in arrays.items()})
    started = time.perf_counter()
    with ThreadPoolExecutor(threads) as pool:
        for call in [pool.submit(run, ctypes.byref(batch)) for _ in range(threads)]:
            call.result()
    taken = time.perf_counter() - started
    case.check(arrays["rows"], arrays["endings"])
    return taken


def main() -> None:
    """Prints a table of all cases, in Markdown."""
    import cupy

    cores = os.cpu_count() or 1
    print(cupy.cuda.runtime.getDeviceProperties(0)["name"].decode(), "and", cores, "cores")
    print(HEAD, flush=True)
    for place in sorted(HERE.glob("*.json")):
        case = Case(place)
        speed, compiling, (difference, residual) = on_gpu(cupy, case)
        one, many = on_processor(case, 1), on_processor(case, cores)
        cells = [
            case.about["title"],
            f"{case.about['count']:,}",
            f"{speed / 1e6:.0f} M",
            f"{one / 1e6:.2f} M",
            f"{many / 1e6:.1f} M",
            f"{speed / one:.0f}",
            f"{compiling:.1f} s",
            f"{difference:.1e}",
            f"{residual:.1e}",
        ]
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
