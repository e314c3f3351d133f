"""The measured columns of a record, and the plant's outputs that they measure."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray, listed
from drake_dae.dae.system.signals import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.simulation.records.record import Record

SAME = 1e-3
"""Times that differ by less than this fraction of a period count as equal."""

LARGEST = 1e9
"""A run with a larger number in its record has diverged."""


@dataclass(frozen=True, eq=False)
class Channel:
    """A measured column of a record, and the entry of an output port that it measures.

    Attributes:
        signal: The name of the signal in the record.
        entry: Name and unit of the column.
        port: The name of the output port.
        place: The index of the entry in that port.
        bias: The bias of the sensor, where it is no unknown of the identification.
    """

    signal: str
    entry: Signal
    port: str
    place: int
    bias: float = 0.0

    @property
    def name(self) -> str:
        """The name of the column in reports."""
        return f"{self.signal}.{self.entry.name}"

    @property
    def group(self) -> tuple[str, str]:
        """Columns with an equal group have the same noise level."""
        return self.signal, self.entry.unit


def columns_of(
    record: Record, name: str, expected: Sequence[Signal], title: str
) -> dict[str, FloatArray]:
    """Returns the columns of a signal by the plant's names; none if it was not recorded.

    Raises:
        ModelError: The record has other names or units, or values that are not finite.
    """
    if name not in record.signals:
        return {}
    units = {signal.name: signal.unit for signal in expected}
    columns, recorded = {}, record.signals[name]
    for signal, values in zip(recorded.signals, recorded.values.T, strict=True):
        if signal.name not in units:
            raise ModelError(
                f"{title} has '{name}.{signal.name}', and that of this robot has {listed(units)}: "
                "it is the record of another robot, or a column is misnamed"
            )
        if signal.unit and signal.unit != units[signal.name]:
            raise ModelError(
                f"{title} has '{name}.{signal.name}' in {signal.unit}; it must be in "
                f"{units[signal.name] or '1'}"
            )
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values)))
            raise ModelError(
                f"{title}: '{name}.{signal.name}' is not a number at {record.time[row]:g} s; leave "
                "out the rows from there on"
            )
        if np.abs(values).max(initial=0.0) > LARGEST:
            row = int(np.argmax(np.abs(values) > LARGEST))
            raise ModelError(
                f"{title}: '{name}.{signal.name}' is {values[row]:.2g} at {record.time[row]:g} s: "
                "the run has failed there; leave out the rows shortly before and from there on"
            )
        columns[signal.name] = values
    return columns


def is_position(signal: Signal) -> bool:
    """Whether a state is a position: its unit has no "/s"."""
    return "/s" not in signal.unit


def channels_of(
    record: Record, loop: ClosedLoop, title: str
) -> tuple[list[Channel], list[FloatArray]]:
    """Returns the measured columns and their values; nan where there is no measurement.

    Raises:
        ModelError: A column has no measurement, since rows are too far apart.
    """
    plant, channels, values = loop.plant, list[Channel](), list[FloatArray]()
    # Positions: of the encoders, or exact ones.
    name, biases = "state", np.zeros(plant.dae.num_states)
    if loop.encoders is not None:
        name = "measured_state" if "measured_state" in loop.signals else "estimated_state"
        count = plant.robot("an encoder").links.q.numel()
        biases[:count] = loop.encoders.sensor.encoders.position_bias
    if name not in record.signals:
        name, biases = "state", 0.0 * biases
    columns = columns_of(record, name, plant.dae.state_signals, title)
    period = loop.encoders.sensor.period if loop.encoders is not None and name != "state" else 0.0
    for place, signal in enumerate(plant.dae.state_signals):
        if signal.name in columns and is_position(signal):
            channels.append(Channel(name, signal, "state", place, float(biases[place])))
            # Between samples a record repeats the last one.
            column = columns[signal.name]
            values.append(_at_samples(record.time, column, period) if period else column)
    # Forces.
    sensor = loop.sensor
    is_sensed = sensor is not None and "measured_force" in record.signals
    name = "measured_force" if is_sensed else "constraint_force"
    signals = plant.dae.constraint_input_signals if is_sensed else plant.dae.force_signals
    columns = columns_of(record, name, signals, title)
    for place, signal in enumerate(signals):
        if signal.name not in columns:
            continue
        column, port, bias = columns[signal.name], "constraint_force", 0.0
        if is_sensed and sensor is not None:
            bias, port = float(sensor.bias[place]), "felt_force" if sensor.time_constant else port
            if sensor.sample_period:
                # A discrete plant has stepped when the sensor samples, a lag has not.
                later = int(plant.time_step > 0.0 and not sensor.time_constant)
                column = _sampled(record.time, column, sensor.sample_period, later)
            elif loop.noise is not None:
                # Noise is drawn anew after each time constant; rows between have equal noise.
                drawn = np.ceil(record.time / sensor.time_constant - SAME)
                column = np.where(np.diff(drawn, append=np.inf) > 0.0, column, np.nan)
        channels.append(Channel(name, signal, port, place, bias))
        values.append(column)
    for channel, column in zip(channels, values, strict=True):
        if np.isnan(column).all():
            apart = float(np.median(np.diff(record.time)))
            raise ModelError(
                f"{title} has no row at which '{channel.signal}' was sampled; its rows are "
                f"{apart:g} s apart: record rows at the samples, as by fixed steps of this period "
                "(integrator.use_error_control: false, integrator.max_step_size)"
            )
    return channels, values


def _at_samples(times: FloatArray, column: FloatArray, period: float) -> FloatArray:
    """A column with nan between the samples."""
    is_sample = np.abs(times - period * np.round(times / period)) < SAME * period
    return np.where(is_sample, column, np.nan)


def _sampled(times: FloatArray, column: FloatArray, period: float, later: int) -> FloatArray:
    """Moves the values of a sampling sensor to the rows at which it sampled; nan elsewhere.

    A recorded row contains the last sample before it.

    Args:
        times: The times of the rows in s.
        column: The recorded values.
        period: The sample period in s.
        later: The number of rows from the time of a sample to the row with its force.
    """
    sampled = np.full_like(column, np.nan)
    taken = (np.ceil((times - SAME * period) / period) - 1.0) * period
    rows = np.searchsorted(times, taken - SAME * period)
    is_there = np.abs(times[np.minimum(rows, times.size - 1)] - taken) < SAME * period
    good = is_there & (rows + later < times.size)
    # The first of the rows with the same sample: the last row of a record may have the next one.
    sampled[rows[good][::-1] + later] = column[good][::-1]
    return sampled
