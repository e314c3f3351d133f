"""Where a camera stands so that a robot fills its picture over a whole run."""

from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray

FLAT = 0.35
"""A scene that is so flat, relative to its other extents, is looked at more from above."""

_TURNS = np.deg2rad([0, -30, 30, -60, 60, -90, 90, 120, 150, 180])
"""The angles about the vertical from which a scene may be looked at."""

_FROM, _FROM_ABOVE = np.array([-0.6, -0.85, 0.4]), np.array([-0.6, -0.85, 1.3])


@dataclass(frozen=True)
class ViewAngles:
    """The angles that a picture shows around the axis of its camera, as tangents.

    Attributes:
        side: To the left and to the right.
        up, down: Upward and downward.
    """

    side: float
    up: float
    down: float

    @classmethod
    def of(
        cls, angle: float, aspect: float, top: float = 0.0, margin: float = 0.06
    ) -> "ViewAngles":
        """The view of a picture.

        Args:
            angle: Its vertical angle, in rad.
            aspect: Its width relative to its height.
            top: The part of its height that is left free at the top.
            margin: The part of its height that is left free at each side besides.
        """
        half = float(np.tan(angle / 2.0))
        return cls(
            half * (aspect - 2 * margin),
            half * (1 - 2 * (top + margin)),
            half * (1 - 2 * margin),
        )


def direction_of(points: FloatArray, contacts: FloatArray, normals: FloatArray) -> FloatArray:
    """The direction from a scene to its camera, shape (3,).

    It is from behind, the side and a little above, turned about the vertical by the least of some
    angles from which no surface and nothing of the robot hides the contacts.

    Args:
        points: Points that enclose the scene, m, shape (k, 3).
        contacts: Where the robot is in contact, m, shape (j, 3).
        normals: The unit normal toward the free side at each of them, zero without one.
    """
    extents = np.ptp(points, axis=0)
    flat = extents[2] < FLAT * np.max(extents)
    size, way = float(np.linalg.norm(extents)), _FROM_ABOVE if flat else _FROM
    best, least = way / np.linalg.norm(way), np.inf
    for number, turn in enumerate(_TURNS):
        c, s = np.cos(turn), np.sin(turn)
        tried = np.array([c * way[0] - s * way[1], s * way[0] + c * way[1], way[2]])
        tried /= np.linalg.norm(tried)
        price = 0.03 * number
        for contact, normal in zip(contacts, normals, strict=True):
            ahead = (points - contact) @ tried
            aside = np.linalg.norm(points - contact - np.outer(ahead, tried), axis=1)
            hides = (ahead > 0.12 * size) & (aside < 0.06 * size)
            price += (bool(hides.any()) + 2.0 * bool(normal @ tried < -1e-6)) / len(contacts)
        if price < least:
            best, least = tried, price
    return best


def framed(
    points: FloatArray, direction: FloatArray, view: ViewAngles
) -> tuple[FloatArray, FloatArray]:
    """The nearest camera that shows all points: its eye, and a point that it looks at, m.

    With x to the right, y up and z toward the camera from some point, a point is in the picture
    of a camera at distance D, whose axis is moved aside by s, if |x - s_x| <= side (D - z) and
    -down (D - z) <= y - s_y <= up (D - z). The least D for which there is an s is the larger of
    those of both directions; where one leaves room, the points stand in its middle.

    Args:
        points: The points, m, shape (k, 3).
        direction: The unit vector from the points to the camera, not vertical, shape (3,).
        view: What the camera shows.
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
    aside = [
        (above * (high - distance) + below * (distance - low)) / 2.0
        for (high, low), (_, above, below) in zip(ends, sides, strict=True)
    ]
    at = middle + axes @ np.array([*aside, 0.0])
    return at + distance * direction, at
