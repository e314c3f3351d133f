"""Search for a start: inverse kinematics with constraints, from many guesses."""

from collections.abc import Sequence

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.scenario.completion.postures import EXACT, Posture, Postures

TRIES = 60
"""The number of guesses; an arm of seven joints has about forty solutions among them."""

PATIENCE = 20
"""A search ends after this many guesses without a solution, since a failed guess takes long."""

_CLOSEST = 3
"""The number of guesses for the nearest posture of an unreachable target."""

_CONSTRAINT_WEIGHT = 100.0
"""The weight of constraints relative to outputs if not all equations can be satisfied."""


def near_posture(
    postures: Postures, rows: Sequence[int], wanted: FloatArray, guess: FloatArray
) -> Posture | None:
    """The posture near a guess with given values of some rows; None if none is within limits."""
    q = postures.solve(rows, wanted, guess)
    left = postures.left(rows, wanted, q)
    is_found = np.all(np.isfinite(left)) and np.max(np.abs(left), initial=0.0) < EXACT
    return postures.at(q) if is_found and postures.is_inside(q) else None


def best_posture(
    postures: Postures, rows: Sequence[int], wanted: FloatArray, guesses: Sequence[FloatArray]
) -> Posture | None:
    """The best posture with given values of some rows that Newton's method finds.

    Args:
        postures: The robot.
        rows: The rows.
        wanted: Their values, shape (len(rows),).
        guesses: The guesses.

    Returns:
        The posture with the largest `quality`; None if none is found from the first `PATIENCE`
        guesses.
    """
    reached: list[Posture] = []
    for count, guess in enumerate(guesses):
        if count == PATIENCE and not reached:
            break
        posture = near_posture(postures, rows, wanted, guess)
        reached += [posture] if posture is not None else []
    return max(reached, key=lambda posture: postures.quality(posture, rows), default=None)


def nearest_posture(
    postures: Postures, rows: Sequence[int], wanted: FloatArray, guesses: Sequence[FloatArray]
) -> Posture:
    """The posture within limits that is nearest to given values of rows, by least squares.

    The arguments are those of `best_posture`.
    """
    from scipy.optimize import least_squares  # Imported here, since few runs need it.

    chosen = list(rows)
    low = np.where(np.isfinite(postures.low), postures.low, -np.inf)
    high = np.maximum(postures.high, low + 1e-6)

    def residual(q: FloatArray) -> FloatArray:
        left = postures.left(rows, wanted, q)
        left[: left.size - len(chosen)] *= _CONSTRAINT_WEIGHT
        return np.nan_to_num(left, nan=1e6, posinf=1e6, neginf=-1e6)

    def gradient(q: FloatArray) -> FloatArray:
        posture = postures.at(q)
        return np.vstack([_CONSTRAINT_WEIGHT * posture.constraint_slopes, posture.slopes[chosen]])

    tried = sorted(guesses, key=lambda q: float(np.sum(residual(np.clip(q, low, high)) ** 2)))
    fits = [
        least_squares(residual, np.clip(q, low, high), gradient, (low, high), max_nfev=50)
        for q in tried[:_CLOSEST]
    ]
    return postures.at(min(fits, key=lambda fit: float(fit.cost)).x)
