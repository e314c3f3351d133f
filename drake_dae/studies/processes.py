"""Processes of this machine that simulate the runs of a study.

`concurrent.futures` would end all processes if one of them dies. Here a crash, for example in
Drake's C++ code, is the outcome of a single run; a run has a time limit; and a script needs no
guard for its main module. Runs and results are lines of JSON.
"""

import json
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Generator, Mapping, Sequence
from contextlib import suppress
from math import isfinite
from typing import IO, Any

import numpy as np

from drake_dae.errors import ModelError
from drake_dae.simulation.records.interruption import ENDING_SIGNALS
from drake_dae.studies.results import Outcome, RunResult
from drake_dae.studies.runs import Runner
from drake_dae.studies.structures import Batch

BUILDS = 200
"""The number of loops of a process until it is replaced, since Drake does not free all memory."""

PERIOD = 0.02
"""The shortest time between reports, in s. Results of short runs are written to disk together."""

STARTING = 300.0
"""The longest time that a process may need to start, in s."""

_ENDED = {128 + signal.SIGINT, *(-number for number in ENDING_SIGNALS)}
"""Exit codes of a process that was ended by a signal to the study."""


def cores() -> int:
    """The number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # macOS has none.
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_in_processes(
    settings: Sequence[Any],
    batches: Sequence[Batch],
    workers: int,
    time_limit: float = float("inf"),
) -> Generator[list[RunResult], None, None]:
    """Simulates all runs; yields their results in the order in which they end.

    Args:
        settings: The arguments of `Runner`, as plain data.
        batches: The runs.
        workers: The number of processes.
        time_limit: The time limit of a run, in s; a process that exceeds it is killed.

    Raises:
        ModelError: A process does not start.
    """
    waiting, workers = dict(enumerate(batches)), min(workers, len(batches))
    running: list[_Worker] = []
    results: list[RunResult] = []
    last_report = -PERIOD
    with selectors.DefaultSelector() as selector:
        try:
            while waiting or running:
                while waiting and len(running) < workers:
                    worker = _Worker(settings)
                    running.append(worker)
                    selector.register(worker.output, selectors.EVENT_READ, worker)
                now = time.monotonic()
                due = min(worker.due(time_limit) for worker in running) - now
                due = min(due, last_report + PERIOD - now) if results else due
                for key, _ in selector.select(max(0.0, due) if isfinite(due) else None):
                    worker = key.data
                    is_open = worker.read()
                    results += worker.take_results()
                    if not is_open:
                        selector.unregister(worker.output)
                        running.remove(worker)
                        if crashed := worker.close():
                            results.append(crashed)
                        if worker.unfinished:
                            waiting[worker.place] = worker.unfinished
                    elif worker.is_idle and waiting and worker.builds < BUILDS:
                        worker.place = next_place(waiting, worker.place)
                        worker.start(waiting.pop(worker.place))
                    elif worker.is_idle:
                        worker.finish()
                for worker in running:
                    if time.monotonic() >= worker.due(time_limit):
                        worker.stop(time_limit)  # Its run is reported when its output ends.
                is_over = not (waiting or running)
                if results and (is_over or time.monotonic() >= last_report + PERIOD):
                    last_report = time.monotonic()
                    yield results
                    results = []
        finally:
            for worker in running:
                worker.kill()


def next_place(waiting: Collection[int], last: int) -> int:
    """Returns the place of the batch that a worker simulates next.

    Neighbors have mostly one structure, for which the worker has a loop already. A worker without
    a neighbor begins in the middle of the longest gap between other workers.

    Args:
        waiting: The places of batches without a worker; not empty.
        last: The place of the worker's last batch; -1 before the first.
    """
    if last + 1 in waiting:
        return last + 1
    places = np.sort(np.fromiter(waiting, int))
    stretches = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1)
    longest = max(stretches, key=len)
    return int(longest[len(longest) // 2])


class _Worker:
    """A worker process and its runs.

    Attributes:
        output: The pipe with the results of the process.
        unfinished: The runs of the process that have no result yet.
        place: The place of its last batch; -1 before the first.
        is_idle: Whether the process waits for runs.
        builds: The number of loops that the process has built.
        began: The time at which the present run began, by the monotonic clock in s; infinite while
            the process is idle.
    """

    def __init__(self, settings: Sequence[Any]) -> None:
        # The garbage collector does not have to examine modules, which stay loaded.
        code = (
            f"import gc, sys; gc.disable(); sys.path[:] = {sys.path!r}; "
            f"from {__name__} import serve; gc.freeze(); gc.enable(); sys.exit(serve())"
        )
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env={"OMP_NUM_THREADS": "1", **os.environ},  # OpenBLAS and MKL read it, too.
            start_new_session=True,  # Ctrl-C reaches only the study, which ends its processes.
        )
        self.output: IO[bytes] = self._process.stdout  # type: ignore[assignment]
        self.unfinished: Batch = []
        self.place = -1
        self.is_idle = False
        self.builds = 0
        self.began = time.monotonic()
        self._is_ready = False
        self._limit: float | None = None
        self._text = b""
        self._results: list[RunResult] = []
        self._send(settings)

    def start(self, batch: Batch) -> None:
        """Sends runs to the process."""
        self.unfinished, self.is_idle = list(batch), False
        self.began = time.monotonic()
        self._send(self.unfinished)

    def finish(self) -> None:
        """Closes the input of the process, which then ends."""
        with suppress(OSError):
            self._process.stdin.close()  # type: ignore[union-attr]

    def read(self) -> bool:
        """Reads results; returns False at the end of the output."""
        data = os.read(self.output.fileno(), 1 << 16)
        *lines, self._text = (self._text + data).split(b"\n")
        for line in lines:
            line_data = json.loads(line)
            if "builds" in line_data:
                self._is_ready = self.is_idle = True
                self.began, self.builds = float("inf"), line_data["builds"]
            else:
                self._results.append(RunResult.from_dict(line_data))
                self.unfinished, self.began = self.unfinished[1:], time.monotonic()
        return bool(data)

    def due(self, limit: float) -> float:
        """The time at which the present run exceeds a limit, by the monotonic clock in s."""
        return self.began + (limit if self._is_ready else max(limit, STARTING))

    def stop(self, limit: float) -> None:
        """Kills the process, since its run exceeds a limit in s; `close` returns this outcome."""
        if self._limit is None:
            self._limit = limit
            self._process.kill()
        self.began = float("inf")

    def take_results(self) -> list[RunResult]:
        """Returns the results since the last call."""
        results, self._results = self._results, []
        return results

    def close(self) -> RunResult | None:
        """Closes the pipes; returns the outcome of the run that was unfinished, None without one.

        Raises:
            ModelError: The process did not start.
            KeyboardInterrupt: The process was ended by a signal, as at a shutdown.
        """
        code = self._process.wait()
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").split("\n")
        self._close()
        message = next((line.strip() for line in reversed(lines) if line.strip()), "")
        cause = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        reason = f"the process ended with {cause}" + (f": {message[:200]}" if message else "")
        outcome = Outcome.CRASHED
        if self._limit is not None:
            outcome, reason = Outcome.TIMED_OUT, f"no end within {self._limit:g} s"
        if not self._is_ready:
            raise ModelError(f"no process for the runs of a study starts; {reason}")
        if code in _ENDED:
            raise KeyboardInterrupt(signal.SIGTERM)
        if not self.unfinished:
            return None
        (number, _), *self.unfinished = self.unfinished
        return RunResult(number, outcome, reason)

    def kill(self) -> None:
        """Kills the process, and closes its pipes."""
        self._process.kill()
        self._process.wait()
        self._close()

    def _send(self, data: Any) -> None:
        with suppress(OSError):  # `read` notices that a process has ended.
            self._process.stdin.write(json.dumps(data).encode() + b"\n")  # type: ignore[union-attr]
            self._process.stdin.flush()  # type: ignore[union-attr]

    def _close(self) -> None:
        self.finish()
        self.output.close()
        self._errors.close()


def serve() -> int:
    """The main function of a process: reads settings and batches of runs, and writes results.

    At the start and after each batch it writes the number of loops that it has built.
    """
    results = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # Other output is redirected to stderr.

    def write(data: Mapping[str, Any]) -> None:
        results.write(json.dumps(data).encode() + b"\n")
        results.flush()

    try:
        runner = Runner(*json.loads(sys.stdin.buffer.readline()))
        write({"builds": 0})
        for line in sys.stdin.buffer:
            for result in runner.run_all(json.loads(line)):
                write(result.to_dict())
            write({"builds": runner.builds})
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except BrokenPipeError:  # The study was killed.
        os._exit(0)
    return 0
