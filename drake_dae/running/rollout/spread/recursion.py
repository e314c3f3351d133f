"""The covariance of a sampled linear loop, from period to period."""

import numpy as np

from drake_dae.arrays import Booleans, FloatArray

Step = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""A, B, C and D of a period: z+ = A z + B n and y = C z + D n with noise n of deviation 1."""


def of_signals(step: Step, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The variances of signals and of their changes to the next period, for those of the states."""
    a, b, c, d = step
    changed, drawn = c @ a - c, c @ b - d
    whole, change = (
        np.sum((row @ spread) * row, axis=1) + rest
        for row, rest in (
            (c, np.sum(d**2, axis=1)),
            (changed, np.sum(drawn**2, axis=1) + np.sum(d**2, axis=1)),
        )
    )
    return whole, change


def reached(a: FloatArray, b: FloatArray) -> Booleans:
    """The states that noise reaches by z+ = A z + B n."""
    found: Booleans = np.any(b != 0.0, axis=1)
    while True:
        more = found | np.any(a[:, found] != 0.0, axis=1)
        if (more == found).all():
            return found
        found = more


def passed(first: Step, last: Step, count: int, spread: FloatArray) -> FloatArray:
    """P after some periods, the first half of which are like one and the others like another."""
    for (a, b, _, _), some in ((first, count // 2), (last, count - count // 2)):
        spread = after(a, b @ b.T, some, spread)
    return spread


def after(a: FloatArray, noise: FloatArray, count: int, spread: FloatArray) -> FloatArray:
    """P after a number of times P = A P A^T + Q, by doubling."""
    part, step = noise, a  # Q and A of 2^j times.
    while count:
        if count & 1:
            spread = step @ spread @ step.T + part
        part, step, count = part + step @ part @ step.T, step @ step, count >> 1
    return spread
