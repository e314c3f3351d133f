"""The outcomes of the runs of a study, and their figures."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from math import isfinite
from typing import Any, Self

from drake_dae.errors import (
    AssumptionError,
    DrakeDaeError,
    InconsistentStateError,
    SimulationError,
)


class Outcome(StrEnum):
    """How a run of a study ended."""

    FINISHED = "finished"
    FAILED = "failed"
    """The run failed before its end. Its figures are those up to the failure."""
    NO_START = "no start"
    """There is no consistent initial state."""
    REFUSED = "refused"
    """The scenario contradicts itself, or violates an assumption."""
    CRASHED = "crashed"
    """The process ended, or raised an unexpected error."""
    TIMED_OUT = "timed out"
    """The process was killed, since the run exceeded its time limit."""

    @property
    def is_final(self) -> bool:
        """Whether another attempt would have the same outcome."""
        return self not in (Outcome.CRASHED, Outcome.TIMED_OUT)


@dataclass(frozen=True)
class RunResult:
    """The result of a run of a study.

    Attributes:
        run: The number of the run in the study.
        outcome: How the run ended.
        reason: Why the run did not finish; empty if it finished.
        figures: Name with unit -> value, from `run_figures`.
        exceeded: The names of the signals that exceed their limits.
        seconds: The elapsed time in s, including the time to build the loop.
    """

    run: int
    outcome: Outcome
    reason: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)
    exceeded: tuple[str, ...] = ()
    seconds: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """The result as plain data."""
        return {**vars(self), "figures": dict(self.figures)}  # asdict takes ten times as long.

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Creates a result from plain data, the inverse of `to_dict`.

        Raises:
            KeyError, TypeError, ValueError: The data are no result of a run.
        """
        values = dict(data)
        values["outcome"] = Outcome(values["outcome"])
        values["exceeded"] = tuple(values["exceeded"])
        result = cls(**values)
        numbers = [*result.figures.values(), result.seconds]
        if not (
            type(result.run) is int
            and result.run >= 0
            and all(type(number) in (int, float) and isfinite(number) for number in numbers)
            and all(isinstance(text, str) for text in (result.reason, *result.exceeded))
            and isinstance(result.figures, dict)
            and result.seconds >= 0.0
        ):
            raise ValueError("no result of a run")
        return result


def not_started(number: int, error: DrakeDaeError) -> RunResult:
    """The result of a run that could not begin."""
    outcome = Outcome.NO_START if is_about_states(error) else Outcome.REFUSED
    return RunResult(number, outcome, str(error))


def is_about_states(error: BaseException | None) -> bool:
    """Whether an error is about states or assumptions, and not about keys of the scenario."""
    while error is not None:
        if isinstance(error, (AssumptionError, InconsistentStateError, SimulationError)):
            return True
        error = error.__cause__
    return False
