"""States, controls and errors beside their sizes: whether they leave all measure."""

from collections.abc import Sequence
from typing import Self

import numpy as np

from drake_dae.arrays import FloatArray, by_columns
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import SimulationError
from drake_dae.systems.plants.contract import Plant

LASTING = 100.0
"""An error that is so many times the size of its output, on average over the `WINDOW`, diverges."""

ENORMOUS = 1e6
"""An error that is so many times the size of its output diverges at once."""

BEYOND = 1e9
"""A state or a control that is so many times its size diverges at once. A joint that turns all day
does not."""

WINDOW = 0.01
"""The share of a run over which errors are averaged. The mean is that of their logarithms: the peak
of an impact hardly counts."""

KNOWN = 1e-6
"""A smaller size, relative to the largest number that a run starts with, may be round-off: it tells
nothing of an output, which is then not judged."""

Sizes = dict[str, float]
"""Unit -> the largest number in it."""


def with_sizes(sizes: Sizes, signals: Sequence[Signal], values: FloatArray) -> Sizes:
    """Sizes together with those of some signals."""
    merged = dict(sizes)
    for signal, value in zip(signals, values, strict=False):
        if np.isfinite(value):
            merged[signal.unit] = max(merged.get(signal.unit, 0.0), abs(float(value)))
    return merged


class StateGrowth:
    """The states, or the controls, of a plant beside their sizes."""

    def __init__(self, signals: Sequence[Signal], time: float, size: FloatArray) -> None:
        self._signals, self._since, self._size = signals, time, size

    @classmethod
    def states(cls, plant: Plant, time: float, start: FloatArray) -> Self:
        """Those of its states."""
        return cls(plant.dae.state_signals, time, np.maximum(plant.dae.scale, np.abs(start)))

    @classmethod
    def controls(cls, plant: Plant, time: float, sizes: Sizes) -> Self:
        """Those of its controls; of a unit in which nothing has a size none is watched."""
        size = [sizes.get(signal.unit, 0.0) or np.inf for signal in plant.dae.control_signals]
        return cls(plant.dae.control_signals, time, np.array(size))

    def look(
        self, times: FloatArray, values: FloatArray, states: FloatArray
    ) -> SimulationError | None:
        """What diverges first in rows of a run; None if nothing does."""
        if (np.abs(by_columns(values)).max(axis=1) <= 10.0 * self._size).all():
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
    """The errors of outputs beside their sizes."""

    def __init__(
        self, signals: Sequence[Signal], time: float, window: float, sizes: Sizes, least: Sizes
    ) -> None:
        self._signals, self._time, self._window = signals, time, window
        self._largest = max(sizes.values(), default=0.0)
        self._sizes = sizes | {
            unit: max(size, sizes.get(unit, 0.0)) for unit, size in least.items()
        }
        self._mean, self._since = np.zeros(len(signals)), np.full(len(signals), time)

    def look(
        self, times: FloatArray, outputs: FloatArray, desired: FloatArray, states: FloatArray
    ) -> SimulationError | None:
        """What diverges first in rows of a run; None if nothing does."""
        errors = np.abs(outputs - desired)
        if self._is_small(errors, desired):
            self._mean *= np.exp((self._time - times[-1]) / self._window)
            self._since[:] = self._time = times[-1]
            return None
        sizes = self._along(desired)
        least = KNOWN * np.maximum(self._largest, sizes.max(axis=1, initial=0.0, keepdims=True))
        shares = np.divide(errors, sizes, out=np.zeros_like(errors), where=sizes > least)
        if (shares <= 1.0).all():
            self._mean *= np.exp((self._time - times[-1]) / self._window)
            self._since[:] = self._time = times[-1]
            return None
        held = -np.expm1(-np.diff(times, prepend=self._time) / self._window)
        logs = np.log(np.maximum(shares, 1.0))
        for row, time in enumerate(times.tolist()):
            self._mean += held[row] * (logs[row] - self._mean)
            self._since[shares[row] <= 1.0] = self._time = time
            beyond = (self._mean > np.log(LASTING)) | (shares[row] > ENORMOUS)
            if not beyond.any():
                continue
            worst = int(np.argmax(np.where(beyond, shares[row], 0.0)))
            signal, size = self._signals[worst], sizes[row, worst]
            error = outputs[row, worst] - desired[row, worst]
            return _diverged(
                f"the error of {_amount(signal, error)}, {shares[row, worst]:.2g} times the "
                f"{_quantity(size, signal)} that was asked for or was there at the start",
                (float(self._since[worst]), time),
                states[row],
            )

        return None

    def _is_small(self, errors: FloatArray, desired: FloatArray) -> bool:
        """Whether no error is larger than its size was before these rows; then sizes grow."""
        units = [signal.unit for signal in self._signals]
        sizes = np.array([self._sizes.get(unit, 0.0) for unit in units])
        if not (by_columns(errors).max(axis=1) <= sizes).all():
            return False
        largest_now = np.abs(by_columns(desired)).max(axis=1)
        for unit, largest in zip(units, largest_now.tolist(), strict=True):
            self._sizes[unit] = max(self._sizes.get(unit, 0.0), largest)
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
        "may_diverge the run goes on all the same",
        time,
        state,
    )
