"""The parts of a disturbance that friction explains, and that a sticking contact may hide."""

from collections.abc import Callable, Sequence

import casadi as ca

_TINY = 1e-200
"""The denominator where nothing slides or presses; the quotient is then not used."""

_FLAT = 1e-9
"""Directions count as equal if the ratio of their smallest to largest square is below this."""

Metric = Callable[[ca.SX], ca.SX]
"""Disturbances d, as columns -> W d."""


def shares(
    forces: ca.SX, planes: Sequence[ca.SX], velocity: ca.SX, metric: Metric, d: ca.SX
) -> ca.SX:
    """Returns the part of d that each friction force c explains, as a factor, shape (c, 1):

        (c~^T W d) / (c~^T W c),

    where c~ is c without the part that a contact force orthogonal to the sliding explains as well.
    So a payload that pulls the tool across its motion is no friction, although M^-1 couples both.
    Forces and planes T, the reactions of each contact if it sticks, are columns; the velocity has
    shape (k, 1).
    """
    components = list[ca.SX]()
    for force, plane in zip(ca.horzsplit(forces), planes, strict=True):
        # T = J^T of the contact, or J^T J, and c = -J^T v_t / |v_t|: so this is J^T of what is
        # across v_t.
        power = ca.fmin(ca.mtimes(velocity.T, force), -_TINY)
        share = ca.mtimes(velocity.T, plane) / power
        moved, matched = metric(plane), metric(force)
        across, moved_across = plane - ca.mtimes(force, share), moved - ca.mtimes(matched, share)
        pairs = (across, moved_across), (plane, moved)
        sizes = [ca.mmax(ca.sum1(columns * others)) for columns, others in pairs]
        # Round-off where all of the plane is along c.
        is_plane = sizes[0] > _FLAT * sizes[1]
        for direction, unit in _basis(is_plane * across, is_plane * moved_across):
            matched -= unit * ca.dot(direction, matched)
        square = ca.fmax(ca.dot(matched, force), _TINY)
        components.append(ca.dot(matched, d) / square)
    return ca.vertcat(ca.SX(0, 1), *components)


def beside(planes: ca.SX, metric: Metric, d: ca.SX) -> ca.SX:
    """Returns the part of d that is orthogonal to all T y in the metric of accelerations."""
    for direction, unit in _basis(planes, metric(planes)):
        d -= ca.mtimes(direction, ca.mtimes(unit.T, d))
    return d


def _basis(planes: ca.SX, moved: ca.SX) -> list[tuple[ca.SX, ca.SX]]:
    """Directions e that span T, orthogonal in the metric W, each with W e / (e^T W e).

    By modified Gram-Schmidt; for one that depends on those before it, the second is zero.
    """
    squares = ca.sum1(planes * moved)
    least = _FLAT * ca.mmax(squares) if squares.numel() else 0
    basis: list[tuple[ca.SX, ca.SX]] = []
    pairs = [list(pair) for pair in zip(ca.horzsplit(planes), ca.horzsplit(moved), strict=True)]
    for i, (direction, image) in enumerate(pairs):
        square = ca.dot(direction, image)
        unit = ca.if_else(square > least, 1, 0) / ca.fmax(square, _TINY) * image
        basis.append((direction, unit))
        for pair in pairs[i + 1 :]:
            part = ca.dot(unit, pair[0])
            pair[:] = pair[0] - direction * part, pair[1] - image * part
    return basis
