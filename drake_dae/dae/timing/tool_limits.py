"""The limits of paths, which bound the tool, as limits along the distance s."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.references.by_name import ReferenceRows
from drake_dae.dae.references.reference import Reference
from drake_dae.dae.references.travel import PathLimits
from drake_dae.dae.system.layout import DerivativeLayout
from drake_dae.dae.timing.curve import Piece

DIRECTIONS = 25
"""The planes in place of half a circle: the bound is up to 0.2 % below the limit."""


@dataclass(frozen=True, eq=False)
class ToolLimits:
    """The limits |r'| and |r''| of a path as linear bounds on (a, b).

    Attributes:
        largest: The largest b by the speed, shape (N + 1,).
        of_a, of_b: of_a a + of_b b <= 1 by the acceleration, shape (N + 1, k).
    """

    largest: FloatArray
    of_a: FloatArray
    of_b: FloatArray


def tool_limits(
    references: Sequence[Reference], piece: Piece, layout: DerivativeLayout
) -> list[ToolLimits]:
    """Returns the limits of all paths that have limits.

    |r''| <= A is a circle in the plane of the tangential and the normal part,

        r'' = (|r_s| a + t b) e + n b,   e = r_s / |r_s|,   t = e . r_ss,   n = |r_ss - t e|,

    with a polygon inside it.
    """
    every, first = list[ToolLimits](), 0
    columns = {int(place): column for column, place in enumerate(layout.dynamic)}
    for reference in references:
        rows = range(first, first + reference.size)
        first += reference.size
        limits = getattr(reference, "limits", None)
        chosen = [columns[row] for row in rows if row in columns]
        if isinstance(reference, ReferenceRows):
            limits = getattr(reference.reference, "limits", None)
        if not isinstance(limits, PathLimits) or not chosen:
            continue
        tangent, curvature = piece.tangents[:, chosen], piece.curvatures[:, chosen]
        size = np.linalg.norm(tangent, axis=1)
        unit = tangent / np.where(size > 0.0, size, 1.0)[:, None]
        along = np.sum(unit * curvature, axis=1)
        across = np.linalg.norm(curvature - along[:, None] * unit, axis=1)
        angles = np.linspace(0.0, np.pi, DIRECTIONS)
        shrunk = limits.acceleration * np.cos(angles[1] / 2.0)
        cosine, sine = np.cos(angles), np.sin(angles)
        with np.errstate(divide="ignore"):
            largest = np.where(size > 0.0, (limits.speed / size) ** 2, np.inf)
        of_b = (along[:, None] * cosine + across[:, None] * sine) / shrunk
        every.append(ToolLimits(largest, size[:, None] * cosine / shrunk, of_b))
    return every
