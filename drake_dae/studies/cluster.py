"""A Dask cluster that simulates the runs of a study."""

import json
from collections.abc import Generator, Sequence
from concurrent.futures import CancelledError
from functools import lru_cache
from threading import Lock
from typing import Any

from drake_dae.arrays import brief
from drake_dae.errors import ModelError
from drake_dae.studies.results import Outcome, RunResult
from drake_dae.studies.runs import Runner
from drake_dae.studies.structures import Batch

WAIT = 30.0
"""The longest time to wait for a scheduler, in s."""


class Cluster:
    """A connection to a scheduler; a context manager.

    Args:
        address: The address of the scheduler, for example "tcp://head:8786".

    Raises:
        ModelError: `distributed` is not installed, no scheduler answers, or it has no workers.
    """

    def __init__(self, address: str) -> None:
        try:
            import distributed
        except ImportError:
            raise ModelError(
                "a cluster needs Dask's scheduler: pip install 'drake_dae[cluster]'"
            ) from None
        self._address = address
        self._dask: Any = distributed  # Its types are incomplete.
        try:
            self._client = self._dask.Client(address, timeout=WAIT, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise ModelError(
                f"no Dask scheduler answers at {brief(address)}: {brief(str(error))}"
            ) from None
        self.workers = sum(self._client.nthreads().values())
        if not self.workers:
            self.close()
            raise ModelError(f"the Dask cluster at {address} has no workers; start some")

    def run(
        self, settings: Sequence[Any], batches: Sequence[Batch]
    ) -> Generator[list[RunResult], None, None]:
        """Simulates all runs; yields the results of each batch when it ends.

        Dask submits a batch again if its worker dies; after several failures each of its runs is
        submitted separately.

        Args:
            settings: The arguments of `Runner`, as plain data.
            batches: The runs.

        Raises:
            ModelError: The scheduler is gone, or a worker has another version of the library.
        """
        text = json.dumps(settings)
        pending: dict[Any, Batch] = {}

        def submit(batch: Batch) -> Any:
            future = self._client.submit(run_batch, text, list(batch), pure=False)
            pending[future.key] = batch
            return future

        futures = [submit(batch) for batch in batches]
        awaited = self._dask.as_completed(futures, loop=self._client.loop)
        for future in awaited:
            batch = pending.pop(future.key)
            try:
                results = [RunResult.from_dict(data) for data in future.result()]
            except self._dask.KilledWorker as error:
                if len(batch) > 1:
                    awaited.update([submit([run]) for run in batch])
                    continue
                reason = f"the workers that had it ended: {str(error).partition('. ')[0]}"
                results = [RunResult(batch[0][0], Outcome.CRASHED, reason)]
            except CancelledError:
                raise ModelError(
                    f"the Dask scheduler at {self._address} is gone; runs that have ended are kept"
                ) from None
            except Exception as error:
                raise ModelError(
                    f"the Dask cluster at {self._address} failed, {type(error).__name__}: "
                    f"{brief(str(error))}; its workers need the same drake_dae"
                ) from error
            yield results

    def close(self) -> None:
        """Closes the connection, which cancels runs without a result."""
        self._client.close()

    def __enter__(self) -> "Cluster":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


_ALONE = Lock()
"""Threads of a worker share one loop, so that only one of them simulates at a time."""


def run_batch(base: str, batch: Batch) -> list[dict[str, Any]]:
    """Simulates runs in a worker of a cluster, and returns their results as plain data.

    Args:
        base: The arguments of `Runner` as JSON.
        batch: The runs.
    """
    with _ALONE:
        return [result.to_dict() for result in _runner(base).run_all(batch)]


@lru_cache(maxsize=1)
def _runner(base: str) -> Runner:
    return Runner(*json.loads(base))
