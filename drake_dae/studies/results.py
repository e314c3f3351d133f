"""How runs of a study ended, and their figures."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from math import isfinite
from typing import Any, Self


class Outcome(StrEnum):
    """How a run of a study ended."""

    FINISHED = "finished"
    FAILED = "failed"
    """During the run; figures are up to the failure."""
    NO_START = "no start"
    """No consistent state satisfies the start."""
    REFUSED = "refused"
    """The scenario is inconsistent, or violates an assumption."""
    CRASHED = "crashed"
    """The process ended, or failed unexpectedly."""
    TIMED_OUT = "timed out"
    """The process was ended, since the run exceeded its time limit."""

    @property
    def is_final(self) -> bool:
        """Whether it is a property of the run itself; otherwise it may be tried again."""
        return self not in (Outcome.CRASHED, Outcome.TIMED_OUT)


@dataclass(frozen=True)
class RunResult:
    """The result of a run of a study.

    Attributes:
        run: Its number in the study.
        outcome: How it ended.
        reason: The reason, if it did not finish.
        figures: Name with unit -> value, as `run_figures` has them.
        exceeded: Names of the signals beyond their limits.
        seconds: The elapsed time, including the build.
    """

    run: int
    outcome: Outcome
    reason: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)
    exceeded: tuple[str, ...] = ()
    seconds: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """The result as plain data."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """The result of plain data.

        Raises:
            KeyError, TypeError, ValueError: The data are those of something else.
        """
        values = dict(data)
        values["outcome"] = Outcome(values["outcome"])
        values["exceeded"] = tuple(values["exceeded"])
        found = cls(**values)
        numbers = [*found.figures.values(), found.seconds]
        if not (
            type(found.run) is int
            and found.run >= 0
            and all(type(number) in (int, float) and isfinite(number) for number in numbers)
            and all(isinstance(text, str) for text in (found.reason, *found.exceeded))
            and isinstance(found.figures, dict)
            and found.seconds >= 0.0
        ):
            raise ValueError("no result of a run")
        return found
