"""The grid below a robot: it shows where down is, and how large things are."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.pictures.scene.surroundings import DrawnSurface

_CELLS = 8.0
"""About so many cells a scene is wide."""

_NEAR = 0.1
"""The grid is drawn on a level surface that is so near, relative to the size of the scene."""


@dataclass(frozen=True)
class Floor:
    """A level grid of square cells.

    Attributes:
        height: Its z, in m.
        cell: The side of a cell, in m: 1, 2 or 5 times a power of ten.
        low, high: Its corners along x and y, in m, multiples of the cell.
    """

    height: float
    cell: float
    low: tuple[float, float]
    high: tuple[float, float]

    @property
    def lines(self) -> tuple[FloatArray, FloatArray]:
        """The begin and the end of each line, m, shape (k, 3)."""
        (x, far_x), (y, far_y), z = *zip(self.low, self.high, strict=True), self.height
        along = np.linspace(x, far_x, round((far_x - x) / self.cell) + 1)
        across = np.linspace(y, far_y, round((far_y - y) / self.cell) + 1)
        ends = [((each, y, z), (each, far_y, z)) for each in along.tolist()]
        ends += [((x, each, z), (far_x, each, z)) for each in across.tolist()]
        begins, finishes = zip(*ends, strict=True)
        return np.array(begins), np.array(finishes)


def floor_below(points: FloatArray, touched: Sequence[DrawnSurface] = ()) -> Floor:
    """The floor of a scene: a little below its points, or on a level surface near these.

    Args:
        points: Points that enclose the scene, m, shape (k, 3).
        touched: The drawn surfaces.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(float(np.linalg.norm(high - low)), 1e-3)
    cell = _round_length(size / _CELLS)
    height = float(low[2]) - 0.003 * size
    for one in touched:
        level = one.level
        if level is not None and abs(level - low[2]) < _NEAR * size:
            height = level + 0.003 * size
    first, last = np.floor(low[:2] / cell) - 1, np.ceil(high[:2] / cell) + 1
    ends = [tuple((cell * end).tolist()) for end in (first, last)]
    return Floor(height, cell, *ends)


def _round_length(length: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is no longer."""
    power = 10.0 ** np.floor(np.log10(length) + 1e-9)
    return float(power * max(step for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)))
