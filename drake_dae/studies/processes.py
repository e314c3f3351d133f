"""Processes of this machine that simulate the runs of a study.

They are used instead of `concurrent.futures`, where a dying process ends all others: here a crash,
as in Drake's C++, is the outcome of one run, and scripts need no guard for their main module. Tasks
and results are lines of JSON.
"""

import json
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Generator, Mapping, Sequence
from contextlib import suppress
from math import isfinite
from typing import IO, Any

from drake_dae.errors import ModelError
from drake_dae.simulation.records.interruption import ENDING_SIGNALS
from drake_dae.studies.results import Outcome, RunResult
from drake_dae.studies.runs import Runner
from drake_dae.studies.structures import Batch

BUILDS = 200
"""The number of loops after which a process is replaced, since Drake does not free all memory."""

PERIOD = 0.02
"""The period of reporting results, in s: those of short runs are synced to the disk together."""

STARTING = 300.0
"""The longest start of a process, in s."""

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_ENDED = {128 + signal.SIGINT, *(-number for number in ENDING_SIGNALS)}
"""Exit codes of a process that was ended by a signal."""


def cores() -> int:
    """The number of cores available to this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_in_processes(
    settings: Sequence[Any],
    batches: Sequence[Batch],
    workers: int,
    time_limit: float = float("inf"),
) -> Generator[list[RunResult], None, None]:
    """The results of all runs, in the order in which they end.

    Args:
        settings: The arguments of `Runner`, as plain data.
        batches: The runs.
        workers: The number of processes.
        time_limit: The time limit of a run, in s; a process that exceeds it is ended.

    Raises:
        ModelError: A process does not start.
    """
    waiting, workers = deque(batches), min(workers, len(batches))
    running: list[_Worker] = []
    found: list[RunResult] = []
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
                due = min(due, last_report + PERIOD - now) if found else due
                for key, _ in selector.select(max(0.0, due) if isfinite(due) else None):
                    worker = key.data
                    is_open = worker.read()
                    found += worker.take()
                    if not is_open:
                        selector.unregister(worker.output)
                        running.remove(worker)
                        lost = worker.close()
                        found += [lost] if lost else []
                        if worker.left:
                            waiting.appendleft(worker.left)
                    elif worker.is_idle and waiting and worker.builds < BUILDS:
                        worker.give(waiting.popleft())
                    elif worker.is_idle:
                        worker.dismiss()
                for worker in running:
                    if time.monotonic() >= worker.due(time_limit):
                        worker.stop(time_limit)  # Its run is reported when its output ends.
                if found and (time.monotonic() >= last_report + PERIOD or not (waiting or running)):
                    last_report = time.monotonic()
                    yield found
                    found = []
        finally:
            for worker in running:
                worker.kill()


class _Worker:
    """A worker process and its runs.

    Attributes:
        output: The pipe of its results.
        left: Its runs without a result.
        is_idle: Whether it waits for runs.
        builds: The number of loops that it has built.
        began: The start of its present run, by the monotonic clock in s; infinite while it is idle.
    """

    def __init__(self, settings: Sequence[Any]) -> None:
        # Loaded modules are permanent, so the garbage collector need not examine them.
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
            env={**dict.fromkeys(_THREADS, "1"), **os.environ},
            start_new_session=True,  # Ctrl-C is handled by the study, which ends them.
        )
        self.output: IO[bytes] = self._process.stdout  # type: ignore[assignment]
        self.left: Batch = []
        self.is_idle = False
        self.builds = 0
        self.began = time.monotonic()
        self._is_ready = False
        self._limit: float | None = None
        self._text = b""
        self._results: list[RunResult] = []
        self._send(settings)

    def give(self, batch: Batch) -> None:
        """Gives it runs."""
        self.left, self.is_idle = list(batch), False
        self.began = time.monotonic()
        self._send(self.left)

    def dismiss(self) -> None:
        """Lets it end."""
        with suppress(OSError):
            self._process.stdin.close()  # type: ignore[union-attr]

    def read(self) -> bool:
        """Reads its results; False at the end of its output."""
        data = os.read(self.output.fileno(), 1 << 16)
        *lines, self._text = (self._text + data).split(b"\n")
        for line in lines:
            line_data = json.loads(line)
            if "builds" in line_data:
                self._is_ready = self.is_idle = True
                self.began, self.builds = float("inf"), line_data["builds"]
            else:
                self._results.append(RunResult.from_dict(line_data))
                self.left, self.began = self.left[1:], time.monotonic()
        return bool(data)

    def due(self, limit: float) -> float:
        """The time at which its run exceeds the limit, by the monotonic clock in s."""
        return self.began + (limit if self._is_ready else max(limit, STARTING))

    def stop(self, limit: float) -> None:
        """Ends it, since its run exceeds a limit in s; `read` and `close` report it."""
        if self._limit is None:
            self._limit = limit
            self._process.kill()
        self.began = float("inf")

    def take(self) -> list[RunResult]:
        """The results since the last call."""
        found, self._results = self._results, []
        return found

    def close(self) -> RunResult | None:
        """Closes it, and returns the outcome of its unfinished run if it died.

        Raises:
            ModelError: It did not start.
            KeyboardInterrupt: It was ended by a signal, as at a shutdown.
        """
        code = self._process.wait()
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").split("\n")
        self._close()
        said = next((line.strip() for line in reversed(lines) if line.strip()), "")
        how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        reason = f"the process ended with {how}" + (f": {said[:200]}" if said else "")
        outcome = Outcome.CRASHED
        if self._limit is not None:
            outcome, reason = Outcome.TIMED_OUT, f"no end within {self._limit:g} s"
        if not self._is_ready:
            raise ModelError(f"no process for the runs of a study starts; {reason}")
        if code in _ENDED:
            raise KeyboardInterrupt(signal.SIGTERM)
        if not self.left:
            return None
        (number, _), *rest = self.left
        self.left = rest
        return RunResult(number, outcome, reason)

    def kill(self) -> None:
        """Kills it."""
        self._process.kill()
        self._process.wait()
        self._close()

    def _send(self, data: Any) -> None:
        with suppress(OSError):  # A process that has ended is noticed by reading.
            self._process.stdin.write(json.dumps(data).encode() + b"\n")  # type: ignore[union-attr]
            self._process.stdin.flush()  # type: ignore[union-attr]

    def _close(self) -> None:
        with suppress(OSError):
            self._process.stdin.close()  # type: ignore[union-attr]
        self.output.close()
        self._errors.close()


def serve() -> int:
    """The main function of a process: it reads the scenario, then runs, and reports each result.

    After each batch, and at the start, it reports the number of loops it has built.
    """
    results = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # Other output is redirected to stderr.

    def tell(data: Mapping[str, Any]) -> None:
        results.write(json.dumps(data).encode() + b"\n")
        results.flush()

    try:
        runner = Runner(*json.loads(sys.stdin.buffer.readline()))
        tell({"builds": 0})
        for line in sys.stdin.buffer:
            for result in runner.run_all(json.loads(line)):
                tell(result.to_dict())
            tell({"builds": runner.builds})
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except BrokenPipeError:  # The study was killed.
        os._exit(0)
    return 0
