"""States, controls and errors beside their sizes: whether they leave all measure."""

from collections.abc import Sequence
from typing import Self

import numpy as np

from drake_dae.arrays import FloatArray, by_columns
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import SimulationError
from drake_dae.systems.plants.contract import Plant

LASTING = 100.0
"""The mean ratio of an error to the size of its output, over the `WINDOW`, that is divergence."""

ENORMOUS = 1e6
"""The ratio of an error to the size of its output that is divergence even at a single time."""

BEYOND = 1e9
"""The ratio of a state or a control to its size that is divergence. A joint that turns all day does
not reach it."""

WINDOW = 0.01
"""The fraction of a run over which errors are averaged. The logarithms are averaged, so that the
peak of an impact hardly counts."""

MEANINGFUL = 1e-6
"""Outputs and controls whose size is below this fraction of the largest number at the start are not
judged: their size may be round-off."""

Sizes = dict[str, float]
"""Unit -> the largest number in it."""


def with_sizes(sizes: Sizes, signals: Sequence[Signal], values: FloatArray) -> Sizes:
    """The largest numbers in each unit, of these sizes and of further values, shape (n,)."""
    merged, amounts = dict(sizes), np.where(np.isfinite(values), np.abs(values), 0.0)
    for index, signal in enumerate(signals[: amounts.size]):
        merged[signal.unit] = max(merged.get(signal.unit, 0.0), float(amounts[index]))
    return merged


def _in_units(sizes: Sizes, signals: Sequence[Signal]) -> FloatArray:
    """The size in the unit of each signal, 0 in a unit without a size; shape (n,)."""
    return np.array([sizes.get(signal.unit, 0.0) for signal in signals], dtype=float)


def _largest(sizes: Sizes) -> float:
    """The largest of all sizes."""
    return max(sizes.values(), default=0.0)


class StateGrowth:
    """The ratios of the states, or of the controls, of a plant to their sizes, shape (n,)."""

    def __init__(self, signals: Sequence[Signal], time: float, size: FloatArray) -> None:
        self._signals, self._since, self._size = signals, time, size

    @classmethod
    def states(cls, plant: Plant, time: float, start: FloatArray) -> Self:
        """The growth of the states of a plant."""
        return cls(plant.dae.state_signals, time, np.maximum(plant.dae.scale, np.abs(start)))

    @classmethod
    def controls(cls, plant: Plant, time: float, sizes: Sizes) -> Self:
        """The growth of the controls of a plant; those in a unit without a size are not judged."""
        size = _in_units(sizes, plant.dae.control_signals)
        is_judged = size > MEANINGFUL * _largest(sizes)
        return cls(plant.dae.control_signals, time, np.where(is_judged, size, np.inf))

    def _are_small(self, largest: FloatArray) -> bool:
        """Whether values up to these sizes, shape (n,), have not even begun to diverge."""
        return bool((largest <= 10.0 * self._size).all())

    def look(
        self, times: FloatArray, values: FloatArray, states: FloatArray
    ) -> SimulationError | None:
        """The error of the first row in which a value diverges; None if none does."""
        if self._are_small(np.abs(by_columns(values)).max(axis=1)):
            self._since = times[-1]
            return None
        shares = np.abs(values) / self._size
        largest = shares.max(axis=1, initial=0.0)
        if largest[-1] <= 10.0 and not largest.max() > BEYOND:
            self._since = times[-1]
            return None
        beyond = np.flatnonzero(largest > BEYOND)
        row = int(beyond[0]) if beyond.size else len(times) - 1
        small = np.flatnonzero(largest[: row + 1] <= 10.0)
        self._since = float(times[small[-1]]) if small.size else self._since
        if not beyond.size:
            return None
        worst = int(np.argmax(shares[row]))
        signal = self._signals[worst]
        return _diverged(
            f"{_amount(signal, values[row, worst])}, {shares[row, worst]:.2g} times the "
            f"{_quantity(self._size[worst], signal)} that it is large in use",
            (self._since, float(times[row])),
            states[row],
        )


class ErrorGrowth:
    """The ratios of the errors of outputs to their sizes, as of `StateGrowth`."""

    def __init__(
        self, signals: Sequence[Signal], time: float, window: float, sizes: Sizes, least: Sizes
    ) -> None:
        self._signals, self._time, self._window = signals, time, window
        self._largest = _largest(sizes)
        self._sizes = sizes | {u: max(size, sizes.get(u, 0.0)) for u, size in least.items()}
        self._mean, self._since = np.zeros(len(signals)), np.full(len(signals), time)

    def look(
        self, times: FloatArray, outputs: FloatArray, desired: FloatArray, states: FloatArray
    ) -> SimulationError | None:
        """The error of the first row in which an output diverges; None if none does."""
        errors = np.abs(outputs - desired)
        if self._is_small(errors, desired):
            self._decay(times[-1])
            return None
        sizes = self._along(desired)
        largest = np.maximum(self._largest, sizes.max(axis=1, initial=0.0, keepdims=True))
        is_judged = sizes > MEANINGFUL * largest
        ratios = np.divide(errors, sizes, out=np.zeros_like(errors), where=is_judged)
        if (ratios <= 1.0).all():
            self._decay(times[-1])
            return None
        weights = -np.expm1(-np.diff(times, prepend=self._time) / self._window)
        logs = np.log(np.maximum(ratios, 1.0))
        if max(logs.max(), self._mean.max()) <= np.log(LASTING):
            # No mean becomes larger than the largest number that it is a mean of.
            self._average(times, weights, logs)
            return None
        for row, time in enumerate(times.tolist()):
            self._mean += weights[row] * (logs[row] - self._mean)
            self._since[ratios[row] <= 1.0] = self._time = time
            beyond = (self._mean > np.log(LASTING)) | (ratios[row] > ENORMOUS)
            if not beyond.any():
                continue
            worst = int(np.argmax(np.where(beyond, ratios[row], 0.0)))
            signal, size = self._signals[worst], sizes[row, worst]
            error = outputs[row, worst] - desired[row, worst]
            return _diverged(
                f"the error of {_amount(signal, error)}, {ratios[row, worst]:.2g} times the "
                f"{_quantity(size, signal)} that was asked for or was there at the start",
                (float(self._since[worst]), time),
                states[row],
            )
        return None

    def _average(self, times: FloatArray, weights: FloatArray, logs: FloatArray) -> None:
        """Updates the means for several times at once, up to which no error diverges."""
        left = np.exp((times - times[-1]) / self._window)
        self._mean *= np.exp((self._time - times[-1]) / self._window)
        self._mean += (left * weights) @ logs
        last = len(times) - 1 - np.argmax(logs[::-1] <= 0.0, axis=0)
        self._since = np.where((logs <= 0.0).any(axis=0), times[last], self._since)
        self._time = float(times[-1])

    def _decay(self, time: float) -> None:
        """Updates the means for a time up to which no error was larger than its size."""
        self._mean *= np.exp((self._time - time) / self._window)
        self._since[:] = self._time = time

    def _is_small(self, errors: FloatArray, desired: FloatArray) -> bool:
        """Whether no error exceeds its size before these rows; if so, updates the sizes."""
        largest = by_columns(errors).max(axis=1)
        if not (largest <= _in_units(self._sizes, self._signals)).all():
            return False
        largest_now = np.abs(by_columns(desired)).max(axis=1)
        for signal, size in zip(self._signals, largest_now.tolist(), strict=True):
            self._sizes[signal.unit] = max(self._sizes.get(signal.unit, 0.0), size)
        return True

    def _along(self, desired: FloatArray) -> FloatArray:
        """The sizes of all outputs at each time, from what was desired up to then."""
        units, along = [signal.unit for signal in self._signals], np.zeros_like(desired)
        for unit in dict.fromkeys(units):
            columns = np.array([other == unit for other in units])
            largest = np.nan_to_num(np.abs(desired[:, columns]), nan=0.0, posinf=0.0).max(axis=1)
            grown = np.maximum.accumulate(np.maximum(largest, self._sizes.get(unit, 0.0)))
            self._sizes[unit] = float(grown[-1])
            along[:, columns] = grown[:, None]
        return along


def _quantity(value: float, signal: Signal) -> str:
    return f"{value:.3g} {signal.unit}".rstrip()


def _amount(signal: Signal, value: float) -> str:
    return f"{signal.name} is {_quantity(value, signal)}"


def _diverged(what: str, times: tuple[float, float], state: FloatArray) -> SimulationError:
    since, time = times
    return SimulationError(
        f"the run diverges: at t = {time:.6g} s {what}, and it has grown since {since:.4g} s. The "
        "loop is unstable, or the robot cannot do what is asked: choose slower gains, a shorter "
        "period and delay of the law, or a plant that is nearer to the law's model. With "
        "judgement.may_diverge the run goes on all the same",
        time,
        state,
    )
