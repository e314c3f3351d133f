"""The grid below a robot, which shows the horizontal plane and the scale."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.scene.surroundings import DrawnSurface

_CELLS = 8.0
"""The approximate number of cells in the width of a scene."""

_NEAR = 0.1
"""The grid is on a horizontal surface if its height differs from the scene's lowest point by less
than this fraction of the scene's size."""


@dataclass(frozen=True)
class Floor:
    """A horizontal grid of square cells.

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
        """The begins and the ends of all lines, m, shape (k, 3) each."""
        (low_x, high_x), (low_y, high_y) = zip(self.low, self.high, strict=True)
        xs = np.linspace(low_x, high_x, round((high_x - low_x) / self.cell) + 1)
        ys = np.linspace(low_y, high_y, round((high_y - low_y) / self.cell) + 1)
        begins = [*((x, low_y, self.height) for x in xs), *((low_x, y, self.height) for y in ys)]
        ends = [*((x, high_y, self.height) for x in xs), *((high_x, y, self.height) for y in ys)]
        return np.array(begins), np.array(ends)


def floor_below(points: FloatArray, surfaces: Sequence[DrawnSurface] = ()) -> Floor:
    """Returns the floor of a scene: slightly below its points, or on a horizontal surface nearby.

    Args:
        points: Points that enclose the scene, m, shape (k, 3).
        surfaces: The drawn surfaces.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(float(np.linalg.norm(high - low)), 1e-3)
    cell = _round_length(size / _CELLS)
    height = float(low[2]) - 0.003 * size
    for surface in surfaces:
        level = surface.level
        if level is not None and abs(level - low[2]) < _NEAR * size:
            height = level + 0.003 * size
    first, last = np.floor(low[:2] / cell) - 1, np.ceil(high[:2] / cell) + 1
    corners = [tuple((cell * corner).tolist()) for corner in (first, last)]
    return Floor(height, cell, *corners)


def _round_length(length: float) -> float:
    """Returns the largest length of 1, 2 or 5 times a power of ten that is at most `length`."""
    power = 10.0 ** np.floor(np.log10(length) + 1e-9)
    return float(power * max(step for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)))
