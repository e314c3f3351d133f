"""Impacts of frictional contacts: Newton's law along normals, Coulomb's along surfaces.

With c the rates, A = J M^-1 J^T over all rows, and Lambda the impulses, c+ = c- + A Lambda;
bilateral rows have c+ = 0, and each contact with its normal n and its rows t along the surface

    0 <= Lambda_n,    0 <= c+_n + e c-_n,    Lambda_n (...) = 0,
    c+_t = 0 and |Lambda_t| <= mu Lambda_n,    or    Lambda_t = -mu Lambda_n c+_t / |c+_t|

(Moreau 1988, Glocker 2001, with no restitution along the surface). With bounces it can gain energy
(Kane 1984), without it cannot: Lambda_n c+_n = 0 and Lambda_t . c+_t <= 0 leave

    T+ - T- = Lambda . c+ - Lambda . A Lambda / 2 <= 0.

So if energy would be gained, all coefficients of restitution are reduced by the factor at which
none is gained; and likewise if contacts wedge a body so that there are no such impulses. One
contact is solved in closed form, several by `in_cones`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.layout import Indices
from drake_dae.systems.plants.unilateral.cones import Cone, in_cones
from drake_dae.systems.plants.unilateral.impacts import DEPENDENT

NEAR, POLISHED = 1e-3, 5
"""The allowed deviation of the modulus of a zero from one before it is refined, and the number of
Newton steps for that."""

NOTHING = 1e-14
"""Values below this, relative to the largest, are round-off."""

FITS = 1e-11
"""The allowed violation of the conditions, relative to the sizes of their terms."""

HALVINGS = 40
"""The number of bisections of the factor of restitution: to 1e-12."""


@dataclass(frozen=True, eq=False)
class FrictionalContact:
    """The rows of one frictional contact.

    Attributes:
        normal: The row of its normal.
        along: The rows along the surface, in any unit axes; they may be dependent.
        friction: mu, zero or more.
        restitution: e, 0 to 1.
    """

    normal: int
    along: Indices
    friction: float
    restitution: float


def impact(
    matrix: FloatArray,
    before: FloatArray,
    bilateral: Indices,
    contacts: Sequence[FrictionalContact],
) -> FloatArray | None:
    """The impulses Lambda of frictional contacts, shape (k,).

    Args:
        matrix: A over all rows, positive semidefinite, shape (k, k).
        before: c-, shape (k,).
        bilateral: The bilateral rows.
        contacts: The contacts that touch.

    Returns:
        The impulses; None if none are found.
    """
    impulses = _impulses(matrix, before, bilateral, contacts)
    if impulses is not None and _gained(matrix, before, impulses) <= 0.0:
        return impulses
    least, most = 0.0, 1.0
    best = _impulses(matrix, before, bilateral, _bouncing(contacts, 0.0))
    for _ in range(HALVINGS if best is not None else 0):
        middle = 0.5 * (least + most)
        tried = _impulses(matrix, before, bilateral, _bouncing(contacts, middle))
        if tried is not None and _gained(matrix, before, tried) <= 0.0:
            least, best = middle, tried
        else:
            most = middle
    return best


def _bouncing(contacts: Sequence[FrictionalContact], factor: float) -> list[FrictionalContact]:
    return [replace(contact, restitution=factor * contact.restitution) for contact in contacts]


def _gained(matrix: FloatArray, before: FloatArray, impulses: FloatArray) -> float:
    """The gain of kinetic energy, minus round-off."""
    twice = impulses @ (2.0 * before + matrix @ impulses)
    size = np.abs(impulses) @ np.abs(before)
    return float(0.5 * twice - 1e-14 * size)


def _impulses(
    matrix: FloatArray,
    before: FloatArray,
    bilateral: Indices,
    contacts: Sequence[FrictionalContact],
) -> FloatArray | None:
    # The impulses of bilateral rows follow from c_k = 0.
    inverse = np.linalg.pinv(matrix[np.ix_(bilateral, bilateral)], DEPENDENT, hermitian=True)
    A = matrix - matrix[:, bilateral] @ inverse @ matrix[bilateral]
    b = before - matrix[:, bilateral] @ inverse @ before[bilateral]
    target = b.copy()
    blocks = []
    for contact in contacts:
        target[contact.normal] += contact.restitution * before[contact.normal]
        blocks.append(_axes(A, contact))
    make = np.hstack(blocks)
    W, q = make.T @ A @ make, make.T @ target
    ends = np.cumsum([axes.shape[1] for axes in blocks]).tolist()
    cones = [
        Cone(slice(end - axes.shape[1], end), contact.friction)
        for axes, end, contact in zip(blocks, ends, contacts, strict=True)
    ]
    solution = in_cones(W, q, cones) if len(cones) > 1 else _of_one(W, q, cones[0].friction)
    if solution is None:
        return None
    total = make @ solution
    total[bilateral] = -inverse @ (before[bilateral] + matrix[bilateral] @ total)
    return total


def _axes(matrix: FloatArray, contact: FrictionalContact) -> FloatArray:
    """The normal and the sliding directions, as columns."""
    rows = contact.along if contact.friction else contact.along[:0]
    values, vectors = np.linalg.eigh(matrix[np.ix_(rows, rows)])
    moved = vectors[:, values > DEPENDENT * max(values.max(initial=0.0), 0.0)]
    axes = np.zeros((matrix.shape[0], 1 + moved.shape[1]))
    axes[contact.normal, 0] = 1.0
    axes[rows, 1:] = moved
    return axes


def _of_one(matrix: FloatArray, target: FloatArray, friction: float) -> FloatArray | None:
    """The impulses of one contact, its normal first: it opens, sticks or slides."""
    if target[0] >= 0.0:
        return np.zeros(target.size)
    if target.size == 1:
        return -target / matrix[0]
    sticking = _sticking(matrix, target)
    if sticking is not None and np.linalg.norm(sticking[1:]) <= friction * sticking[0]:
        return sticking
    if np.isinf(friction):
        return None
    # If there is no impulse, values are not finite and do not fit.
    with np.errstate(invalid="ignore"):
        ways = np.array([[1.0, -1.0]]) if target.size == 2 else _ways(matrix, target, friction)
        impulses, after = _slid(matrix, target, friction, ways)
        onward = np.sum(after * ways, axis=0)
    fits = (impulses[0] > 0.0) & np.isfinite(impulses[0]) & (onward >= 0.0)
    if not fits.any():
        return None
    # If several fit, the one with the smallest change of direction.
    fitting = np.flatnonzero(fits)
    best = int(np.argmax(target[1:] @ after[:, fitting]))
    return np.asarray(impulses[:, fitting[best]])


def _sticking(matrix: FloatArray, target: FloatArray) -> FloatArray | None:
    """Impulses with w = 0 in the cone, those with the least friction; None if there are none.

    If the robot has fewer degrees of freedom than the contact has rows, they are dependent.
    """
    values, vectors = np.linalg.eigh(matrix)
    is_moved = values > NOTHING * values[-1]
    moved, idle = vectors[:, is_moved], vectors[:, ~is_moved]
    if not idle.size:
        impulses = np.linalg.solve(matrix, -target)
    else:
        impulses = -moved @ ((moved.T @ target) / values[is_moved])
        if np.abs(idle.T @ target).max() > FITS * np.abs(target).max():
            return None
        impulses += idle @ np.linalg.lstsq(idle[1:], -impulses[1:])[0]
    return np.asarray(impulses) if impulses[0] > 0.0 else None


def _slid(
    matrix: FloatArray, target: FloatArray, friction: float, ways: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Impulses with friction opposite to given directions, and their tangential c+; columns."""
    push = np.vstack([np.ones((1, ways.shape[1])), -friction * ways])
    mobility = matrix[0] @ push
    impulses = push * np.divide(
        -target[0], mobility, out=np.full(mobility.shape, np.inf), where=mobility > 0.0
    )
    return impulses, target[1:, None] + matrix[1:] @ impulses


def _ways(matrix: FloatArray, target: FloatArray, friction: float) -> FloatArray:
    """The directions in a plane for which the contact slides along them after the impact.

    The component of c+ across the direction of angle a, times the mobility, is a trigonometric
    polynomial of degree two in a: sum c_k z^k, |k| <= 2, z = exp(i a), whose zeros have |z| = 1.
    """
    angles = 2.0 * np.pi * np.arange(5) / 5.0
    ways = np.array([np.cos(angles), np.sin(angles)])
    push = np.vstack([np.ones(5), -friction * ways])
    after = target[1:, None] * (matrix[0] @ push) - target[0] * (matrix[1:] @ push)
    factors = np.fft.fft(ways[0] * after[1] - ways[1] * after[0])[[2, 1, 0, 4, 3]] / 5.0
    size = np.abs(factors).sum()
    factors[np.abs(factors) < NOTHING * size] = 0.0
    roots = np.roots(factors)
    angle = np.angle(roots[np.abs(np.abs(roots) - 1.0) < NEAR])
    orders = 1j * np.arange(2, -3, -1)
    for _ in range(POLISHED):
        waves = np.exp(np.outer(angle, orders))
        slopes = (waves @ (orders * factors)).real
        steep = np.abs(slopes) > NOTHING * size
        angle[steep] -= (waves @ factors).real[steep] / slopes[steep]
    angle = angle[np.abs((np.exp(np.outer(angle, orders)) @ factors).real) < FITS * size]
    return np.array([np.cos(angle), np.sin(angle)])
