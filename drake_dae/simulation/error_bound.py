"""A declared bound of the errors of a run: whether it held, from when not, and by how much."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import number, positive
from drake_dae.dae.system.signals import Signal, outputs_named
from drake_dae.errors import ModelError
from drake_dae.simulation.records.record import Record

USED = "used part of the error bound"
"""The name of a figure: the largest |error| / bound of a run over all bounded outputs."""


@dataclass(frozen=True)
class BoundedOutput:
    """The largest error of a bounded output in a run.

    Attributes:
        signal: The output.
        bound: The bound of |z - r|, in its unit.
        largest, time: The largest |z - r|, and its time in s.
        exceeded: The first time in s at which |z - r| exceeds the bound; None if it never does.
    """

    signal: Signal
    bound: float
    largest: float
    time: float
    exceeded: float | None

    def __str__(self) -> str:
        name, unit = self.signal.name, f" {self.signal.unit}".rstrip()
        if self.exceeded is None:
            used = f"{self.largest / self.bound:.0%}"
            return f"{name} reaches {used} of its bound of {self.bound:.3g}{unit}"
        return (
            f"the error of {name} exceeds its bound of {self.bound:.3g}{unit} from "
            f"{self.exceeded:.4g} s on, by up to {self.largest - self.bound:.2g}{unit} at "
            f"{self.time:.4g} s"
        )


@checked(ModelError)
@dataclass(frozen=True)
class ErrorBound:
    """A bound of the errors of a run, |z - r| <= bound at all times from `after` on.

    The command `drake-dae bound` computes it for declared ranges of unknown numbers. It has no
    influence on the run: the summary reports whether it held.

    Attributes:
        outputs: Output name -> the bound of its |z - r|, in the output's unit, positive.
        after: The time in s from which the bound applies.

    Raises:
        ModelError: There are no outputs, or a number is not valid.
    """

    outputs: Mapping[str, float]
    after: float = 0.0

    def __post_init__(self) -> None:
        if not self.outputs:
            raise ModelError("an error bound needs an output, as {wall.force: 5.0}")
        for name, value in self.outputs.items():
            positive(f"the error bound of {name}", value)
        number("after", self.after)

    def __str__(self) -> str:
        each = ", ".join(f"{name} {value:.3g}" for name, value in self.outputs.items())
        return f"error bound from {self.after:g} s on, in units of the outputs: {each}"

    def check(self, record: Record) -> list[BoundedOutput]:
        """Compares the errors of a run with the bound.

        Args:
            record: A record with tracking_error.

        Returns:
            One entry for each bounded output; none if the record ends before `after`.

        Raises:
            ModelError: The record has no output of such a name.
        """
        signals = record.signals["tracking_error"].signals
        begin = int(np.searchsorted(record.time, self.after - 1e-9))
        times, errors = record.time[begin:], np.abs(record["tracking_error"][begin:])
        found, places = [], outputs_named(self.outputs, signals)
        for index, bound in zip(places, self.outputs.values(), strict=True):
            if not times.size:
                continue
            error = errors[:, index]
            worst = int(np.argmax(error))
            outside = np.flatnonzero(~(error <= bound))
            first = float(times[outside[0]]) if outside.size else None
            found.append(
                BoundedOutput(
                    signals[index], bound, float(error[worst]), float(times[worst]), first
                )
            )
        return found

    def figures(self, record: Record) -> dict[str, float]:
        """Returns |z - r| / bound of each output at its largest, and of all outputs as `USED`.

        Args:
            record: As for `check`.
        """
        used = {each.signal.name: each.largest / each.bound for each in self.check(record)}
        if not used:
            return {}
        return {USED: max(used.values()), **{f"{USED}, {name}": u for name, u in used.items()}}


def bound_words(outputs: list[BoundedOutput]) -> list[str]:
    """Returns the comparison of a run with its error bound, as lines of the summary.

    Args:
        outputs: The result of `ErrorBound.check`.
    """
    if not outputs:
        return ["The run ended before its error bound applies."]
    if broken := [each for each in outputs if each.exceeded is not None]:
        return ["The error bound did not hold:", *(f"  {each}" for each in broken)]
    nearest = max(outputs, key=lambda each: each.largest / each.bound)
    return [f"The error bound held. Closest: {nearest}."]


def exceeds(outputs: list[BoundedOutput] | None) -> bool:
    """Whether a run exceeds its error bound.

    Args:
        outputs: The result of `ErrorBound.check`; None without a bound.
    """
    return any(each.exceeded is not None for each in outputs or ())
