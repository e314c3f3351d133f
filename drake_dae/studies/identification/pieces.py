"""A record cut into short pieces, each from a state of its own: multiple shooting."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from drake_dae.arrays import FloatArray
from drake_dae.studies.identification.driven import Driven, Moved
from drake_dae.studies.identification.measured import Measured

DURATION, ROWS = 0.01, 10
"""A piece lasts so long in s, and has at least so many rows: in stiff contact a longer one loses
the contact where states and parameters are wrong."""

ACCURATE = 1e-7
"""Steps are halved until the end of a piece changes by less than this, relative to the state."""

SOME = 8
"""Steps are compared in so many pieces."""

MOST_PARTS, ENOUGH = 64, 8
"""A step between two rows is divided into at most so many, and what is not finite with the latter
is not with more."""


class Slopes(NamedTuple):
    """Pieces and their derivatives with respect to their first states and all unknowns.

    Attributes:
        errors: Measured minus computed columns, nan where nothing is measured, shape (j, k, c).
        of_errors: Their derivatives, shape (j, k, c, n + p).
        ends: The states at the ends, shape (j, n).
        of_ends: Their derivatives, shape (j, n, n + p).
        residuals: Constraints at the beginning, and their derivatives: (j, m), (j, m, n + p).
    """

    errors: FloatArray
    of_errors: FloatArray
    ends: FloatArray
    of_ends: FloatArray
    residuals: tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class Pieces:
    """A record in pieces.

    Attributes:
        driven: The plant.
        data: The record.
        biases: For each column the unknown that it has as bias, counted after those of the plant;
            -1 for none.
        num_biases: How many of these there are.
        parts: How many steps of a continuous plant are made between two rows.
    """

    driven: Driven
    data: Measured
    biases: np.ndarray
    num_biases: int
    parts: int = 1

    @cached_property
    def length(self) -> int:
        """The number of rows of a piece."""
        return max(ROWS, round(DURATION / float(np.median(np.diff(self.data.times)))))

    @cached_property
    def rows(self) -> np.ndarray:
        """The rows of each piece and the first one of the next, shape (j, k + 1).

        Behind the last row it is repeated.
        """
        count, k = self.data.times.size, self.length
        firsts = np.arange(0, count, k)
        return np.minimum(firsts[:, None] + np.arange(k + 1), count - 1)

    @cached_property
    def _is_own(self) -> np.ndarray:
        """Which entries of `rows` are rows of that piece alone."""
        k, count = self.length, self.data.times.size
        return np.arange(0, count, k)[:, None] + np.arange(k) < count

    @cached_property
    def first_states(self) -> FloatArray:
        """The guess of the states at the beginnings, shape (j, n)."""
        return self.data.states[self.rows[:, 0]]

    @cached_property
    def values(self) -> FloatArray:
        """The measured columns less known biases, shape (j, k, c); nan behind the last row."""
        known = np.array([channel.bias for channel in self.data.channels])
        found: FloatArray = (self.data.values - np.where(self.biases < 0, known, 0.0))[
            self.rows[:, :-1]
        ]
        found[~self._is_own] = np.nan
        return found

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
        """For each step between rows the controls as `Driven.step` takes them."""
        times, controls, rows = self.data.times, self.data.controls, self.rows
        if self.driven.period:
            count = round(float(times[1] - times[0]) / self.driven.period)
            return [count * [controls[rows[:, k]]] for k in range(self.length)]
        stages = 2 * self.parts + 1
        if self.driven.hold is not None:
            return [stages * [controls[rows[:, k]]] for k in range(self.length)]
        smooth = CubicSpline(times, controls)
        shares = np.linspace(0.0, 1.0, stages)
        begins, ends = times[rows[:, :-1]], times[rows[:, 1:]]
        return [
            [smooth(begins[:, k] + share * (ends[:, k] - begins[:, k])) for share in shares]
            for k in range(self.length)
        ]

    def slopes(
        self, states: FloatArray, unknown: FloatArray, known: Slopes | None = None
    ) -> Slopes:
        """All pieces from some states.

        Args:
            states: Where they begin, shape (j, n).
            unknown: The unknowns of the plant, then the biases, shape (p,).
            known: Pieces nearby, whose derivatives are taken; None for new ones.
        """
        driven, times = self.driven, self.data.times[self.rows]
        of_plant, biases = np.split(unknown, [unknown.size - self.num_biases])
        moved = driven.begun(states) if known is None else Moved(states)
        shown = list[Moved]()
        for k, controls in enumerate(self._controls):
            acting = self.data.acting[self.rows[:, k]]
            shown.append(driven.seen(times[:, k], moved, of_plant, acting))
            moved = driven.step(times[:, k], times[:, k + 1], moved, of_plant, controls)
        places, own = self._places, self._residuals
        errors = self.values - np.stack([each.values[:, places] for each in shown], axis=1)
        of_column = np.append(biases, 0.0)[self.biases]  # The last one is that of no bias.
        errors -= of_column
        residual = shown[0].values[:, own]
        if known is not None:
            _, of_errors, _, of_ends, (_, of_residual) = known
            return Slopes(errors, of_errors, moved.values, of_ends, (residual, of_residual))
        of_errors = -np.stack([_slopes(each)[:, places] for each in shown], axis=1)
        of_biases = -np.eye(self.num_biases + 1)[self.biases][:, : self.num_biases]
        return Slopes(
            errors,
            np.concatenate(
                [of_errors, np.broadcast_to(of_biases, (*errors.shape, self.num_biases))], axis=3
            ),
            moved.values,
            self._padded(_slopes(moved)),
            (residual, self._padded(_slopes(shown[0])[:, own])),
        )

    def _padded(self, slopes: FloatArray) -> FloatArray:
        """Derivatives with respect to biases as well, which are zero."""
        return np.concatenate([slopes, np.zeros((*slopes.shape[:2], self.num_biases))], axis=2)

    def first(self, count: int) -> "Pieces":
        """The first rows alone."""
        given = self.data
        data = replace(
            given,
            times=given.times[:count],
            acting=given.acting[:count],
            controls=given.controls[:count],
            states=given.states[:count],
            values=given.values[:count],
        )
        return replace(self, data=data)

    def fine_enough(self, unknown: FloatArray) -> "Pieces":
        """The same with steps so short that the ends of pieces are accurate."""
        if self.driven.period:
            return self
        few = np.unique(np.linspace(0, len(self.rows) - 1, SOME).astype(int))
        found, ends = self, self._some_ends(few, unknown)
        while found.parts < MOST_PARTS:
            finer = replace(self, parts=2 * found.parts)
            after = finer._some_ends(few, unknown)
            sizes = np.maximum(self.driven.scale, np.abs(after).max(axis=0))
            change = np.abs(after - ends) / sizes
            if np.isfinite(change).all() and change.max() < ACCURATE:
                return found
            found, ends = finer, after
            if found.parts >= ENOUGH and not np.isfinite(ends).all():
                break  # It is not the steps.
        return found

    def _some_ends(self, pieces: np.ndarray, unknown: FloatArray) -> FloatArray:
        """The ends of some pieces."""
        of_plant = unknown[: unknown.size - self.num_biases]
        times = self.data.times[self.rows][pieces]
        moved = Moved(self.first_states[pieces])
        for k, controls in enumerate(self._controls):
            own = [each[pieces] for each in controls]
            moved = self.driven.step(times[:, k], times[:, k + 1], moved, of_plant, own)
        return moved.values


def _slopes(moved: Moved) -> FloatArray:
    assert moved.slopes is not None
    return moved.slopes
