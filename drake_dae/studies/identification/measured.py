"""The data of a record: controls, measured outputs, and an initial guess of the states."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from pydrake.systems.framework import OutputPort, System

from drake_dae.arrays import FloatArray, listed
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.simulation.records.record import Record
from drake_dae.studies.identification.channels import (
    SAME,
    Channel,
    channels_of,
    columns_of,
    is_position,
)
from drake_dae.studies.identification.driven import DrivenPlant
from drake_dae.studies.identification.openings import cuts, modes
from drake_dae.systems.blocks.traced import Traced

FEWEST = 20
"""The least number of rows of a record."""


@dataclass(frozen=True, eq=False)
class Measured:
    """A record as data for the identification of a plant.

    Attributes:
        times: The times in s, shape (k,).
        acting: u at the times, or just after them if the force is sampled then, followed by the
            mode of each unilateral contact (1 closed, 0 open), shape (k, q).
        controls: Like `acting`, with u during the step from a row to the next if u has a zero-order
            hold, shape (k, q).
        states: An initial guess of the states, shape (k, n).
        values: The measured columns, shape (k, c); nan where there is no measurement.
        channels: The measured entries, one for each column.
        cut: Whether a contact changes or has an impact, or a control jumps, between a row and the
            next, shape (k - 1,).
    """

    times: FloatArray
    acting: FloatArray
    controls: FloatArray
    states: FloatArray
    values: FloatArray
    channels: Sequence[Channel]
    cut: np.ndarray

    def first(self, count: int) -> Self:
        """A copy with only the first rows."""
        names = ("times", "acting", "controls", "states", "values")
        rows = {name: getattr(self, name)[:count] for name in names}
        return replace(self, **rows, cut=self.cut[: count - 1])

    @property
    def groups(self) -> list[list[int]]:
        """The indices of the columns of each group, see `Channel.group`."""
        groups: dict[tuple[str, str], list[int]] = {}
        for index, channel in enumerate(self.channels):
            groups.setdefault(channel.group, []).append(index)
        return list(groups.values())


def measured_ports(loop: ClosedLoop) -> dict[str, OutputPort]:
    """Returns the output ports of the plant that identification uses: name -> port.

    Ideal constraints add "constraint_residual", which must be zero.
    """
    plant = loop.plant
    names = ["state", "constraint_force"]
    if plant.is_ideal and plant.dae.num_constraints:
        names.append("constraint_residual")
    return {name: plant.GetOutputPort(name) for name in names}


def measured(record: Record, driven: DrivenPlant, title: str) -> Measured:
    """Returns the data of a record.

    Args:
        record: The record.
        driven: The plant.
        title: The name of the record in messages.

    Raises:
        ModelError: The record has too few rows, no controls, no measurements, columns of another
            robot or in other units, values that are not finite, or steps that do not fit those of
            the plant.
    """
    loop, plant = driven.loop, driven.loop.plant
    if record.time.size < FEWEST:
        raise ModelError(
            f"{title} has {record.time.size} rows; at least {FEWEST} are needed: record a longer "
            "motion, or rows at fixed steps or samples"
        )
    _check_steps(record, plant.time_step, title)
    columns = columns_of(record, "control", plant.dae.control_signals, title)
    missing = [s.name for s in plant.dae.control_signals if s.name not in columns]
    if missing:
        raise ModelError(
            f"{title} has no column {listed(missing)} of the signal 'control', and the plant is "
            "driven by all recorded controls"
        )
    controls = np.column_stack([columns[s.name] for s in plant.dae.control_signals])
    acting, after = controls, np.vstack([controls[1:], controls[-1:]])
    if driven.hold is not None:  # A row of a continuous plant has the control before it.
        is_after = _acts_before(driven.hold, record.time, driven.period) | (not driven.period)
        controls = np.where(is_after[:, None], after, acting)
    channels, values = channels_of(record, loop, title)
    if not channels:
        raise ModelError(
            f"{title} has neither positions (signal 'state' or of the encoders) nor forces "
            f"('constraint_force' or 'measured_force'); it has {listed(record.signals)}"
        )
    if driven.hold is not None and any(each.signal == "measured_force" for each in channels):
        acting = controls  # The sensor samples the force of the control that was just set.
    states = _first_states(record, driven, channels, values, title)
    mode = modes(record, plant, title)
    acting, controls = np.hstack([acting, mode]), np.hstack([controls, mode])
    cut = cuts(record, mode, driven.hold is not None)
    if cut.all():
        raise ModelError(
            f"{title} has a contact that opens, closes or is struck between all of its rows; "
            "record more rows"
        )
    measurements = np.column_stack(values)
    data = Measured(record.time, acting, controls, states, measurements, channels, cut)
    # The last row has the control and the sample of its own instant, other rows earlier ones.
    steps = float(np.diff(record.time)[-1]) / driven.period if driven.period else 1.0
    is_last = abs(steps - round(steps)) > SAME or (driven.hold is not None and not driven.period)
    return data.first(record.time.size - 1) if is_last else data


def _check_steps(record: Record, period: float, title: str) -> None:
    """Checks that the rows of a record are at steps of a discrete plant."""
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
    """At which rows a hold updates just before the step of a discrete plant, due to round-off.

    As in Drake, two updates are simultaneous if their times are equal to the last bit.
    """
    is_before = np.zeros(times.size, dtype=bool)
    if not (period and isinstance(hold, Traced)):
        return is_before
    steps = period * np.round(times / period)
    for update in hold.traced().updates:
        count = np.round((steps - update.offset) / update.period)
        moments = update.offset + count * update.period
        is_before |= (moments < steps) & (moments > steps - SAME * period)
    return is_before


def _first_states(
    record: Record,
    driven: DrivenPlant,
    channels: Sequence[Channel],
    values: Sequence[FloatArray],
    title: str,
) -> FloatArray:
    """The recorded states; missing velocities are differences of positions."""
    plant = driven.loop.plant
    states = np.zeros((record.time.size, driven.num_states))
    signals, first = plant.dae.state_signals, driven.state_of_plant.start
    known = dict[str, FloatArray]()
    for name in ("estimated_state", "measured_state", "state"):
        known |= columns_of(record, name, signals, title)
    for channel, column in zip(channels, values, strict=True):
        if channel.port == "state" and "state" not in record.signals:
            known[channel.entry.name] = _filled(record.time, column) - channel.bias
    missing = [s.name for s in signals if s.name not in known and is_position(s)]
    if missing:
        raise ModelError(f"{title} lacks the positions {listed(missing)}")
    known |= _rates(driven, known, record.time)
    for place, signal in enumerate(signals):
        states[:, first + place] = known[signal.name]
    size = len(signals)
    if driven.period and "contact_force" in record.signals:
        force = record["contact_force"]
        states[:, first + size : first + size + force.shape[1]] = force
    for channel, column in zip(channels, values, strict=True):
        if channel.port == "felt_force":
            felt = _filled(record.time, column) - channel.bias
            states[:, driven.felt.start + channel.place] = felt
    return states


def _filled(times: FloatArray, column: FloatArray) -> FloatArray:
    """A column whose missing values are interpolated linearly."""
    known = np.isfinite(column)
    return np.interp(times, times[known], column[known])


def _rates(
    driven: DrivenPlant, known: Mapping[str, FloatArray], times: FloatArray
) -> dict[str, FloatArray]:
    """The velocities that a record lacks, as differences of positions."""
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
