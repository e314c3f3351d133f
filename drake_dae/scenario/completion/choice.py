"""The rows that complete a task: independent ones, and the best joints."""

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
    """The first of some rows that are independent of others, and of each other, at a posture."""
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
    """The positions of joints to hold beside a task.

    Args:
        postures: The robot.
        posture: The start.
        rows: The rows of the task.
        joints: The rows of positions.
        count: How many to choose.
        path: Values of the first rows of the task at some times, shape (k, r); the other rows
            hold what they start with.

    Returns:
        Those with the largest least `quality` along the path; of all sets that leave the robot
        regular at the start, the best ones there are followed. None if no set does.
    """

    def start_quality(chosen: Sequence[int]) -> float:
        return postures.quality(posture, [*rows, *chosen])

    def is_regular(chosen: Sequence[int]) -> bool:
        return posture.independence([*rows, *chosen]) > INDEPENDENT / 10

    if comb(len(joints), count) <= _SETS:
        sets = [one for one in combinations(joints, count) if is_regular(one)]
    else:
        one_by_one: list[int] = []
        for _ in range(count):
            left = [joint for joint in joints if joint not in one_by_one]
            one_by_one.append(max(left, key=lambda j: start_quality([*one_by_one, j])))
        sets = [one for one in [tuple(sorted(one_by_one))] if is_regular(one)]
    shortlist = sorted(sets, key=start_quality, reverse=True)[:_SHORTLIST]
    if len(shortlist) < 2:
        return shortlist[0] if shortlist else None
    # Of equal ones along the path the best at the start.
    return max(shortlist, key=lambda one: _least(postures, posture, [*rows, *one], path))


def _least(postures: Postures, posture: Posture, rows: Sequence[int], path: FloatArray) -> float:
    """The least quality along a path; 0 where it cannot be followed."""
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
