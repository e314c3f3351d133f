"""A reference along a curve with a given motion."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae.references.pieces import Pieces, PiecewiseReference
from drake_dae.dae.system.layout import Layout
from drake_dae.dae.timing.curve import Piece
from drake_dae.errors import ReferenceSignalError

# A quintic on [0, 1] with given values and first and second derivatives at both ends: the factors
# of 1, x, ..., x^5 from (p0, v0, a0, p1, v1, a1).
_QUINTIC = np.array(
    [
        [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.5, 0.0, 0.0, 0.0],
        [-10.0, -6.0, -1.5, 10.0, -4.0, 0.5],
        [15.0, 8.0, 1.5, -15.0, 7.0, -1.0],
        [-6.0, -3.0, -0.5, 6.0, -3.0, 0.5],
    ]
)


@checked(ReferenceSignalError)
@dataclass(frozen=True, eq=False)
class TimedReference(PiecewiseReference):
    """r(s(t)) of all outputs: quintic polynomials between the points of a curve.

    At both ends of each interval r, r' and r'' are those of the curve, with

        r' = r_s s',   r'' = r_ss s'^2 + r_s s'',

    where s'' is constant in an interval; r'' may jump at its ends. Forces, of degree 0, are
    straight lines between the points. Before and after, the values are constant.

    Attributes:
        table: The polynomials of r, one row for each output.
        degrees: The degrees mu of the outputs, 0 or 2.
        order: The number of derivatives.
    """

    table: Pieces
    degrees: tuple[int, ...]
    order: int = field(default=2, init=False)

    @classmethod
    def of(
        cls,
        parts: Sequence[tuple[Piece, FloatArray, FloatArray, FloatArray]],
        layout: Layout,
        start_time: float,
    ) -> "TimedReference":
        """The reference of motions along the pieces of a curve.

        Args:
            parts: Of each piece: it, the times of its points in s after its begin, b = s'^2 at
                these, a = s'' between them.
            layout: How R is stacked.
            start_time: When the first piece begins, in s.
        """
        breaks, factors = [np.array([start_time])], []
        for piece, times, b, a in parts:
            breaks.append(breaks[-1][-1] + times[1:])
            factors.append(_polynomials(piece, np.diff(times), b, a, layout))
        return cls(Pieces(np.concatenate(breaks), np.concatenate(factors)), layout.degrees)

    @property
    def size(self) -> int:
        return len(self.degrees)

    @property
    def duration(self) -> float:
        """The duration of the motion, in s."""
        return float(self.table.breaks[-1] - self.table.breaks[0])

    def pieces(self, degrees: Sequence[int]) -> Pieces:
        widths, rows = np.diff(self.table.breaks)[:, None], []
        for output, degree in enumerate(degrees):
            row = self.table.factors[:, output]
            powers = np.arange(row.shape[1])
            for k in range(degree + 1):
                rows.append(row / widths**k)
                row = np.pad((row * powers)[:, 1:], ((0, 0), (0, 1)))
        return Pieces(self.table.breaks, np.stack(rows, axis=1))


def _polynomials(
    piece: Piece, widths: FloatArray, b: FloatArray, a: FloatArray, layout: Layout
) -> FloatArray:
    """The factors of (1, x, ..., x^5) in each interval, shape (N, outputs, 6)."""
    count, low = widths.size, layout.lowest
    found = np.zeros((count, len(layout.degrees), 6))
    values = piece.values[:, low]
    found[:, :, 0] = values[:-1]
    found[:, :, 1] = np.diff(values, axis=0)
    if piece.is_pause:
        return found
    speed = np.sqrt(b)
    width = widths[:, None]
    rates = piece.tangents * speed[:, None]
    bent = piece.curvatures * b[:, None]
    moving = layout.dynamic
    given = np.stack(
        [
            values[:-1, moving],
            rates[:-1] * width,
            (bent[:-1] + piece.tangents[:-1] * a[:, None]) * width**2,
            values[1:, moving],
            rates[1:] * width,
            (bent[1:] + piece.tangents[1:] * a[:, None]) * width**2,
        ],
        axis=-1,
    )
    found[:, moving] = given @ _QUINTIC.T
    return found
