"""A motion that writes a text."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive
from drake_dae.dae.references.letters import HEIGHT, strokes
from drake_dae.dae.references.splines import (
    SplineReference,
    TimeSpline,
    along_edges,
    check_spline,
    settle_axes,
    spline_within,
)
from drake_dae.dae.references.travel import PathLimits
from drake_dae.errors import ReferenceSignalError


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class TextReference(SplineReference):
    """A text in capital letters of single strokes, from rest to rest, for two outputs.

    It moves as a `PolylineReference`, also straight from a stroke to the next one: the tool is not
    lifted. With `press` there is a third output, a force that is smaller between strokes.

    Attributes:
        text: The text: letters, digits, "-+.,!?" and spaces.
        origin: The left end of the baseline, shape (2,), in the outputs' unit.
        height: The height of the letters, in the outputs' unit.
        limits: The largest speed, acceleration and jerk of the two outputs.
        along: The direction of the text, shape (2,): the change of the outputs per unit of length.
        up: The upward direction of the letters, shape (2,).
        press: The force in strokes and between them, in N, shape (2,); None without force.
        corner: The distance from a corner at which the path is rounded, in the outputs' unit; None
            for height / 15.
        start_time: The start of the motion, in s.
        order: The number of continuous derivatives, from 2 to 12; at least mu of the outputs.

    Raises:
        ReferenceSignalError: A letter is not known, or a number is of no use.
    """

    text: str
    origin: ArrayLike
    height: float
    limits: PathLimits
    along: ArrayLike = (1.0, 0.0)
    up: ArrayLike = (0.0, 1.0)
    press: ArrayLike | None = None
    corner: float | None = None
    start_time: float = 0.0
    order: int = 4

    def __post_init__(self) -> None:
        settle_axes(self)
        positive("height", self.height, ReferenceSignalError)
        corners, _ = self._corners()
        length = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
        check_spline(self._rounding, self.order, float(length))

    @property
    def _rounding(self) -> float:
        return self.height / 15 if self.corner is None else self.corner

    def _corners(self) -> tuple[FloatArray, list[bool]]:
        """The ends of all edges, shape (n, 2), and whether each edge is part of a stroke."""
        parts = list(strokes(self.text))
        is_stroke = [drawn for part in parts for drawn in [*[True] * (len(part) - 1), False]]
        axes = np.array([self.along, self.up]) * self.height / HEIGHT
        return np.array(self.origin) + np.concatenate(parts) @ axes, is_stroke[:-1]

    @cached_property
    def spline(self) -> TimeSpline:
        corners, is_stroke = self._corners()
        points, edges = along_edges(corners, 2 * self._rounding / self.order)
        if self.press is not None:
            drawn, between = np.asarray(self.press)
            points = np.column_stack([points, np.where(is_stroke, drawn, between)[edges]])
        return spline_within(points, self.limits, self.start_time, self.order, among=2)
