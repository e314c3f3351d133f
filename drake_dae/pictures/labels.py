"""The positions of the labels of arrows: beside tools, arrows and other labels, not on them."""

from collections.abc import Sequence

import numpy as np

from drake_dae.arrays import FloatArray

_TURNS = np.pi / 6 * np.array([0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6])
"""The tried directions of a label from the arrow's tail, relative to the arrow's direction."""

_RINGS, _RING = 8, 18.0
"""The number of tried distances, and their spacing in pixels."""

_GAP = 4.0
"""Pixels between an arrow and its label."""


def reserved_pixels(arrows: Sequence[FloatArray]) -> FloatArray:
    """Returns pixels that labels should not cover: points on arrows, and their tips at the tools.

    Args:
        arrows: The head and the tail of each arrow, in pixels, shape (2, 2).

    Returns:
        Pixels, shape (k, 2).
    """
    fractions = np.linspace(0.0, 0.75, 4)[:, None]
    points = [head + fractions * (tail - head) for head, tail in arrows]
    return np.vstack([np.zeros((0, 2)), *points])


def label_box(
    size: FloatArray,
    head: FloatArray,
    tail: FloatArray,
    others: Sequence[FloatArray],
    reserved: FloatArray,
    within: tuple[float, float, float, float],
) -> FloatArray:
    """Returns the box of an arrow's label, in pixels: left, top, width, height.

    Of 96 positions around the tail it is the first that covers nothing, or else the one that covers
    least. overlay.html does the same for animations, in which the user moves the camera.

    Args:
        size: The width and height of the label.
        head, tail: The ends of the arrow.
        others: The boxes of other labels.
        reserved: The pixels that labels should not cover, shape (k, 2).
        within: The left, top, right and lower end of the picture.
    """
    arrow = tail - head
    angle = float(np.arctan2(arrow[1], arrow[0])) if arrow.any() else np.pi / 2
    low, high = np.array(within[:2]), np.array(within[2:]) - size
    best, least = np.zeros(4), np.inf
    for ring in range(_RINGS):
        for turn in angle + _TURNS:
            distance = size / 2 + _GAP + _RING * ring
            middle = tail + distance * [np.cos(turn), np.sin(turn)]
            corner = np.clip(middle - size / 2, low, high)
            box = np.concatenate([corner, size])
            is_covered = (reserved > corner - 6) & (reserved < corner + size + 6)
            overlaps = sum(overlap(box, other) for other in others)
            cost = 10 * overlaps + int(is_covered.all(axis=1).sum())
            if cost < least:
                best, least = box, cost
            if not least:
                return best
    return best


def overlap(first: FloatArray, second: FloatArray) -> bool:
    """Whether two boxes (left, top, width, height) overlap."""
    return bool(
        (first[:2] < second[:2] + second[2:]).all() and (second[:2] < first[:2] + first[2:]).all()
    )
