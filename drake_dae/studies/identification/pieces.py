"""A record cut into short pieces with independent initial states: multiple shooting."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from drake_dae.arrays import FloatArray
from drake_dae.studies.identification.driven import DrivenPlant, MovedPieces
from drake_dae.studies.identification.measured import Measured
from drake_dae.studies.identification.openings import parts_between

DURATION, ROWS = 0.01, 10
"""The duration of a piece in s, and its least number of rows. A longer piece in stiff contact would
lose the contact with wrong states and parameters."""

ACCURATE = 1e-7
"""Steps are halved until the final state of a piece changes by less, relative to its size."""

MOST_PARTS, ENOUGH = 64, 8
"""The largest number of integration steps between two rows; and the number after which more steps
do not make the results finite."""

FEW = 0.1
"""If at most this fraction of the pieces needs more than `ENOUGH` steps, these are left out."""


class PieceDerivatives(NamedTuple):
    """Results of pieces, and derivatives with respect to their initial states and all unknowns.

    Attributes:
        errors: Measured minus computed columns, nan where nothing is measured, shape (j, k, c).
        of_errors: Derivatives of `errors`, shape (j, k, c, n + p).
        ends: The final states, shape (j, n).
        of_ends: Derivatives of `ends`, shape (j, n, n + p).
        residuals: The initial constraint residuals and their derivatives, shapes (j, m) and
            (j, m, n + p).
        is_finite: Whether all computed values are finite.
    """

    errors: FloatArray
    of_errors: FloatArray
    ends: FloatArray
    of_ends: FloatArray
    residuals: tuple[FloatArray, FloatArray]
    is_finite: bool


@dataclass(frozen=True, eq=False)
class RecordPieces:
    """A record in pieces.

    Attributes:
        driven: The plant.
        data: The record.
        biases: For each column the index of its bias among the unknowns of sensors; -1 for none.
        num_sensed: The number of unknowns of sensors. They follow those of the plant.
        parts: The number of integration steps of a continuous plant between two rows.
        delays: For each column the index of its delay, as in `biases`; -1 for none.
    """

    driven: DrivenPlant
    data: Measured
    biases: np.ndarray
    delays: np.ndarray
    num_sensed: int
    parts: int = 1

    @cached_property
    def length(self) -> int:
        """The number of rows of a piece."""
        return max(ROWS, round(DURATION / float(np.median(np.diff(self.data.times)))))

    @cached_property
    def _parts(self) -> Sequence[tuple[int, int]]:
        """First and last row of each part between events of contacts."""
        return parts_between(self.data.cut)

    @cached_property
    def _ends(self) -> np.ndarray:
        """First row of each piece, and the last row of its part, shape (j, 2)."""
        k = self.length
        return np.array(
            [(i, last) for first, last in self._parts for i in range(first, last + 1, k)]
        )

    @cached_property
    def rows(self) -> np.ndarray:
        """The rows of each piece and the first row of the next, shape (j, k + 1).

        The last row of a part is repeated to fill its last piece.
        """
        firsts, lasts = self._ends.T
        return np.minimum(firsts[:, None] + np.arange(self.length + 1), lasts[:, None])

    @cached_property
    def is_own(self) -> np.ndarray:
        """Whether each of the first k entries of `rows` belongs to the piece, shape (j, k)."""
        firsts, lasts = self._ends.T
        return firsts[:, None] + np.arange(self.length) <= lasts[:, None]

    @cached_property
    def is_joined(self) -> np.ndarray:
        """Whether each piece ends at the first row of the next one, shape (j - 1,)."""
        firsts, lasts = self._ends.T
        return (lasts[:-1] == lasts[1:]) & (np.diff(firsts) == self.length)

    @cached_property
    def first_states(self) -> FloatArray:
        """The initial guess of the initial states, shape (j, n)."""
        return self.data.states[self.rows[:, 0]]

    @cached_property
    def values(self) -> FloatArray:
        """The measured columns minus known biases, shape (j, k, c); nan after the last row."""
        values: FloatArray = self._measured[self.rows[:, :-1]]
        values[~self.is_own] = np.nan
        return values

    @cached_property
    def spread(self) -> FloatArray:
        """The largest standard deviation of the columns of each column's group, shape (c,).

        At least 1e-3 of their root mean square, and 1 if that is zero, too.
        """
        spread = np.ones(len(self.data.channels))
        for group in self.data.groups:
            columns = self.values[:, :, group].reshape(-1, len(group))
            deviation = float(np.max(np.nanstd(columns, axis=0)))
            size = float(np.sqrt(np.nanmean(np.square(columns))))
            spread[group] = max(deviation, 1e-3 * size) or 1.0
        return spread

    @cached_property
    def _measured(self) -> FloatArray:
        known = np.array([channel.bias for channel in self.data.channels])
        return self.data.values - np.where(self.biases < 0, known, 0.0)

    @cached_property
    def _columns(self) -> np.ndarray:
        """The indices of the measured columns in the outputs of the plant."""
        places = self.driven.output_places
        return np.array([places[c.port].start + c.place for c in self.data.channels])

    @cached_property
    def _controls(self) -> list[list[FloatArray]]:
        """The controls of `DrivenPlant.step` for each step between rows."""
        times, controls, rows = self.data.times, self.data.controls, self.rows
        if self.driven.period:
            count = round(float(times[1] - times[0]) / self.driven.period)
            return [count * [controls[rows[:, k]]] for k in range(self.length)]
        stages = 2 * self.parts + 1
        if self.driven.hold is not None:
            return [stages * [controls[rows[:, k]]] for k in range(self.length)]
        begins, ends = times[rows[:, :-1]], times[rows[:, 1:]]
        fractions = np.linspace(0.0, 1.0, stages)[:, None, None]
        moments = np.moveaxis(begins + fractions * (ends - begins), 2, 0)  # (k, stages, j)
        smooth = np.zeros((*moments.shape, controls.shape[1]))
        for first, last in self._parts:
            own = self._ends[:, 1] == last
            spline = CubicSpline(times[first : last + 1], controls[first : last + 1])
            smooth[:, :, own] = spline(moments[:, :, own])
        return [list(of_step) for of_step in smooth]

    def slopes(
        self, states: FloatArray, unknown: FloatArray, known: PieceDerivatives | None = None
    ) -> PieceDerivatives:
        """Computes all pieces.

        Args:
            states: The initial states, shape (j, n).
            unknown: The unknowns of the plant, then those of the sensors, shape (p,).
            known: Results nearby, whose derivatives are reused; None to compute derivatives.
        """
        driven, times = self.driven, self.data.times[self.rows]
        of_plant, sensed = np.split(unknown, [unknown.size - self.num_sensed])
        moved = driven.initial(states) if known is None else MovedPieces(states)
        outputs = list[MovedPieces]()
        for k, controls in enumerate(self._controls):
            acting = self.data.acting[self.rows[:, k]]
            outputs.append(driven.evaluated(times[:, k], moved, of_plant, acting))
            moved = driven.step(times[:, k], times[:, k + 1], moved, of_plant, controls)
        columns = self._columns
        of_constraints = driven.output_places.get("constraint_residual", slice(0, 0))
        computed = np.stack([each.values[:, columns] for each in outputs], axis=1)
        is_finite = bool(np.isfinite(computed).all() and np.isfinite(moved.values).all())
        delayed, rates = self._delayed(computed, sensed)
        biases = np.append(sensed, 0.0)[self.biases]  # Index -1, no bias, selects the last 0.
        errors = self._later(sensed) - delayed - biases
        residual = outputs[0].values[:, of_constraints]
        if known is not None:
            of_errors, of_ends, of_residual = known.of_errors, known.of_ends, known.residuals[1]
        else:
            of_computed = np.stack([_slopes(each)[:, columns] for each in outputs], axis=1)
            of_errors = -np.concatenate([of_computed, self._of_sensed(rates)], axis=3)
            of_ends = self._padded(_slopes(moved))
            of_residual = self._padded(_slopes(outputs[0])[:, of_constraints])
            is_finite = is_finite and bool(np.isfinite(of_errors).all())
        residuals = residual, of_residual
        return PieceDerivatives(errors, of_errors, moved.values, of_ends, residuals, is_finite)

    def _shifts(self, sensed: FloatArray) -> tuple[np.ndarray, FloatArray]:
        """The delay of each column as a number of rows and a remainder in s."""
        delays = np.append(sensed, 0.0)[self.delays]
        step = float(np.median(np.diff(self.data.times)))
        rows = np.round(delays / step)
        return rows.astype(int), delays - rows * step

    def _later(self, sensed: FloatArray) -> FloatArray:
        """The measured columns, each shifted by the whole rows of its delay."""
        shifted, (rows, _) = self.values.copy(), self._shifts(sensed)
        for column in np.flatnonzero(rows):
            places = self.rows[:, :-1] + rows[column]
            is_there = (places >= 0) & (places < self.data.times.size) & self.is_own
            raw = self._measured[np.clip(places, 0, self.data.times.size - 1), column]
            shifted[:, :, column] = np.where(is_there, raw, np.nan)
        return shifted

    def _delayed(self, computed: FloatArray, sensed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The computed columns, earlier by the remainders of delays, and derivatives by delays."""
        delayed, rates, (_, rests) = computed.copy(), np.zeros_like(computed), self._shifts(sensed)
        step = float(np.median(np.diff(self.data.times)))
        for column in np.flatnonzero(self.delays >= 0):
            rate = np.gradient(computed[:, :, column], step, axis=1, edge_order=2)
            second = np.gradient(rate, step, axis=1, edge_order=2)
            rest = rests[column]
            delayed[:, :, column] += rest * (rest / 2.0 * second - rate)
            rates[:, :, column] = rest * second - rate
        return delayed, rates

    def _of_sensed(self, rates: FloatArray) -> FloatArray:
        """The derivatives of the computed columns with respect to the unknowns of sensors."""
        slopes = np.zeros((*rates.shape, self.num_sensed))
        for column, bias in enumerate(self.biases):
            if bias >= 0:
                slopes[:, :, column, bias] = 1.0
            if self.delays[column] >= 0:
                slopes[:, :, column, self.delays[column]] = rates[:, :, column]
        return slopes

    def _padded(self, slopes: FloatArray) -> FloatArray:
        """Appends the derivatives with respect to the unknowns of sensors, which are zero."""
        return np.concatenate([slopes, np.zeros((*slopes.shape[:2], self.num_sensed))], axis=2)

    def first(self, count: int) -> "RecordPieces":
        """A copy with only the first rows."""
        return replace(self, data=self.data.first(count))

    def fine_enough(self, unknown: FloatArray) -> "RecordPieces":
        """A copy with steps so short that the final states of pieces are accurate.

        A few pieces that need far shorter steps than the others, as in contact with static
        friction, are left out.
        """
        if self.driven.period:
            return self
        sizes = np.maximum(self.driven.scale, np.abs(self.first_states).max(axis=0))
        pieces, ends = self, self._guessed_ends(unknown)
        while pieces.parts < MOST_PARTS:
            finer = replace(self, parts=2 * pieces.parts)
            after = finer._guessed_ends(unknown)
            is_rough = ~((np.abs(after - ends) / sizes).max(axis=1) < ACCURATE)
            if not is_rough.any() or (pieces.parts >= ENOUGH and is_rough.mean() <= FEW):
                return pieces._without(is_rough)
            pieces, ends = finer, after
            if pieces.parts >= ENOUGH and np.isfinite(ends).all(axis=1).mean() < 0.5:
                break  # The length of steps is not the reason.
        return pieces

    def _without(self, pieces: np.ndarray) -> "RecordPieces":
        """A copy without some pieces."""
        if not pieces.any():
            return self
        cut = self.data.cut.copy()
        for first, after in self.rows[pieces][:, [0, -1]]:
            cut[max(first - 1, 0) : after] = True
        return replace(self, data=replace(self.data, cut=cut))

    def _guessed_ends(self, unknown: FloatArray) -> FloatArray:
        """The final states of pieces from their guessed initial states."""
        of_plant = unknown[: unknown.size - self.num_sensed]
        times, moved = self.data.times[self.rows], MovedPieces(self.first_states)
        with np.errstate(all="ignore"):
            for k, controls in enumerate(self._controls):
                moved = self.driven.step(times[:, k], times[:, k + 1], moved, of_plant, controls)
        return moved.values


def _slopes(moved: MovedPieces) -> FloatArray:
    assert moved.slopes is not None
    return moved.slopes
