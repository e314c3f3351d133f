"""The choice of rows that complete a task: independent rows, and positions of joints."""

from collections.abc import Sequence
from itertools import combinations
from math import comb

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.scenario.completion.postures import Posture, Postures

INDEPENDENT = 0.02
"""Rows with an `independence` below this are dependent or nearly so."""

_SETS = 500
"""The largest number of compared sets of joints; for more, joints are chosen one by one."""

_SHORTLIST = 6
"""The number of best sets at the start that are evaluated along the reference."""


def first_independent(
    posture: Posture,
    rows: Sequence[int],
    candidates: Sequence[int],
    room: int,
) -> list[int]:
    """The first candidates, at most `room`, that are independent of rows and of each other."""
    chosen: list[int] = []
    for candidate in candidates:
        if len(chosen) < room and posture.independence([*rows, *chosen, candidate]) > INDEPENDENT:
            chosen.append(candidate)
    return chosen


def best_joints(
    postures: Postures,
    posture: Posture,
    rows: Sequence[int],
    joints: Sequence[int],
    count: int,
    path: FloatArray,
) -> tuple[int, ...] | None:
    """Chooses the joints whose positions complete a task.

    Args:
        postures: The robot.
        posture: The start.
        rows: The rows of the task.
        joints: The rows of positions of joints.
        count: The number of joints to choose.
        path: Values of the first rows of the task at some times, shape (k, r); the other rows
            keep their initial values.

    Returns:
        The set of joints whose least `quality` along the path is largest, among the best sets at
        the start; None if B is singular there for all sets.
    """

    def start_quality(chosen: Sequence[int]) -> float:
        return postures.quality(posture, [*rows, *chosen])

    def is_regular(chosen: Sequence[int]) -> bool:
        return posture.independence([*rows, *chosen]) > INDEPENDENT / 10

    if comb(len(joints), count) <= _SETS:
        sets = list(combinations(joints, count))
    else:
        greedy: list[int] = []
        for _ in range(count):
            rest = [joint for joint in joints if joint not in greedy]
            greedy.append(max(rest, key=lambda j: start_quality([*greedy, j])))
        sets = [tuple(sorted(greedy))]
    shortlist = sorted(filter(is_regular, sets), key=start_quality, reverse=True)[:_SHORTLIST]
    if len(shortlist) < 2:
        return shortlist[0] if shortlist else None
    # Of sets that are equal along the path, the best one at the start.
    return max(shortlist, key=lambda chosen: _least(postures, posture, [*rows, *chosen], path))


def _least(postures: Postures, posture: Posture, rows: Sequence[int], path: FloatArray) -> float:
    """The least quality along a path; 0 if the path cannot be followed."""
    q, least = posture.q, postures.quality(posture, rows)
    for values in path:
        wanted = posture.rows[list(rows)]
        wanted[: values.size] = values
        q = postures.solve(rows, wanted, q)
        if not np.max(np.abs(postures.left(rows, wanted, q)), initial=0.0) < 1e-6:
            return 0.0
        least = min(least, postures.quality(postures.at(q), rows))
        if least == 0.0:
            break
    return least
