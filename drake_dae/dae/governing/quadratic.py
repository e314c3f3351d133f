"""Small quadratic programs as expressions: a fixed number of steps, no branches."""

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.trace.factorization import PositiveDefiniteFactorization

INTERIOR_POINT_STEPS, UNKNOWNS_PER_STEP = 10, 5
"""The number of steps, and the number of unknowns for which one more is taken. Errors of about one
fall below 1e-6; with 14 unknowns below 1e-5."""

CLOSEST = 1e-13
"""The least distance from a bound."""

DONE = 1e-12
"""The mean of the products of slacks and multipliers below which x is not changed any more."""

BOUNDARY = 0.995
"""The largest step, relative to the distance to the nearest bound."""


def nearest_within(
    metric: ca.SX,
    goal: ca.SX,
    rows: ca.SX,
    sides: ca.DM,
    bounds: ca.SX,
    softness: ArrayLike,
) -> ca.SX:
    """Returns x close to g: min (x - g)^T H (x - g) / 2 with |x_i| <= 1 and S A x <= b + d z.

    The last bounds are soft: each gives way by d times its multiplier z. By Mehrotra's primal-dual
    interior-point method (Nocedal and Wright, Numerical Optimization, 2006, section 16.6) from
    x = 0. |x_i| <= 1 holds at each step.

    Args:
        metric: H, shape (n, n), symmetric positive definite, with entries of about one.
        goal: g, shape (n, 1).
        rows: A, shape (m, n), with rows of length about one.
        sides: S, shape (k, m): the row that each bound is for, with 1 for an upper bound and -1 for
            a lower one, so that both together cost little more than one.
        bounds: b, shape (k, 1).
        softness: d, positive, one or shape (k,).

    Returns:
        x, shape (n, 1).
    """
    size, count = goal.numel(), bounds.numel()
    state = {"x": size, "s": count, "u": size, "l": size, "z": count}
    shapes = {"H": (size, size), "g": (size, 1), "A": rows.shape, "b": (count, 1)}
    shapes |= {name: (length, 1) for name, length in state.items()}
    symbols = {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}
    given = ca.DM(np.broadcast_to(softness, count))
    after = _step(**symbols, S=sides, softness=given)
    step = ca.Function("step", list(symbols.values()), after, {"cse": True})
    iterate = [ca.SX.zeros(size), ca.fmax(bounds, 0.1), *(ca.SX.ones(size) for _ in range(2))]
    iterate.append(ca.SX.ones(count))
    for _ in range(INTERIOR_POINT_STEPS + size // UNKNOWNS_PER_STEP):
        iterate = list(step(metric, goal, rows, bounds, *iterate))
    return iterate[0]


def _step(
    H: ca.SX,
    g: ca.SX,
    A: ca.SX,
    b: ca.SX,
    x: ca.SX,
    s: ca.SX,
    u: ca.SX,
    l: ca.SX,  # noqa: E741 - lower
    z: ca.SX,
    S: ca.DM,
    softness: ca.DM,
) -> list[ca.SX]:
    """x, the slacks s of soft bounds, and the multipliers of x <= 1, x >= -1 and S A x <= b."""
    count = 2 * x.numel() + s.numel()
    above, below = ca.fmax(1.0 - x, CLOSEST), ca.fmax(1.0 + x, CLOSEST)
    dual = ca.mtimes(H, x - g) + u - l + ca.mtimes(A.T, ca.mtimes(S.T, z))
    primal = ca.mtimes(S, ca.mtimes(A, x)) + s - b - softness * z
    weights, to_upper, to_lower = z / (s + softness * z), u / above, l / below
    matrix = H + ca.diag(to_upper + to_lower)
    for row, weight in zip(ca.vertsplit(A), ca.vertsplit(ca.mtimes(S.T**2, weights)), strict=True):
        matrix += ca.mtimes(row.T, weight * row)
    factors = PositiveDefiniteFactorization(matrix)

    def direction(ps: ca.SX, pu: ca.SX, pl: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
        """Newton's step by which these products of slacks and multipliers vanish."""
        excess, of_u, of_l = weights * (primal - ps / z), pu / above, pl / below
        dx = factors.solve(-dual + of_u - of_l - ca.mtimes(A.T, ca.mtimes(S.T, excess)))
        along = ca.mtimes(S, ca.mtimes(A, dx))
        dz = weights * along + excess
        ds = -primal - along + softness * dz
        return dx, ds, to_upper * dx - of_u, -to_lower * dx - of_l, dz

    values = ca.vertcat(s, above, below, z, u, l)

    def length(dx: ca.SX, ds: ca.SX, du: ca.SX, dl: ca.SX, dz: ca.SX) -> ca.SX:
        """The longest step up to 1 that keeps slacks and multipliers positive."""
        steepest = ca.mmax(-ca.vertcat(ds, -dx, dx, dz, du, dl) / values)
        return 1.0 / ca.fmax(steepest, 1.0)

    products = s * z, above * u, below * l
    mean = sum((ca.sum1(product) for product in products), ca.SX(0)) / count
    dx, ds, du, dl, dz = first = direction(*products)
    t = length(*first)
    reached = ca.dot(s + t * ds, z + t * dz) + ca.dot(above - t * dx, u + t * du)
    reached += ca.dot(below + t * dx, l + t * dl)
    center = mean * (reached / count / mean) ** 3
    corrected = (ds * dz, -dx * du, dx * dl)
    step = direction(*(p + c - center for p, c in zip(products, corrected, strict=True)))
    # At round-off products vanish; then nothing changes any more.
    t, goes_on = BOUNDARY * length(*step), mean > DONE
    return [
        value + ca.if_else(goes_on, t * change, 0.0)
        for value, change in zip((x, s, u, l, z), step, strict=True)
    ]
