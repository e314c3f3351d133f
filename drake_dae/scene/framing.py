"""The position of a camera whose picture shows a robot over a whole run."""

from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray

FLAT = 0.35
"""The camera is higher if the height of a scene is below this fraction of its largest extent."""

_TURNS = np.deg2rad([0, -30, 30, -60, 60, -90, 90, 120, 150, 180])
"""The tried angles of the camera about the vertical, in order of preference, in rad."""

_FROM, _FROM_ABOVE = np.array([-0.6, -0.85, 0.4]), np.array([-0.6, -0.85, 1.3])
"""The preferred directions to the camera, of usual and of flat scenes."""


@dataclass(frozen=True)
class ViewAngles:
    """The angles of view around the optical axis of a camera, as tangents.

    Attributes:
        side: The angle to the left and to the right.
        up, down: The angles upward and downward.
    """

    side: float
    up: float
    down: float

    @classmethod
    def of(
        cls, angle: float, aspect: float, top: float = 0.0, margin: float = 0.06
    ) -> "ViewAngles":
        """Returns the angles of a picture without its margins.

        Args:
            angle: The vertical angle of view of the picture, in rad.
            aspect: Its width divided by its height.
            top: The fraction of its height that is free at the top.
            margin: The fraction of its height that is also free at each side.
        """
        half = float(np.tan(angle / 2.0))
        return cls(
            half * (aspect - 2 * margin),
            half * (1 - 2 * (top + margin)),
            half * (1 - 2 * margin),
        )


def direction_of(points: FloatArray, contacts: FloatArray, normals: FloatArray) -> FloatArray:
    """Returns the unit vector from a scene to its camera, shape (3,).

    The preferred direction is from behind, the side and slightly above. It is turned about the
    vertical if surfaces or links would hide the contacts.

    Args:
        points: Points that enclose the scene, m, shape (k, 3).
        contacts: The contact points, m, shape (j, 3).
        normals: The unit normal toward the free side at each contact point, shape (j, 3); zero if
            there is none.
    """
    extents = np.ptp(points, axis=0)
    is_flat = extents[2] < FLAT * np.max(extents)
    size, preferred = float(np.linalg.norm(extents)), _FROM_ABOVE if is_flat else _FROM
    x, y, z = preferred
    best, least = preferred / np.linalg.norm(preferred), np.inf
    for number, turn in enumerate(_TURNS):
        c, s = np.cos(turn), np.sin(turn)
        direction = np.array([c * x - s * y, s * x + c * y, z])
        direction /= np.linalg.norm(direction)
        cost = 0.03 * number
        for contact, normal in zip(contacts, normals, strict=True):
            ahead = (points - contact) @ direction
            aside = np.linalg.norm(points - contact - np.outer(ahead, direction), axis=1)
            hides = (ahead > 0.12 * size) & (aside < 0.06 * size)
            cost += (bool(hides.any()) + 2.0 * bool(normal @ direction < -1e-6)) / len(contacts)
        if cost < least:
            best, least = direction, cost
    return best


def framed(
    points: FloatArray, direction: FloatArray, view: ViewAngles
) -> tuple[FloatArray, FloatArray]:
    """Returns the nearest camera that shows all points: its position, and a point on its axis, m.

    Let x point to the right, y up and z to the camera, and let the camera have the distance D from
    the origin and the offset s from the z axis. It shows a point if |x - s_x| <= side (D - z) and
    -down (D - z) <= y - s_y <= up (D - z). Each of the two conditions has a least D for which an s
    exists; the larger one is used. In the other direction the points are centered.

    Args:
        points: The points, m, shape (k, 3).
        direction: The unit vector from the points to the camera, not vertical, shape (3,).
        view: The angles of view of the camera.
    """
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= np.linalg.norm(right)
    axes = np.column_stack([right, np.cross(direction, right), direction])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    x, y, z = ((points - middle) @ axes).T
    sides = [(x, view.side, view.side), (y, view.up, view.down)]
    ends = [
        (float(np.max(p / above + z)), float(np.max(-p / below + z))) for p, above, below in sides
    ]
    # D >= high - s / above and D >= low + s / below.
    distance = max(
        (above * high + below * low) / (above + below)
        for (high, low), (_, above, below) in zip(ends, sides, strict=True)
    )
    distance = max(distance, float(np.max(z)) + 1e-3)
    offset = [
        (above * (high - distance) + below * (distance - low)) / 2.0
        for (high, low), (_, above, below) in zip(ends, sides, strict=True)
    ]
    at = middle + axes @ np.array([*offset, 0.0])
    return at + distance * direction, at
