"""Impulses of several frictional contacts together, from numbers alone.

With u = W y + q, y the impulses and u the rates after the impact, each contact has its normal
first:

    y in K = {|y_t| <= mu y_n},    u + mu |u_t| n in K*,    y . (u + mu |u_t| n) = 0,

which is Coulomb's law (De Saxce and Feng, 1998). For given mu |u_t| that is a convex program, which
the method of multipliers solves, and the shift follows along (Acary, Cadoux, Lemarechal and Malick,
2011; Tasora, Mangoni, Benatti and Garziera, 2021). It only has to determine which contacts open,
stick and slide. Then Newton's method finds the impulses to round-off, and all conditions are
checked.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray

SWEEPS = 1000
"""The largest number of steps of the method of multipliers."""

LOOK = 20
"""The number of steps after which the present contact states (open, stick, slide) are tried."""

LARGEST = 1e8
"""Impulses above this, relative to the wanted ones, show that there is no solution."""

MARGINS = (1e-8, 1e-5, 1e-3, 1e-2)
"""The distances from the boundary of its cone at which an impulse counts as on it."""

NEWTON_STEPS = 12
"""The largest number of Newton steps for given contact states."""

ROUND_OFF = 1e-14
"""A Newton step below this, relative to the impulses, is the last."""

FITS = 1e-11
"""The allowed violation of the conditions, relative to the sizes of their terms."""

PENALTIES = 1e-4, 1e4
"""The range of the penalty of the method of multipliers."""

BALANCE = 10.0
"""The penalty is adapted if the residuals of impulses and rates differ by more than this factor."""


@dataclass(frozen=True, eq=False)
class Cone:
    """The cone of a contact.

    Attributes:
        rows: The rows of its impulses, the normal first.
        friction: mu, zero or more; infinite where it cannot slide.
    """

    rows: slice
    friction: float

    def nearest(self, values: FloatArray) -> FloatArray:
        """The projection of an impulse onto the cone."""
        normal, along, mu = values[0], values[1:], self.friction
        if np.isinf(mu):
            return np.concatenate([[max(normal, 0.0)], along])
        length = float(np.linalg.norm(along))
        if length <= mu * normal:
            return values
        if mu * length <= -normal:
            return np.zeros(values.size)
        push = (normal + mu * length) / (1.0 + mu**2)
        return np.concatenate([[push], mu * push / length * along if length else along])


def in_cones(matrix: FloatArray, offset: FloatArray, cones: Sequence[Cone]) -> FloatArray | None:
    """The impulses y, shape (k,); None if the search fails.

    Args:
        matrix: W, positive semidefinite, shape (k, k).
        offset: q, shape (k,).
        cones: The contacts, which together have all rows in order.
    """
    if not offset.any():
        return np.zeros(offset.size)
    # A common scale for all rows of a contact does not change its cone.
    unit = np.ones(offset.size)
    for cone in cones:
        unit[cone.rows] = 1.0 / np.sqrt(np.mean(np.diag(matrix)[cone.rows]))
    W, q = matrix * unit * unit[:, None], offset * unit
    size = float(np.abs(q).max())
    impulses = _searched(W, q / size, cones)
    return None if impulses is None else size * unit * impulses


def _searched(W: FloatArray, q: FloatArray, cones: Sequence[Cone]) -> FloatArray | None:
    """The impulses, by the method of multipliers: y = z, y of the program and z in the cones."""
    penalty, identity = 1.0, np.eye(q.size)
    inverse = np.linalg.inv(W + penalty * identity)
    z = multiplier = np.zeros(q.size)
    for step in range(SWEEPS):
        shifted = q.copy()
        for cone in cones:
            if np.isfinite(cone.friction):
                rates = W[cone.rows] @ z + q[cone.rows]
                shifted[cone.rows.start] += cone.friction * np.linalg.norm(rates[1:])
        y = inverse @ (penalty * z - multiplier - shifted)
        before, z = z, _nearest(cones, y + multiplier / penalty)
        multiplier = multiplier + penalty * (y - z)
        if step % LOOK:
            continue
        if not np.abs(z).max() < LARGEST:
            return None
        impulses = _polished(W, q, cones, z)
        if impulses is not None:
            return impulses
        apart, moved = np.linalg.norm(y - z), penalty * np.linalg.norm(z - before)
        if max(apart, moved) > BALANCE * min(apart, moved):
            penalty = float(np.clip(penalty * (2.0 if apart > moved else 0.5), *PENALTIES))
            inverse = np.linalg.inv(W + penalty * identity)
    return None


def _nearest(cones: Sequence[Cone], values: FloatArray) -> FloatArray:
    return np.concatenate([cone.nearest(values[cone.rows]) for cone in cones])


def _polished(
    W: FloatArray, q: FloatArray, cones: Sequence[Cone], start: FloatArray
) -> FloatArray | None:
    """The impulses for the contact states of an approximate solution; None if none fit."""
    tried: list[list[int]] = []
    largest = float(np.abs(start).max())
    for margin in MARGINS:
        ways = [_way(cone, start[cone.rows], margin * largest, margin) for cone in cones]
        kinds = [0 if way is None else 1 + int(way.any()) for way in ways]
        if kinds not in tried:
            tried.append(kinds)
            impulses = _solved(W, q, cones, start, ways)
            if impulses is not None:
                return impulses
    return None


def _solved(
    W: FloatArray,
    q: FloatArray,
    cones: Sequence[Cone],
    start: FloatArray,
    ways: list[FloatArray | None],
) -> FloatArray | None:
    """The impulses for given contact states, by Newton's method; None if they do not fit.

    A contact that sticks has u = 0; one that slides along d has y = y_n (1, -mu d), u_n = 0, and no
    u across d, which is an unknown too.

    Args:
        W, q, cones: As for `in_cones`.
        start: The start of Newton's method.
        ways: The contact states, see `_way`.
    """
    y = start.copy()
    for cone, way in zip(cones, ways, strict=True):
        if way is None:
            y[cone.rows] = 0.0
    for _ in range(NEWTON_STEPS):
        frames = [_frame(cone, way, y[cone.rows]) for cone, way in zip(cones, ways, strict=True)]
        makes, tests = (_diagonal(cones, each) for each in zip(*frames, strict=True))
        ends = np.cumsum([make.shape[1] for make, _ in frames])
        if not ends[-1]:
            break
        u, jacobian = W @ y + q, tests.T @ W @ makes
        for cone, way, end in zip(cones, ways, ends, strict=True):
            if way is not None and way.size == 2 and way.any():
                jacobian[end - 1, end - 1] -= way @ u[cone.rows][1:]
        change = np.linalg.lstsq(jacobian, -tests.T @ u)[0]
        if not np.isfinite(change).all():
            return None
        for i, (cone, part) in enumerate(zip(cones, np.split(change, ends[:-1]), strict=True)):
            way = ways[i]
            if way is None:
                continue
            if not way.any():
                y[cone.rows] += part
                continue
            if part.size == 2:
                angle = np.arctan2(way[1], way[0]) + part[1]
                way = ways[i] = np.array([np.cos(angle), np.sin(angle)])
            y[cone.rows] = (y[cone.rows.start] + part[0]) * _against(cone, way)
        if np.abs(change).max() <= ROUND_OFF * np.abs(y).max():
            break
    rates = W @ y + q
    fits = (
        _fits(cone, way, y[cone.rows], rates[cone.rows])
        for cone, way in zip(cones, ways, strict=True)
    )
    return y if all(fits) else None


def _diagonal(cones: Sequence[Cone], blocks: Sequence[FloatArray]) -> FloatArray:
    """Blocks of columns, each in the rows of its contact."""
    columns = np.zeros((cones[-1].rows.stop, sum(block.shape[1] for block in blocks)))
    first = 0
    for cone, block in zip(cones, blocks, strict=True):
        columns[cone.rows, first : first + block.shape[1]] = block
        first += block.shape[1]
    return columns


def _way(cone: Cone, impulse: FloatArray, least: float, margin: float) -> FloatArray | None:
    """The direction along which a contact slides; zero where it sticks, None where it opens."""
    push, along = impulse[0], impulse[1:]
    length = float(np.linalg.norm(along))
    if push <= least:
        return None
    if not length or length < (1.0 - margin) * cone.friction * push:
        return np.zeros(along.size)
    return -along / length


def _against(cone: Cone, way: FloatArray) -> FloatArray:
    """The impulse of a contact that slides along a direction, per unit of normal impulse."""
    return np.concatenate([[1.0], -cone.friction * way])


def _frame(
    cone: Cone, way: FloatArray | None, impulse: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """A contact's impulse by its unknowns, and its rates that are zero, as columns."""
    identity = np.eye(impulse.size)
    if way is None:
        return identity[:, :0], identity[:, :0]
    if not way.any():
        return identity, identity
    push = _against(cone, way)
    if way.size == 1:
        return push[:, None], identity[:, :1]
    across = np.array([0.0, -way[1], way[0]])
    turn = -cone.friction * impulse[0] * across
    return np.column_stack([push, turn]), np.column_stack([identity[0], across])


def _fits(cone: Cone, way: FloatArray | None, impulse: FloatArray, rates: FloatArray) -> bool:
    """Whether a contact satisfies the conditions of its state."""
    if way is None:
        return bool(rates[0] >= -FITS)
    if impulse[0] < 0.0:
        return False
    if not way.any():
        most = cone.friction * impulse[0] if way.size else 0.0
        return bool(np.linalg.norm(impulse[1:]) <= most and np.abs(rates).max() <= FITS)
    onward = float(way @ rates[1:])
    aside = float(np.linalg.norm(rates[1:] - onward * way))
    return max(abs(rates[0]), aside, -onward) <= FITS
