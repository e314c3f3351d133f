"""Impacts of contacts that rub: Newton's law across surfaces, Coulomb's along them; numbers alone.

With c the rates, A = J M^-1 J^T over all rows, and Lambda the impulses, c+ = c- + A Lambda; kept
rows have c+ = 0, and each contact with its normal n and its rows t along the surface

    0 <= Lambda_n,    0 <= c+_n + e c-_n,    Lambda_n (...) = 0,
    c+_t = 0 and |Lambda_t| <= mu Lambda_n,    or    Lambda_t = -mu Lambda_n c+_t / |c+_t|

(Moreau 1988, Glocker 2001, with no restitution along the surface). With bounces it can gain energy
(Kane 1984), without it cannot: Lambda_n c+_n = 0 and Lambda_t . c+_t <= 0 leave

    T+ - T- = Lambda . c+ - Lambda . A Lambda / 2 <= 0.

So where energy would be gained all coefficients of restitution are less, by the factor at which
none is; and likewise where contacts wedge a body, so that no impulses bring what they want.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.layout import Indices
from drake_dae.systems.unilateral.cones import Cone, in_cones
from drake_dae.systems.unilateral.impacts import DEPENDENT

HALVINGS = 40
"""So often the factor of restitution is halved in between: to 1e-12."""


@dataclass(frozen=True, eq=False)
class Rubbing:
    """The rows of one contact that rubs.

    Attributes:
        normal: The row that must not be pierced.
        along: The rows along the surface, in any axes of length one; they may depend on each other.
        friction: mu, zero or more.
        restitution: e, 0 to 1.
    """

    normal: int
    along: Indices
    friction: float
    restitution: float


def impact(
    matrix: FloatArray, before: FloatArray, kept: Indices, contacts: Sequence[Rubbing]
) -> FloatArray | None:
    """The impulses Lambda of contacts that rub, shape (k,).

    Args:
        matrix: A over all rows, positive semidefinite, shape (k, k).
        before: c-, shape (k,).
        kept: The rows that nothing opens.
        contacts: The contacts that touch.

    Returns:
        The impulses; None if none are found.
    """
    found = _impulses(matrix, before, kept, contacts)
    if found is not None and _gained(matrix, before, found) <= 0.0:
        return found
    least, most = 0.0, 1.0
    best = _impulses(matrix, before, kept, _bouncing(contacts, 0.0))
    for _ in range(HALVINGS if best is not None else 0):
        middle = 0.5 * (least + most)
        tried = _impulses(matrix, before, kept, _bouncing(contacts, middle))
        if tried is not None and _gained(matrix, before, tried) <= 0.0:
            least, best = middle, tried
        else:
            most = middle
    return best


def _bouncing(contacts: Sequence[Rubbing], factor: float) -> list[Rubbing]:
    return [replace(one, restitution=factor * one.restitution) for one in contacts]


def _gained(matrix: FloatArray, before: FloatArray, impulses: FloatArray) -> float:
    """What the kinetic energy gains, less round-off."""
    twice = impulses @ (2.0 * before + matrix @ impulses)
    size = np.abs(impulses) @ np.abs(before)
    return float(0.5 * twice - 1e-14 * size)


def _impulses(
    matrix: FloatArray, before: FloatArray, kept: Indices, contacts: Sequence[Rubbing]
) -> FloatArray | None:
    # What is kept follows from the contacts: c_k = 0.
    inverse = np.linalg.pinv(matrix[np.ix_(kept, kept)], DEPENDENT, hermitian=True)
    A = matrix - matrix[:, kept] @ inverse @ matrix[kept]
    b = before - matrix[:, kept] @ inverse @ before[kept]
    wanted = b.copy()
    blocks = []
    for one in contacts:
        wanted[one.normal] += one.restitution * before[one.normal]
        blocks.append(_axes(A, one))
    make = np.hstack(blocks)
    ends = np.cumsum([axes.shape[1] for axes in blocks]).tolist()
    cones = [
        Cone(slice(end - axes.shape[1], end), one.friction)
        for axes, end, one in zip(blocks, ends, contacts, strict=True)
    ]
    found = in_cones(make.T @ A @ make, make.T @ wanted, cones)
    if found is None:
        return None
    total = make @ found
    total[kept] = -inverse @ (before[kept] + matrix[kept] @ total)
    return total


def _axes(matrix: FloatArray, one: Rubbing) -> FloatArray:
    """The normal, and those directions along the surface that it rubs along, as columns."""
    rows = one.along if one.friction else one.along[:0]
    values, vectors = np.linalg.eigh(matrix[np.ix_(rows, rows)])
    moved = vectors[:, values > DEPENDENT * max(values.max(initial=0.0), 0.0)]
    axes = np.zeros((matrix.shape[0], 1 + moved.shape[1]))
    axes[one.normal, 0] = 1.0
    axes[rows, 1:] = moved
    return axes
