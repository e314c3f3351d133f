"""What a record says of a plant: controls, measured outputs, and a first guess of the states."""

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
"""A record needs at least so many rows."""


@dataclass(frozen=True, eq=False)
class Measured:
    """A record as data for the identification of a plant.

    Attributes:
        times: The times in s, shape (k,).
        acting: u at the times, or just after them where the force is sampled then, and for each
            contact that opens 1 where it is closed, else 0, shape (k, q).
        controls: The same or, of a held control, that of the step from a row to the next one.
        states: A first guess of the states, shape (k, n).
        values: The measured columns, shape (k, c); nan where there is no measurement.
        channels: What they measure.
        cut: Between which rows a contact opens, closes or is struck, or a control jumps, shape
            (k - 1,).
    """

    times: FloatArray
    acting: FloatArray
    controls: FloatArray
    states: FloatArray
    values: FloatArray
    channels: Sequence[Channel]
    cut: np.ndarray

    def first(self, count: int) -> Self:
        """The first rows alone."""
        return replace(
            self,
            times=self.times[:count],
            acting=self.acting[:count],
            controls=self.controls[:count],
            states=self.states[:count],
            values=self.values[:count],
            cut=self.cut[: count - 1],
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


def measured(record: Record, driven: DrivenPlant, title: str) -> Measured:
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
    columns = columns_of(record, "control", plant.dae.control_signals, title)
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
    channels, values = channels_of(record, loop, title)
    if not channels:
        raise ModelError(
            f"{title} has neither positions (signal 'state' or of the encoders) nor forces "
            f"('constraint_force' or 'measured_force'); it has {listed(record.signals)}"
        )
    if driven.hold is not None and any(each.signal == "measured_force" for each in channels):
        acting = controls  # A sensor samples what the control makes that has just been set.
    states = _first_states(record, driven, channels, values, title)
    mode = modes(record, plant, title)
    acting, controls = np.hstack([acting, mode]), np.hstack([controls, mode])
    cut = cuts(record, mode, driven.hold is not None)
    if cut.all():
        raise ModelError(
            f"{title} has a contact that opens, closes or is struck between all of its rows; "
            "record more rows"
        )
    given = np.column_stack(values), channels, cut
    found = Measured(record.time, acting, controls, states, *given)
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


def _first_states(
    record: Record,
    driven: DrivenPlant,
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
        known |= columns_of(record, name, signals, title)
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
    driven: DrivenPlant, known: Mapping[str, FloatArray], times: FloatArray
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
