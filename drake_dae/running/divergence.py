"""Runs that diverge: a state, a control or a tracking error leaves all measure, and since when."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae import Signal
from drake_dae.diagrams.record import Record
from drake_dae.errors import SimulationError
from drake_dae.running.judgement import unit_sizes
from drake_dae.systems.plants.contract import Plant

LASTING, ENORMOUS = 100.0, 1e6
"""The ratio of an error to the size of its output that is divergence: as a mean over the `WINDOW`,
and at a single time."""

BEYOND = 1e9
"""The ratio of a state or a control to its size that is divergence. A joint that turns all day does
not reach it."""

WINDOW = 0.01
"""The fraction of a run over which errors are averaged. The logarithms are averaged, so that the
peak of an impact hardly counts."""

MEANINGFUL = 1e-6
"""Outputs and controls whose size is below this fraction of the largest number at the start are not
judged: their size may be round-off."""


@dataclass
class _Growth:
    """Ratios of signals to their sizes, and since when they are above the usual ones."""

    signals: Sequence[Signal]
    time: float
    usual: float
    most: float
    lasting: float = np.inf
    window: float = np.inf

    def __post_init__(self) -> None:
        self._mean, self.since = np.zeros(len(self.signals)), np.full(len(self.signals), self.time)

    def beyond(self, times: FloatArray, ratios: FloatArray) -> tuple[int, int] | None:
        """The first row with a ratio beyond all measure, and the signal; None if there is none."""
        if not ratios.size or (ratios <= self.usual).all():
            self._mean *= np.exp((self.time - times[-1]) / self.window)
            self.since[:] = self.time = float(times[-1])
            return None
        for row, (time, ratio) in enumerate(zip(times.tolist(), ratios, strict=True)):
            weight = -np.expm1((self.time - time) / self.window)
            self._mean += weight * (np.log(np.maximum(ratio, 1.0)) - self._mean)
            self.since[ratio <= self.usual] = self.time = time
            is_beyond = (ratio > self.most) | (self._mean > np.log(self.lasting))
            if is_beyond.any():
                return row, int(np.argmax(np.where(is_beyond, ratio, 0.0)))
        return None


class DivergenceWatch:
    """Raises an error if states, controls or tracking errors grow beyond all bounds.

    A state is compared with its initial value and with `DaeSystem.scale`. The tracking error z - r
    of an output is compared with the largest value of the reference up to now, and of outputs,
    states, forces and controls at the start, in the same unit. A control is compared with the
    initial values in its unit, and only at the end of the run: if it is large before, as near a
    singular configuration, the run fails with a better message. So no verdict depends on units, and
    the force of an impact, the sag under a payload or a distant start are not divergence.
    """

    def __init__(self, plant: Plant, duration: float) -> None:
        self._plant, self._window = plant, WINDOW * duration
        self._states: _Growth | None = None
        self._errors: _Growth | None = None

    def look(self, record: Record, *, is_last: bool = False) -> None:
        """Checks the next rows of a record; without a reference, its states alone."""
        if not record.time.size:
            return
        dae, time, states = self._plant.dae, float(record.time[0]), record["state"]
        if self._states is None:
            names = ("state", "controlled_output", "constraint_force", "control")
            rows = [record.signals[name] for name in names if name in record]
            self._sizes = unit_sizes(*((r.signals, r.values[:1]) for r in rows), least={})
            self._largest = max(self._sizes.values(), default=0.0)
            self._scale = np.maximum(dae.scale, np.abs(states[0]))
            self._states = _Growth(dae.state_signals, time, 10.0, BEYOND)
            self._controls = _Growth(dae.control_signals, time, 10.0, BEYOND)
            units = [self._sizes.get(signal.unit, 0.0) for signal in dae.control_signals]
            self._control_scale = self._meaningful(np.array(units))
            # One radian; the length 1 of an axis of a robot's frame.
            for unit in ("rad", "") if self._plant.model is not None else ("rad",):
                self._sizes[unit] = max(1.0, self._sizes.get(unit, 0.0))
        found = [self._first(self._states, record, states, np.tile(self._scale, (len(states), 1)))]
        if "desired_output" in record:
            wanted, signals = record["desired_output"], record.signals["desired_output"].signals
            self._errors = self._errors or _Growth(
                signals, time, 1.0, ENORMOUS, LASTING, self._window
            )
            errors, sizes = record["controlled_output"] - wanted, self._along(signals, wanted)
            found.append(self._first(self._errors, record, errors, sizes))
        if is_last and "control" in record:
            sizes = np.tile(self._control_scale, (len(states), 1))
            found.append(self._first(self._controls, record, record["control"], sizes))
        if failures := [failure for failure in found if failure is not None]:
            raise min(failures, key=lambda failure: failure.time)

    def _first(
        self, growth: _Growth, record: Record, values: FloatArray, sizes: FloatArray
    ) -> SimulationError | None:
        """The error of the first row in which a value is beyond its size."""
        place = growth.beyond(record.time, np.abs(values) / sizes)
        if place is None:
            return None
        row, i = place
        signal, unit = growth.signals[i], f" {growth.signals[i].unit}".rstrip()
        what = f"the error of {signal.name}" if growth is self._errors else signal.name
        time, value, size = float(record.time[row]), values[row, i], sizes[row, i]
        return SimulationError(
            f"the run diverges: at t = {time:.6g} s {what} is {value:.3g}{unit}, "
            f"{abs(value) / size:.2g} times the {size:.3g}{unit} that it is large in use, and it "
            f"has grown since {growth.since[i]:.4g} s. The loop is unstable, or the robot cannot "
            "do what is asked: choose slower gains, a shorter period and delay of the law, or a "
            "plant that is nearer to the law's model. With judgement.may_diverge the run goes on "
            "all the same",
            time,
            record["state"][row],
        )

    def _meaningful(self, sizes: FloatArray) -> FloatArray:
        """Sizes, infinite where they may be round-off."""
        largest = np.maximum(self._largest, sizes.max(axis=-1, initial=0.0, keepdims=True))
        return np.where(sizes > MEANINGFUL * largest, sizes, np.inf)

    def _along(self, signals: Sequence[Signal], wanted: FloatArray) -> FloatArray:
        """The sizes of all outputs at each time, from what was wanted up to then."""
        units, along = np.array([signal.unit for signal in signals]), np.zeros_like(wanted)
        for unit in dict.fromkeys(units.tolist()):
            columns = units == unit
            largest = np.nan_to_num(np.abs(wanted[:, columns]), posinf=0.0).max(axis=1)
            grown = np.maximum.accumulate(np.maximum(largest, self._sizes.get(unit, 0.0)))
            self._sizes[unit] = float(grown[-1])
            along[:, columns] = grown[:, None]
        return self._meaningful(along)
