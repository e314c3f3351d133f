"""Where the labels of arrows stand: not on tools, arrows, or other labels."""

from collections.abc import Sequence

import numpy as np

from drake_dae.arrays import FloatArray

_TURNS = np.pi / 6 * np.array([0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6])
"""The directions in which a label is tried, from that of the arrow's tail on."""

_RINGS, _RING = 8, 18.0
"""The distances in which it is tried, in pixels."""

_GAP = 4.0
"""Pixels between an arrow and its label."""


def to_be_seen(arrows: Sequence[FloatArray]) -> FloatArray:
    """The pixels that no label may cover: where arrows end, with the tools, and the arrows.

    Args:
        arrows: The head and the tail of each, in pixels, shape (2, 2).

    Returns:
        Pixels, shape (k, 2).
    """
    shares = np.linspace(0.0, 0.75, 4)[:, None]
    found = [head + shares * (tail - head) for head, tail in arrows]
    return np.vstack([np.zeros((0, 2)), *found])


def label_box(
    size: FloatArray,
    head: FloatArray,
    tail: FloatArray,
    taken: Sequence[FloatArray],
    kept: FloatArray,
    within: tuple[float, float, float, float],
) -> FloatArray:
    """The box of an arrow's label, in pixels: left, top, width, height.

    Of 96 places around the tail, the first that covers nothing, or else the one that covers least.
    The page of an animation does the same, where the camera moves: see overlay.html.

    Args:
        size: The width and height of the label.
        head, tail: The ends of the arrow.
        taken: The boxes of other labels.
        kept: The pixels that no label may cover, shape (k, 2).
        within: The left, top, right and lower end of the picture.
    """
    way = tail - head
    angle = float(np.arctan2(way[1], way[0])) if way.any() else np.pi / 2
    low, high = np.array(within[:2]), np.array(within[2:]) - size
    best, least = np.zeros(4), np.inf
    for ring in range(_RINGS):
        for turn in angle + _TURNS:
            far = size / 2 + _GAP + _RING * ring
            place = np.clip(tail + far * [np.cos(turn), np.sin(turn)] - size / 2, low, high)
            box = np.concatenate([place, size])
            covered = (kept > place - 6).all(axis=1) & (kept < place + size + 6).all(axis=1)
            price = 10 * sum(overlap(box, other) for other in taken) + int(covered.sum())
            if price < least:
                best, least = box, price
            if not least:
                return best
    return best


def overlap(first: FloatArray, second: FloatArray) -> bool:
    """Whether two boxes (left, top, width, height) overlap."""
    return bool(
        (first[:2] < second[:2] + second[2:]).all() and (second[:2] < first[:2] + first[2:]).all()
    )
