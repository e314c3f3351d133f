"""Random systems whose normal form is known, since they were made from it."""

from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np

from drake_dae.dae import DaeSystem


class Hidden(NamedTuple):
    """A random system made from its normal form, and the degrees that it was made with."""

    system: DaeSystem
    constraint_degrees: tuple[int, ...]
    output_degrees: tuple[int, ...]
    zero_dynamics: int


def hidden_normal_form(seed: int) -> Hidden:
    """A system whose normal form (26) is drawn first and then hidden.

    In coordinates w the constraints and the outputs with mu_i > 0 are heads of chains of
    integrators, which v and u enter at the end:

        c^(r)  = A(w) (v - beta(w) u - a(w)),    z^(mu) = b(w) + D v + (B1 - D beta(w)) u,

    so that v = a + beta u and z^(mu) = ... + B1 u. An output of degree 0 is l(w) + m v with the
    rows m beta of B. An output of degree mu > 0 may also be a constraint input v_j: then the row
    beta_j is zero and a_j is the head of its chain. A constraint may have others of at least its
    degree added. Other coordinates are moved by everything. Then a regular feedback u -> gamma(x) +
    sigma u, a change of basis of v, a polynomial diffeomorphism x = T(w), which is triangular and
    so inverted exactly, and a rotation hide all that. None changes a degree.
    """
    random = np.random.default_rng(seed)
    while True:
        m, p = int(random.integers(0, 4)), int(random.integers(1, 5))
        r = tuple(int(i) for i in random.integers(1, 4, m))
        # Of m constraint inputs at most m are outputs: m beta has as many rows as are met at once,
        # and no column of a beta_j that is zero.
        met = int(random.integers(0, min(m, p) + 1))
        felt = int(random.integers(0, min(m, p) - met + 1))
        mu = [0] * met + [int(i) for i in random.integers(1, 4, p - met)]
        free = int(random.integers(0, 4))
        n = sum(r) + sum(mu) + free
        if 1 <= n <= 8 and m < n:
            break
    w = ca.SX.sym("w", n)

    def smooth(rows: int, columns: int = 1, size: float = 0.5) -> ca.SX:
        """Random quadratic polynomials of w."""
        basis = ca.vertcat(1, w, w**2, w[0] * w[-1])
        return ca.reshape(
            ca.mtimes(size * random.normal(size=(rows * columns, basis.numel())), basis),
            rows,
            columns,
        )

    while True:
        beta = random.normal(size=(m, p)) + smooth(m, p, 0.1)
        beta[m - felt :, :] = 0
        b1, rows = random.normal(size=(p - met, p)), random.normal(size=(met, m))
        nominal_beta = np.array(ca.Function("beta", [w], [ca.densify(beta)])(np.zeros(n)))
        b = np.vstack([rows @ nominal_beta.reshape(m, p), b1])
        if np.linalg.svd(b, compute_uv=False)[-1] > 0.3:
            break
    a = np.linalg.qr(random.normal(size=(m, m)))[0] + smooth(m, m, 0.1)
    by_force = random.normal(size=(p - met, m))

    starts = np.cumsum([0, *r, *mu[met:]])
    heads = [w[int(start)] for start in starts[:-1]]
    force_drift, output_drift = smooth(m), smooth(p - met)
    for j in range(felt):
        force_drift[m - felt + j] = heads[m + j]
    f, g, h = ca.SX(n, 1), ca.SX(n, m), ca.SX(n, p)
    for i, (start, end) in enumerate(pairwise(starts)):
        for j in range(start, end - 1):
            f[j] = w[j + 1]
        last = int(end) - 1
        if i < m:
            f[last] = -ca.mtimes(a[i, :], force_drift)
            g[last, :] = a[i, :]
            h[last, :] = -ca.mtimes(a[i, :], beta)
        else:
            f[last] = output_drift[i - m]
            g[last, :] = by_force[i - m : i - m + 1]
            h[last, :] = b1[i - m : i - m + 1] - ca.mtimes(by_force[i - m : i - m + 1], beta)
    row = int(starts[-1])
    f[row:], g[row:, :], h[row:, :] = smooth(free), smooth(free, m), smooth(free, p)
    output = ca.vertcat(ca.SX(0, 1), smooth(met), ca.SX(felt, 1), *heads[m + felt :])
    force = ca.vertcat(ca.SX(rows), ca.SX(p - met, m))
    for j in range(felt):
        force[met + j, m - felt + j] = 1
    constraint = ca.vertcat(ca.SX(0, 1), *heads[:m])
    added = 0.5 * random.normal(size=(m, m))
    for i in range(m):
        # By one way only, so that the rows stay independent.
        others = [j for j in range(m) if (r[j], j) > (r[i], i)]
        constraint[i] += sum(added[i, j] * heads[j] for j in others)

    # A regular feedback and a change of basis.
    f += ca.mtimes(h, smooth(p))
    h = ca.mtimes(h, np.eye(p) + smooth(p, p, 0.1))
    basis = np.eye(m) + 0.3 * random.normal(size=(m, m))
    g, force = ca.mtimes(g, basis), ca.mtimes(force, basis)

    # x = Q T(w), with T_i = w_i + a polynomial of the w_j before it.
    rotation = np.linalg.qr(random.normal(size=(n, n)))[0]
    x = ca.SX.sym("x", n)
    straight = ca.mtimes(rotation.T, x)
    forward, inverse = ca.SX(w), ca.SX(n, 1)
    inverse[0] = straight[0]
    for i in range(1, n):
        c = 0.2 * random.normal(size=(2, i))
        bend = ca.dot(c[0], w[:i] ** 2) + w[0] * ca.dot(c[1], w[:i])
        forward[i] += bend
        inverse[i] = straight[i] - ca.substitute(bend, w[:i], inverse[:i])
    jacobian = ca.mtimes(rotation, ca.jacobian(forward, w))

    def hidden(expression: ca.SX) -> ca.SX:
        return ca.substitute(expression, w, inverse)

    order = random.permutation(p)
    system = DaeSystem(
        state=x,
        f=hidden(ca.mtimes(jacobian, f)),
        g=hidden(ca.mtimes(jacobian, g)),
        h=hidden(ca.mtimes(jacobian, h)),
        k=hidden(constraint),
        l=hidden(output[[int(i) for i in order]]),
        m=force[[int(i) for i in order], :],
        name=f"hidden {seed}",
    )
    return Hidden(system, r, tuple(mu[i] for i in order), free)
