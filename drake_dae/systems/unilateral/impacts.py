"""Complementarity: which contacts push, in an impact and after it; numbers alone.

Rows are constraints, one below the other; w = A y + b is what becomes of their rates, A being
positive semidefinite. In an impact y are impulses and b rates before it, after it y are forces and
b the accelerations without them. Kept rows have w = 0; each contact has

    y_n >= 0,    w_n >= 0,    y_n w_n = 0

for its normal n, and w = 0 in its other rows if it pushes, y = 0 if not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.layout import Indices

MOST = 8
"""So many contacts may touch at once: every set of them is tried."""

TIE = 1e-10
"""Sets of contacts whose violations differ by less, relative to what there is, fit alike."""

FITS = 1e-6
"""What a set may violate, relative to what there is."""

DEPENDENT = 1e-11
"""Rows are dependent, and no set, where the smallest eigenvalue of their equilibrated A is less."""


@dataclass(frozen=True, eq=False)
class Touch:
    """The rows of one contact.

    Attributes:
        normal: The row that must not be pierced, whose force can only push.
        rows: All rows of the contact.
    """

    normal: int
    rows: Indices


@dataclass(frozen=True, eq=False)
class Fit:
    """What fits.

    Attributes:
        pushing: Places of the contacts that push, among those given.
        values: y, one for each row.
    """

    pushing: tuple[int, ...]
    values: FloatArray


def complementary(
    matrix: FloatArray, offset: FloatArray, kept: Indices, touches: Sequence[Touch]
) -> Fit | None:
    """The y that fits, with as few contacts that push as do.

    Rows that depend on each other push in no set: of a table with four feet three carry it.

    Args:
        matrix: A, shape (m, m).
        offset: b, shape (m,).
        kept: The rows that nothing opens.
        touches: The contacts.

    Returns:
        What fits; None if nothing does.
    """
    length = np.sqrt(np.abs(np.diag(matrix)))
    used = [*kept, *(row for touch in touches for row in touch.rows)]
    size = max((abs(offset[i]) / length[i] for i in used if length[i] > 0.0), default=0.0)
    best, least = None, np.inf
    for count in range(len(touches) + 1):
        for pushing in combinations(range(len(touches)), count):
            rows = np.array([*kept, *(r for i in pushing for r in touches[i].rows)], dtype=int)
            values = solution(matrix, offset, rows)
            if values is None:
                continue
            rates = matrix @ values + offset
            normals = [touch.normal for touch in touches]
            amiss = [
                -values[n] * length[n] if i in pushing else -rates[n] / (length[n] or 1.0)
                for i, n in enumerate(normals)
            ]
            violation = max(amiss, default=0.0)
            if violation < least - TIE * size:
                best, least = Fit(pushing, values), max(violation, 0.0)
    return best if least <= FITS * size else None


def solution(matrix: FloatArray, offset: FloatArray, rows: Indices) -> FloatArray | None:
    """y with w = 0 in some rows, zero in the others, shape (m,); None if the rows are dependent."""
    values = np.zeros(offset.size)
    if rows.size:
        part = matrix[np.ix_(rows, rows)]
        length = np.sqrt(np.abs(np.diag(part)))
        if not np.all(length > 0.0):
            return None
        scaled = part / length / length[:, None]
        if np.linalg.svd(scaled, compute_uv=False)[-1] < DEPENDENT:
            return None
        values[rows] = np.linalg.solve(scaled, -offset[rows] / length) / length
    return values


def stopping(matrix: FloatArray, offset: FloatArray, rows: Indices) -> FloatArray:
    """The least impulses, shape (m,), that bring some rows to rest, dependent or not."""
    values = np.zeros(offset.size)
    part = matrix[np.ix_(rows, rows)]
    values[rows] = np.linalg.pinv(part, DEPENDENT, hermitian=True) @ -offset[rows]
    return values
