"""The position of a camera whose picture shows a robot."""

import numpy as np

from drake_dae.arrays import FloatArray

_FLAT = 0.35  # The camera is higher if a scene's height is below this share of its largest extent.

_TURNS = np.deg2rad([0, -30, 30, -60, 60, -90, 90, 120, 150, 180])
"""The tried angles of the camera about the vertical, in order of preference, in rad."""

_FROM, _FROM_ABOVE = np.array([-0.6, -0.85, 0.4]), np.array([-0.6, -0.85, 1.3])
"""The preferred directions to the camera, of usual and of flat scenes."""

_MARGIN = 0.06  # the fraction of a picture's height that is free at each side


def view_angles(angle: float, aspect: float, top: float = 0.0) -> tuple[float, float, float]:
    """The tangents of a camera's angles to each side, up and down, with margins left free.

    `top` is the fraction of a picture's height that is also free at the top.
    """
    half = float(np.tan(angle / 2.0))
    return half * (aspect - 2 * _MARGIN), half * (1 - 2 * (top + _MARGIN)), half * (1 - 2 * _MARGIN)


def direction_of(points: FloatArray, contacts: FloatArray, normals: FloatArray) -> FloatArray:
    """The unit vector from a scene to its camera, turned until little hides the contacts.

    Normals point toward the free side at each contact, or are zero.
    """
    extents = np.ptp(points, axis=0)
    size = float(np.linalg.norm(extents))
    x, y, z = _FROM_ABOVE if extents[2] < _FLAT * np.max(extents) else _FROM
    best, least = np.zeros(3), np.inf
    for number, turn in enumerate(_TURNS):
        c, s = np.cos(turn), np.sin(turn)
        direction = np.array([c * x - s * y, s * x + c * y, z]) / np.linalg.norm([x, y, z])
        cost = 0.03 * number
        for contact, normal in zip(contacts, normals, strict=True):
            ahead = (points - contact) @ direction
            aside = np.linalg.norm(points - contact - np.outer(ahead, direction), axis=1)
            hides = np.any((ahead > 0.12 * size) & (aside < 0.06 * size))
            is_behind = normal @ direction < -1e-6 * np.linalg.norm(normal)
            cost += (bool(hides) + 2.0 * bool(is_behind)) / len(contacts)
        if cost < least:
            best, least = direction, cost
    return best


def framed(
    points: FloatArray, direction: FloatArray, view: tuple[float, float, float]
) -> tuple[FloatArray, FloatArray]:
    """The nearest camera that shows all points: its position, and a point on its axis, m."""
    # x points to the right, y up and z to the camera, at the distance D and the offset s from the z
    # axis. It shows a point if |x - s_x| <= side (D - z) and -down (D - z) <= y - s_y <= up (D -
    # z). Each condition has a least D for which an s exists; the larger one is used.
    side, up, down = view
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= np.linalg.norm(right)
    axes = np.column_stack([right, np.cross(direction, right), direction])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    x, y, z = ((points - middle) @ axes).T
    # D >= high - s / above and D >= low + s / below.
    sides = [
        (above, below, np.max(p / above + z), np.max(-p / below + z))
        for p, above, below in ((x, side, side), (y, up, down))
    ]
    distance = max(
        *((above * high + below * low) / (above + below) for above, below, high, low in sides),
        np.max(z) + 1e-3,
    )
    offset = [
        (above * (high - distance) + below * (distance - low)) / 2.0
        for above, below, high, low in sides
    ]
    at = middle + axes @ np.array([*offset, 0.0])
    return at + distance * direction, at
