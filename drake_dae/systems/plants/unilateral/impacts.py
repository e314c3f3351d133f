"""Complementarity: the contacts with force or impulse, in an impact and after it.

Rows are constraints; w = A y + b are their rates or accelerations, with A positive semidefinite. In
an impact y are impulses and b the rates before it; after it y are forces and b the accelerations
without them. Bilateral rows have w = 0; each contact has

    y_n >= 0,    w_n >= 0,    y_n w_n = 0

for its normal n, and w = 0 in its other rows if y_n > 0, y = 0 otherwise. Without friction exactly
one w fits, and exactly one y where rows are independent.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.layout import Indices
from drake_dae.trace.functions import SINGULAR_PIVOT

MOST = 8
"""The largest number of touching contacts: every subset of them is tried."""

TIE = 1e-10
"""Subsets whose violations differ by less, relative to the sizes of the terms, fit equally well."""

FITS = 1e-6
"""The allowed violation of a subset, relative to the sizes of the terms."""

DEPENDENT = 1e-11
"""Rows are dependent if the smallest eigenvalue of their equilibrated A is below this."""


@dataclass(frozen=True, eq=False)
class TouchRows:
    """The rows of one contact.

    Attributes:
        normal: The row of its unilateral normal.
        rows: All rows of the contact.
    """

    normal: int
    rows: Indices


@dataclass(frozen=True, eq=False)
class ImpactSolution:
    """A solution of the complementarity problem.

    Attributes:
        pushing: Indices of the contacts with force, among those given.
        values: y, one for each row.
    """

    pushing: tuple[int, ...]
    values: FloatArray


def complementary(
    matrix: FloatArray, offset: FloatArray, bilateral: Indices, touches: Sequence[TouchRows]
) -> ImpactSolution | None:
    """The y that fits with the fewest acting contacts.

    Args:
        matrix: A, shape (m, m).
        offset: b, shape (m,).
        bilateral: The rows of bilateral constraints.
        touches: The contacts.

    Returns:
        The solution; None if there is none.
    """
    length = np.sqrt(np.abs(np.diag(matrix)))
    length[length == 0.0] = 1.0
    used = [*bilateral, *(row for touch in touches for row in touch.rows)]
    size = float(np.max(np.abs(offset / length)[used], initial=0.0))
    normals = [touch.normal for touch in touches]
    best, least = None, np.inf
    for count in range(len(touches) + 1):
        for pushing in combinations(range(len(touches)), count):
            rows = rows_of(matrix, bilateral, [touches[i] for i in pushing])
            if rows is None:
                continue
            values = np.zeros(offset.size)
            if rows.size:
                values[rows] = np.linalg.solve(matrix[np.ix_(rows, rows)], -offset[rows])
            rates = matrix @ values + offset
            amiss = [
                -values[n] * length[n] if i in pushing else -rates[n] / length[n]
                for i, n in enumerate(normals)
            ]
            violation = max(0.0, *amiss) if amiss else 0.0
            if violation < least - TIE * size:
                best, least = ImpactSolution(pushing, values), violation
    return best if least <= FITS * size else None


def rows_of(matrix: FloatArray, bilateral: Indices, pushing: Sequence[TouchRows]) -> Indices | None:
    """The rows that hold while some contacts act, bilateral ones first, then normals.

    Dependent normals are not allowed: of four feet of a table only three carry it. Other rows that
    depend on those before them, such as of two sticking feet, hold without a force.

    Args:
        matrix: A, shape (m, m).
        bilateral: The rows of bilateral constraints.
        pushing: The contacts.

    Returns:
        The rows; None if there is no such set.
    """
    first = [*bilateral, *(touch.normal for touch in pushing)]
    others = [row for touch in pushing for row in touch.rows if row != touch.normal]
    independent: list[int] = []
    for row in (*first, *others):
        trial = [*independent, row]
        part = matrix[np.ix_(trial, trial)]
        length = np.sqrt(np.abs(np.diag(part)))
        if length[-1] > 0.0:
            scaled = part / length / length[:, None]
            if np.linalg.svd(scaled, compute_uv=False)[-1] >= DEPENDENT:
                independent = trial
                continue
        if row in first:
            return None
    return np.array(independent, dtype=int)


def stopping(matrix: FloatArray, offset: FloatArray, rows: Indices) -> FloatArray:
    """The smallest impulses, shape (m,), that bring some rows to rest, dependent or not."""
    values = np.zeros(offset.size)
    part = matrix[np.ix_(rows, rows)]
    values[rows] = np.linalg.pinv(part, DEPENDENT, hermitian=True) @ -offset[rows]
    return values


def is_p_matrix(matrix: FloatArray, without: FloatArray, contacts: Sequence[int]) -> bool:
    """Whether all principal minors of A that hold all other rows are positive: one y fits any b.

    Args:
        matrix: A, shape (m, m).
        without: A without friction, positive semidefinite, shape (m, m).
        contacts: The rows of the contacts.
    """
    bilateral = [i for i in range(len(matrix)) if i not in contacts]
    for count in range(1, len(contacts) + 1):
        for chosen in combinations(contacts, count):
            part = np.ix_([*bilateral, *chosen], [*bilateral, *chosen])
            whole = np.linalg.det(without[part])
            # Minors of dependent normals are not decisive.
            if whole > DEPENDENT * np.prod(np.diag(without[part])) and not (
                np.linalg.det(matrix[part]) > SINGULAR_PIVOT * whole
            ):
                return False
    return True
