"""What a record says of a plant: controls, measured outputs, and a first guess of the states."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from pydrake.systems.framework import OutputPort, System

from drake_dae.arrays import FloatArray, listed
from drake_dae.dae.system.signals import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.simulation.records.record import Record
from drake_dae.studies.identification.driven import Driven
from drake_dae.systems.blocks.traced import Traced

SAME = 1e-3
"""Times that differ by less than this part of a period are one."""

LARGEST = 1e9
"""A larger number in a record is that of a run that has diverged."""

FEWEST = 20
"""A record needs at least so many rows."""


@dataclass(frozen=True, eq=False)
class Channel:
    """A measured column, and what the plant has for it.

    Attributes:
        signal: The name of the signal in the record.
        entry: Name and unit of the column.
        port: The name of the output that it measures.
        place: Its place in that output.
        bias: What the sensor adds, where it is not unknown.
    """

    signal: str
    entry: Signal
    port: str
    place: int
    bias: float = 0.0

    @property
    def name(self) -> str:
        """Its name in reports."""
        return f"{self.signal}.{self.entry.name}"

    @property
    def group(self) -> tuple[str, str]:
        """Columns of one group have the same noise."""
        return self.signal, self.entry.unit


@dataclass(frozen=True, eq=False)
class Measured:
    """A record as data for the identification of a plant.

    Attributes:
        times: The times in s, shape (k,).
        acting: u at the times, or just after them where the force is sampled then, shape (k, q).
        controls: The same or, of a held control, that of the step from a row to the next one.
        states: A first guess of the states, shape (k, n).
        values: The measured columns, shape (k, c); nan where there is no measurement.
        channels: What they measure.
    """

    times: FloatArray
    acting: FloatArray
    controls: FloatArray
    states: FloatArray
    values: FloatArray
    channels: Sequence[Channel]

    def first(self, count: int) -> Self:
        """The first rows alone."""
        return replace(
            self,
            times=self.times[:count],
            acting=self.acting[:count],
            controls=self.controls[:count],
            states=self.states[:count],
            values=self.values[:count],
        )


def measured_ports(loop: ClosedLoop) -> dict[str, OutputPort]:
    """Name -> an output port of the plant that a record may measure.

    With "constraint_residual", which is zero where constraints are ideal.
    """
    plant = loop.plant
    found = {name: plant.GetOutputPort(name) for name in ("state", "constraint_force")}
    if plant.is_ideal and plant.dae.num_constraints:
        found["constraint_residual"] = plant.GetOutputPort("constraint_residual")
    return found


def measured(record: Record, driven: Driven, title: str) -> Measured:
    """The data of a record.

    Args:
        record: The record.
        driven: The plant.
        title: What messages call the record.

    Raises:
        ModelError: The record has too few rows, no controls, nothing that is measured, columns of
            another robot or in other units, values that are not finite, or steps that do not fit
            those of the plant.
    """
    loop, plant = driven.loop, driven.loop.plant
    if record.time.size < FEWEST:
        raise ModelError(
            f"{title} has {record.time.size} rows; at least {FEWEST} are needed: record a longer "
            "motion, or rows at fixed steps or samples"
        )
    _check_steps(record, plant.time_step, title)
    columns = _columns(record, "control", plant.dae.control_signals, title)
    missing = [s.name for s in plant.dae.control_signals if s.name not in columns]
    if missing:
        raise ModelError(
            f"{title} has no column {listed(missing)} of the signal 'control', and the plant is "
            "driven by all recorded controls"
        )
    controls = np.column_stack([columns[s.name] for s in plant.dae.control_signals])
    acting, after = controls, np.vstack([controls[1:], controls[-1:]])
    if driven.hold is not None:  # A row of a continuous plant has what led to it.
        is_after = _acts_before(driven.hold, record.time, driven.period) | (not driven.period)
        controls = np.where(is_after[:, None], after, acting)
    channels, values = _channels(record, loop, title)
    if not channels:
        raise ModelError(
            f"{title} has neither positions (signal 'state' or of the encoders) nor forces "
            f"('constraint_force' or 'measured_force'); it has {listed(record.signals)}"
        )
    if driven.hold is not None and any(each.signal == "measured_force" for each in channels):
        acting = controls  # A sensor samples what the control makes that has just been set.
    states = _first_states(record, driven, channels, values, title)
    found = Measured(record.time, acting, controls, states, np.column_stack(values), channels)
    # The last row has the control and the sample of its instant, others those before it.
    steps = float(np.diff(record.time)[-1]) / driven.period if driven.period else 1.0
    is_last = abs(steps - round(steps)) > SAME or (driven.hold is not None and not driven.period)
    return found.first(record.time.size - 1) if is_last else found


def _check_steps(record: Record, period: float, title: str) -> None:
    """Refuses a record whose rows are not those of the steps of a discrete plant."""
    if not period:
        return
    steps = np.diff(record.time)[:-1]  # A run may end within a step.
    counts = np.round(steps / period)
    if (np.abs(steps / period - counts) > SAME).any() or counts[0] < 1 or np.ptp(counts) > 0:
        raise ModelError(
            f"{title} has rows {steps.min():.4g} to {steps.max():.4g} s after each other, and the "
            f"plant steps by {period:g} s: rows must come at each step, or at each second, third, "
            "... one"
        )


def _acts_before(hold: System, times: FloatArray, period: float) -> np.ndarray:
    """At which rows a hold acts just before the step of a discrete plant, by round-off of the time.

    As in Drake, two updates are of one instant if their times are the same to the last bit.
    """
    found = np.zeros(times.size, dtype=bool)
    if not (period and isinstance(hold, Traced)):
        return found
    steps = period * np.round(times / period)
    for update in hold.traced().updates:
        count = np.round((steps - update.offset) / update.period)
        moments = update.offset + count * update.period
        found |= (moments < steps) & (moments > steps - SAME * period)
    return found


def _columns(
    record: Record, name: str, expected: Sequence[Signal], title: str
) -> dict[str, FloatArray]:
    """The columns of a signal by the plant's names.

    Raises:
        ModelError: The record has other names or units, or values that are not finite.
    """
    if name not in record.signals:
        return {}
    units = {signal.name: signal.unit for signal in expected}
    found, recorded = {}, record.signals[name]
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
        found[signal.name] = values
    return found


def is_position(signal: Signal) -> bool:
    """Whether a state is measured: all but those that are per second, such as velocities."""
    return "/s" not in signal.unit


def _channels(
    record: Record, loop: ClosedLoop, title: str
) -> tuple[list[Channel], list[FloatArray]]:
    plant, channels, values = loop.plant, list[Channel](), list[FloatArray]()
    # Positions, as encoders show them or as they are.
    name, biases = "state", np.zeros(plant.dae.num_states)
    if loop.encoders is not None:
        name = "measured_state" if "measured_state" in loop.signals else "estimated_state"
        given = np.asarray(loop.encoders.sensor.encoders.position_bias, dtype=float)
        count = plant.robot("an encoder").links.q.numel()
        biases[:count] = given
    if name not in record.signals:
        name, biases = "state", 0.0 * biases
    columns = _columns(record, name, plant.dae.state_signals, title)
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
    columns = _columns(record, name, signals, title)
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
                # It is drawn anew after each time constant, and rows between have the same one.
                drawn = np.ceil(record.time / sensor.time_constant - SAME)
                column = np.where(np.diff(drawn, append=np.inf) > 0.0, column, np.nan)
        channels.append(Channel(name, signal, port, place, bias))
        values.append(column)
    return channels, values


def _at_samples(times: FloatArray, column: FloatArray, period: float) -> FloatArray:
    """A column at the samples, and nan between them."""
    is_sample = np.abs(times - period * np.round(times / period)) < SAME * period
    return np.where(is_sample, column, np.nan)


def _sampled(times: FloatArray, column: FloatArray, period: float, later: int) -> FloatArray:
    """What a sensor that samples has measured, at the rows of these samples; nan elsewhere.

    A row has the last sample before it.

    Args:
        times: The times of the rows in s.
        column: What the rows have.
        period: The time between samples in s.
        later: How many rows after the time of a sample its force is found.
    """
    found = np.full_like(column, np.nan)
    taken = (np.ceil((times - SAME * period) / period) - 1.0) * period
    rows = np.searchsorted(times, taken - SAME * period)
    is_there = np.abs(times[np.minimum(rows, times.size - 1)] - taken) < SAME * period
    good = is_there & (rows + later < times.size)
    # Of the rows with one sample the first one: the last row of a record may have the next.
    found[rows[good][::-1] + later] = column[good][::-1]
    return found


def _first_states(
    record: Record,
    driven: Driven,
    channels: Sequence[Channel],
    values: Sequence[FloatArray],
    title: str,
) -> FloatArray:
    """States from the record, velocities from differences of positions where it has none."""
    plant = driven.loop.plant
    found = np.zeros((record.time.size, driven.num_states))
    signals, first = plant.dae.state_signals, driven.state_of_plant.start
    known = dict[str, FloatArray]()
    for name in ("estimated_state", "measured_state", "state"):
        known |= _columns(record, name, signals, title)
    for channel, column in zip(channels, values, strict=True):
        if channel.port == "state" and "state" not in record.signals:
            known[channel.entry.name] = _filled(record.time, column) - channel.bias
    missing = [s.name for s in signals if s.name not in known and is_position(s)]
    if missing:
        raise ModelError(f"{title} lacks the positions {listed(missing)}")
    known |= _rates(driven, known, record.time)
    for place, signal in enumerate(signals):
        found[:, first + place] = known[signal.name]
    size = len(signals)
    if driven.period and "contact_force" in record.signals:
        force = record["contact_force"]
        found[:, first + size : first + size + force.shape[1]] = force
    for channel, column in zip(channels, values, strict=True):
        if channel.port == "felt_force":
            felt = _filled(record.time, column) - channel.bias
            found[:, driven.felt.start + channel.place] = felt
    return found


def _filled(times: FloatArray, column: FloatArray) -> FloatArray:
    """A column with straight lines where it has no values."""
    known = np.isfinite(column)
    return np.interp(times, times[known], column[known])


def _rates(
    driven: Driven, known: Mapping[str, FloatArray], times: FloatArray
) -> dict[str, FloatArray]:
    """Differences of positions, for velocities that a record lacks."""
    signals = driven.loop.plant.dae.state_signals
    positions = [signal for signal in signals if is_position(signal)]
    velocities = [signal for signal in signals if not is_position(signal)]
    lacking = [signal.name for signal in velocities if signal.name not in known]
    if lacking and len(positions) != len(velocities):
        raise ModelError(
            f"the record lacks {listed(lacking)}, which do not follow from the positions by "
            "differences; record them"
        )
    pairs = zip(positions, velocities, strict=False)
    return {v.name: np.gradient(known[q.name], times) for q, v in pairs if v.name in lacking}
