"""Runs that diverge: a state, a control or a tracking error leaves all measure, and since when."""

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae import Signal
from drake_dae.diagrams.record import Record
from drake_dae.errors import SimulationError
from drake_dae.running.judgement import unit_sizes
from drake_dae.systems.plant import Plant

# An error diverges at this many sizes of its output, as a mean over the window, and at once. The
# mean is that of logarithms, so that the peak of an impact hardly counts.
LASTING, ENORMOUS = 100.0, 1e6
WINDOW = 0.01  # The share of a run over which errors are averaged.
# A state or a control diverges at this many sizes; a joint that turns all day does not reach it.
BEYOND = 1e9
# Outputs and controls of a size below this share of the largest number at the start are not judged:
# it may be round-off.
MEANINGFUL = 1e-6


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
        self._plant, self._window, self._has_begun = plant, WINDOW * duration, False

    def _begin(self, record: Record) -> None:
        """Keeps the sizes at the start, and the bounds of states, outputs and controls."""
        dae, self._has_begun, self._time = self._plant.dae, True, float(record.time[0])
        names = ("state", "controlled_output", "constraint_force", "control")
        rows = [record.signals[name] for name in names if name in record]
        self._sizes = unit_sizes(*((r.signals, r.values[:1]) for r in rows), least={})
        self._largest = max(self._sizes.values(), default=0.0)
        self._state_sizes = np.maximum(dae.scale, np.abs(record["state"][0]))
        controls = np.array([self._sizes.get(signal.unit, 0.0) for signal in dae.control_signals])
        self._control_sizes = self._meaningful(controls)
        # One radian; the length 1 of an axis of a robot's frame.
        for unit in ("rad", "") if self._plant.model is not None else ("rad",):
            self._sizes[unit] = max(1.0, self._sizes.get(unit, 0.0))
        self._outputs = tuple[Signal, ...]()
        if "desired_output" in record:
            self._outputs = record.signals["desired_output"].signals
        self._signals = [*dae.state_signals, *self._outputs, *dae.control_signals]
        counts = [dae.num_states, len(self._outputs), dae.num_controls]
        self._is_output = np.repeat([False, True, False], counts)
        self._usual = np.where(self._is_output, 1.0, 10.0)
        self._most = np.where(self._is_output, ENORMOUS, BEYOND)
        self._is_control = np.repeat([False, False, True], counts)
        self._mean, self._since = np.zeros(sum(counts)), np.full(sum(counts), self._time)

    def look(self, record: Record, *, is_last: bool = False) -> None:
        """Checks the next rows of a record; without a reference, its states alone."""
        if not record.time.size:
            return
        if not self._has_begun:
            self._begin(record)
        times, states, shape = record.time, record["state"], (record.time.size, len(self._signals))
        values, sizes = np.zeros(shape), np.ones(shape)
        values[:, : states.shape[1]], sizes[:, : states.shape[1]] = states, self._state_sizes
        if "desired_output" in record:
            wanted = record["desired_output"]
            values[:, self._is_output] = record["controlled_output"] - wanted
            sizes[:, self._is_output] = self._output_sizes(wanted)
        if "control" in record:
            values[:, self._is_control] = record["control"]
            sizes[:, self._is_control] = self._control_sizes
        ratios = np.abs(values) / sizes
        if (ratios <= self._usual).all():
            self._mean *= np.exp((self._time - times[-1]) / self._window)
            self._since[:] = self._time = float(times[-1])
            return
        most = np.where(self._is_control & (not is_last), np.inf, self._most)
        for row, (time, ratio) in enumerate(zip(times.tolist(), ratios, strict=True)):
            weight = -np.expm1((self._time - time) / self._window)
            grown = np.log(np.maximum(np.where(self._is_output, ratio, 1.0), 1.0))
            self._mean += weight * (grown - self._mean)
            self._since[ratio <= self._usual] = self._time = time
            is_beyond = (ratio > most) | (self._mean > np.log(LASTING))
            if is_beyond.any():
                i = int(np.argmax(np.where(is_beyond, ratio / self._most, -1.0)))
                signal, value, size = self._signals[i], values[row, i], sizes[row, i]
                unit, what = f" {signal.unit}".rstrip(), "the error of " * bool(self._is_output[i])
                raise SimulationError(
                    f"the run diverges: at t = {time:.6g} s {what}{signal.name} is {value:.3g}"
                    f"{unit}, {ratio[i]:.2g} times the {size:.3g}{unit} that it is large in use, "
                    f"and it has grown since {self._since[i]:.4g} s. The loop is unstable, or the "
                    "robot cannot do what is asked: choose slower gains, a shorter period and "
                    "delay of the law, or a plant that is nearer to the law's model. With "
                    "judgement.may_diverge the run goes on all the same",
                    time,
                    states[row],
                )

    def _meaningful(self, sizes: FloatArray) -> FloatArray:
        """Sizes, infinite where they may be round-off."""
        largest = np.maximum(self._largest, sizes.max(axis=-1, initial=0.0, keepdims=True))
        return np.where(sizes > MEANINGFUL * largest, sizes, np.inf)

    def _output_sizes(self, wanted: FloatArray) -> FloatArray:
        """The sizes of all outputs at each time, from what was wanted up to then."""
        units, along = np.array([signal.unit for signal in self._outputs]), np.zeros_like(wanted)
        for unit in dict.fromkeys(units.tolist()):
            columns = units == unit
            largest = np.nan_to_num(np.abs(wanted[:, columns]), posinf=0.0).max(axis=1)
            grown = np.maximum.accumulate(np.maximum(largest, self._sizes.get(unit, 0.0)))
            self._sizes[unit] = float(grown[-1])
            along[:, columns] = grown[:, None]
        return self._meaningful(along)
