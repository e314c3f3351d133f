"""The constraint inputs eliminated: v = alpha + beta u, and the system that remains.   (9)-(14)"""

from dataclasses import dataclass

import casadi as ca

from drake_dae.dae.derivatives import Motion


@dataclass(frozen=True, eq=False)
class Elimination:
    """Equations (9)-(14) as expressions of the state.

    On the manifold N* the constraint inputs are v = alpha + beta u (25), and

        x' = f* + h* u,    z = l* + n* u.

    Attributes:
        constraint_gradient: d L_f^(r_i - 1) k_i / dx, shape (m, n).
        constraint_matrix: A(x) of Assumption (2), shape (m, m).
        alpha: (13), shape (m, 1).
        beta: (14), shape (m, p).
        f_star: f + g alpha (9), shape (n, 1).
        h_star: h + g beta (10), shape (n, p).
        l_star: l + m alpha (11), shape (p, 1).
        n_star: m beta (12), shape (p, p).
        pivot: 0 exactly where A(x) is singular; see `expressions.Factorization`.
    """

    constraint_gradient: ca.SX
    constraint_matrix: ca.SX
    alpha: ca.SX
    beta: ca.SX
    f_star: ca.SX
    h_star: ca.SX
    l_star: ca.SX
    n_star: ca.SX
    pivot: ca.SX


def eliminate(motion: Motion) -> Elimination:
    """The motion on N*, which is affine in the control, as expressions of the state."""
    system = motion.system
    alpha, beta = affine(motion.expand(motion.constraint_input), motion.control)
    f_star, h_star = affine(motion.expand(motion.rate), motion.control)
    return Elimination(
        constraint_gradient=motion.constraint_gradient,
        constraint_matrix=motion.constraint_matrix,
        alpha=alpha,
        beta=beta,
        f_star=f_star,
        h_star=h_star,
        l_star=system.l + ca.mtimes(system.m, alpha),
        n_star=ca.sparsify(ca.mtimes(system.m, beta)),
        pivot=motion.pivot,
    )


def affine(expression: ca.SX, control: ca.SX) -> tuple[ca.SX, ca.SX]:
    """a and B of an expression a(x) + B(x) u, shapes (k, 1) and (k, p)."""
    zero = ca.SX.zeros(control.numel())
    slope = ca.jacobian(expression, control)
    return ca.substitute(expression, control, zero), ca.sparsify(
        ca.substitute(slope, control, zero)
    )
