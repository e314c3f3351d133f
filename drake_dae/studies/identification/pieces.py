"""A record cut into short pieces, each from a state of its own: multiple shooting."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from drake_dae.arrays import FloatArray
from drake_dae.studies.identification.driven import DrivenPlant, MovedPieces
from drake_dae.studies.identification.measured import Measured
from drake_dae.studies.identification.openings import parts

DURATION, ROWS = 0.01, 10
"""A piece lasts so long in s, and has at least so many rows: in stiff contact a longer one loses
the contact where states and parameters are wrong."""

ACCURATE = 1e-7
"""Steps are halved until the end of a piece changes by less than this, relative to the state."""

MOST_PARTS, ENOUGH = 64, 8
"""A step between two rows is divided into at most so many, and what is not finite with the latter
is not with more."""

FEW = 0.1
"""If no larger share of the pieces needs more than `ENOUGH`, these are left out."""


class PieceDerivatives(NamedTuple):
    """Pieces and their derivatives with respect to their first states and all unknowns.

    Attributes:
        errors: Measured minus computed columns, nan where nothing is measured, shape (j, k, c).
        of_errors: Their derivatives, shape (j, k, c, n + p).
        ends: The states at the ends, shape (j, n).
        of_ends: Their derivatives, shape (j, n, n + p).
        residuals: Constraints at the beginning, and their derivatives: (j, m), (j, m, n + p).
        is_finite: Whether everything that was computed is.
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
        biases: For each column the unknown of sensors that is its bias; -1 for none.
        num_sensed: The number of unknowns of sensors, which come after those of the plant.
        parts: How many steps of a continuous plant are made between two rows.
        delays: For each column the unknown that is its delay, as `biases`; None for none at all.
    """

    driven: DrivenPlant
    data: Measured
    biases: np.ndarray
    num_sensed: int
    parts: int = 1
    delays: np.ndarray | None = None

    @cached_property
    def length(self) -> int:
        """The number of rows of a piece."""
        return max(ROWS, round(DURATION / float(np.median(np.diff(self.data.times)))))

    @cached_property
    def _parts(self) -> Sequence[tuple[int, int]]:
        """First and last rows of what lies between events of contacts."""
        return parts(self.data.cut)

    @cached_property
    def _ends(self) -> np.ndarray:
        """First row of each piece, and the last one of its part, shape (j, 2)."""
        k = self.length
        return np.array(
            [(i, last) for first, last in self._parts for i in range(first, last + 1, k)]
        )

    @cached_property
    def rows(self) -> np.ndarray:
        """The rows of each piece and the first one of the next, shape (j, k + 1).

        Behind the last row of a part it is repeated.
        """
        firsts, lasts = self._ends.T
        return np.minimum(firsts[:, None] + np.arange(self.length + 1), lasts[:, None])

    @cached_property
    def is_own(self) -> np.ndarray:
        """Which of `rows` but the last are rows of that piece, shape (j, k)."""
        firsts, lasts = self._ends.T
        return firsts[:, None] + np.arange(self.length) <= lasts[:, None]

    @cached_property
    def is_joined(self) -> np.ndarray:
        """Which pieces end where the next one begins, shape (j - 1,)."""
        firsts, lasts = self._ends.T
        return (lasts[:-1] == lasts[1:]) & (np.diff(firsts) == self.length)

    @cached_property
    def first_states(self) -> FloatArray:
        """The guess of the states at the beginnings, shape (j, n)."""
        return self.data.states[self.rows[:, 0]]

    @cached_property
    def values(self) -> FloatArray:
        """The measured columns less known biases, shape (j, k, c); nan behind the last row."""
        found: FloatArray = self._measured[self.rows[:, :-1]]
        found[~self.is_own] = np.nan
        return found

    @cached_property
    def spread(self) -> FloatArray:
        """How much the columns of each group vary, shape (c,).

        Their size if they do not vary, and 1 if that is zero.
        """
        groups = [channel.group for channel in self.data.channels]
        found = np.ones(len(groups))
        for group in set(groups):
            own = [i for i, each in enumerate(groups) if each == group]
            columns = self.values[:, :, own].reshape(-1, len(own))
            varies = float(np.max(np.nanstd(columns, axis=0)))
            size = float(np.sqrt(np.nanmean(np.square(columns))))
            found[own] = max(varies, 1e-3 * size) or 1.0
        return found

    @cached_property
    def _measured(self) -> FloatArray:
        known = np.array([channel.bias for channel in self.data.channels])
        return self.data.values - np.where(self.biases < 0, known, 0.0)

    @cached_property
    def _places(self) -> np.ndarray:
        """Where the measured columns stand in what the plant shows."""
        firsts = dict(zip(self.driven.names, np.cumsum([0, *self.driven.sizes]), strict=False))
        return np.array([firsts[one.port] + one.place for one in self.data.channels])

    @cached_property
    def _residuals(self) -> slice:
        firsts = np.cumsum([0, *self.driven.sizes])
        for name, first, size in zip(self.driven.names, firsts, self.driven.sizes, strict=False):
            if name == "constraint_residual":
                return slice(first, first + size)
        return slice(0, 0)

    @cached_property
    def _controls(self) -> list[list[FloatArray]]:
        """For each step between rows the controls as `DrivenPlant.step` takes them."""
        times, controls, rows = self.data.times, self.data.controls, self.rows
        if self.driven.period:
            count = round(float(times[1] - times[0]) / self.driven.period)
            return [count * [controls[rows[:, k]]] for k in range(self.length)]
        stages = 2 * self.parts + 1
        if self.driven.hold is not None:
            return [stages * [controls[rows[:, k]]] for k in range(self.length)]
        begins, ends = times[rows[:, :-1]], times[rows[:, 1:]]
        shares = np.linspace(0.0, 1.0, stages)[:, None, None]
        moments = np.moveaxis(begins + shares * (ends - begins), 2, 0)  # (k, stages, j)
        found = np.zeros((*moments.shape, controls.shape[1]))
        for first, last in self._parts:
            own = self._ends[:, 1] == last
            smooth = CubicSpline(times[first : last + 1], controls[first : last + 1])
            found[:, :, own] = smooth(moments[:, :, own])
        return [list(each) for each in found]

    def slopes(
        self, states: FloatArray, unknown: FloatArray, known: PieceDerivatives | None = None
    ) -> PieceDerivatives:
        """All pieces from some states.

        Args:
            states: Where they begin, shape (j, n).
            unknown: The unknowns of the plant, then the biases, shape (p,).
            known: Pieces nearby, whose derivatives are taken; None for new ones.
        """
        driven, times = self.driven, self.data.times[self.rows]
        of_plant, sensed = np.split(unknown, [unknown.size - self.num_sensed])
        moved = driven.begun(states) if known is None else MovedPieces(states)
        shown = list[MovedPieces]()
        for k, controls in enumerate(self._controls):
            acting = self.data.acting[self.rows[:, k]]
            shown.append(driven.seen(times[:, k], moved, of_plant, acting))
            moved = driven.step(times[:, k], times[:, k + 1], moved, of_plant, controls)
        places, own = self._places, self._residuals
        computed = np.stack([each.values[:, places] for each in shown], axis=1)
        is_finite = bool(np.isfinite(computed).all() and np.isfinite(moved.values).all())
        delayed, rates = self._delayed(computed, sensed)
        of_column = np.append(sensed, 0.0)[self.biases]  # The last one is that of no bias.
        errors = self._later(sensed) - delayed - of_column
        residual = shown[0].values[:, own]
        if known is not None:
            of_errors, of_ends, of_residual = known.of_errors, known.of_ends, known.residuals[1]
        else:
            of_computed = np.stack([_slopes(each)[:, places] for each in shown], axis=1)
            of_errors = -np.concatenate([of_computed, self._of_sensed(rates)], axis=3)
            of_ends = self._padded(_slopes(moved))
            of_residual = self._padded(_slopes(shown[0])[:, own])
            is_finite = is_finite and bool(np.isfinite(of_errors).all())
        residuals = residual, of_residual
        return PieceDerivatives(errors, of_errors, moved.values, of_ends, residuals, is_finite)

    def _shifts(self, sensed: FloatArray) -> tuple[np.ndarray, FloatArray]:
        """The delay of each column as a number of rows and a rest in s."""
        if self.delays is None:
            return np.zeros(len(self.biases), dtype=int), np.zeros(len(self.biases))
        delays = np.append(sensed, 0.0)[self.delays]
        step = float(np.median(np.diff(self.data.times)))
        rows = np.round(delays / step)
        return rows.astype(int), delays - rows * step

    def _later(self, sensed: FloatArray) -> FloatArray:
        """The measured columns, each by its delay later."""
        found, (rows, _) = self.values.copy(), self._shifts(sensed)
        for column in np.flatnonzero(rows):
            places = self.rows[:, :-1] + rows[column]
            is_there = (places >= 0) & (places < self.data.times.size) & self.is_own
            raw = self._measured[np.clip(places, 0, self.data.times.size - 1), column]
            found[:, :, column] = np.where(is_there, raw, np.nan)
        return found

    def _delayed(self, computed: FloatArray, sensed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Computed columns, earlier by what delays leave of whole rows, and minus their rates."""
        found, rates, (_, rests) = computed.copy(), np.zeros_like(computed), self._shifts(sensed)
        step = float(np.median(np.diff(self.data.times)))
        for column in np.flatnonzero([] if self.delays is None else self.delays >= 0):
            rate = np.gradient(computed[:, :, column], step, axis=1, edge_order=2)
            second = np.gradient(rate, step, axis=1, edge_order=2)
            rest = rests[column]
            found[:, :, column] += rest * (rest / 2.0 * second - rate)
            rates[:, :, column] = rest * second - rate
        return found, rates

    def _of_sensed(self, rates: FloatArray) -> FloatArray:
        """The derivatives of the computed columns with respect to the unknowns of sensors."""
        found = np.zeros((*rates.shape, self.num_sensed))
        for column, bias in enumerate(self.biases):
            if bias >= 0:
                found[:, :, column, bias] = 1.0
            if self.delays is not None and self.delays[column] >= 0:
                found[:, :, column, self.delays[column]] = rates[:, :, column]
        return found

    def _padded(self, slopes: FloatArray) -> FloatArray:
        """Derivatives with respect to biases as well, which are zero."""
        return np.concatenate([slopes, np.zeros((*slopes.shape[:2], self.num_sensed))], axis=2)

    def first(self, count: int) -> "RecordPieces":
        """The first rows alone."""
        return replace(self, data=self.data.first(count))

    def fine_enough(self, unknown: FloatArray) -> "RecordPieces":
        """The same with steps so short that the ends of pieces are accurate.

        A few pieces that need far shorter steps than the others, as in contact with friction at
        rest, are left out.
        """
        if self.driven.period:
            return self
        sizes = np.maximum(self.driven.scale, np.abs(self.first_states).max(axis=0))
        found, ends = self, self._found_ends(unknown)
        while found.parts < MOST_PARTS:
            finer = replace(self, parts=2 * found.parts)
            after = finer._found_ends(unknown)
            is_rough = ~((np.abs(after - ends) / sizes).max(axis=1) < ACCURATE)
            if not is_rough.any() or (found.parts >= ENOUGH and is_rough.mean() <= FEW):
                return found.without(is_rough)
            found, ends = finer, after
            if found.parts >= ENOUGH and np.isfinite(ends).all(axis=1).mean() < 0.5:
                break  # It is not the steps.
        return found

    def without(self, pieces: np.ndarray) -> "RecordPieces":
        """The same without some pieces."""
        if not pieces.any():
            return self
        cut = self.data.cut.copy()
        for first, after in self.rows[pieces][:, [0, -1]]:
            cut[max(first - 1, 0) : after] = True
        return replace(self, data=replace(self.data, cut=cut))

    def _found_ends(self, unknown: FloatArray) -> FloatArray:
        """The ends of pieces from their guessed states."""
        of_plant = unknown[: unknown.size - self.num_sensed]
        times, moved = self.data.times[self.rows], MovedPieces(self.first_states)
        with np.errstate(all="ignore"):
            for k, controls in enumerate(self._controls):
                moved = self.driven.step(times[:, k], times[:, k + 1], moved, of_plant, controls)
        return moved.values


def _slopes(moved: MovedPieces) -> FloatArray:
    assert moved.slopes is not None
    return moved.slopes
