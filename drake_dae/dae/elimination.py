"""The constraint inputs eliminated: v = alpha + beta u, and the system that remains.  (9)-(14)"""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.derivatives import Derivatives
from drake_dae.trace.round_off import Sized, equilibration, multiply, without_round_off


@dataclass(frozen=True, eq=False)
class Elimination:
    """Equations (9)-(14) as expressions of the state; not finite where A(x) is singular.

    On the manifold N* the constraint inputs are v = alpha + beta u (25), and

        x' = f* + h* u,    z = l* + n* u.
    """

    constraint_gradient: ca.SX  # The rows d L_f^(r_i - 1) k_i / dx, shape (m, n).
    constraint_matrix: ca.SX  # A(x) of Assumption (2), shape (m, m).
    alpha: ca.SX  # v where u = 0 (13), shape (m, 1).
    beta: ca.SX  # The factor of u in v (14), shape (m, p).
    f_star: ca.SX  # f + g alpha (9), shape (n, 1).
    h_star: ca.SX  # h + g beta (10), shape (n, p).
    l_star: ca.SX  # l + m alpha (11), shape (p, 1).
    n_star: ca.SX  # m beta (12), shape (p, p).
    pivot: ca.SX  # A scalar that is 0 exactly where A(x) is singular.


def eliminate(derivatives: Derivatives) -> Elimination:
    """Derives (9)-(14) from the derivatives on N*, which are affine in the control."""
    system = derivatives.system
    alpha, beta = derivatives.by_control(derivatives.constraint_input)  # (13), (14), (25)
    f_star, h_star = derivatives.by_control(derivatives.rate)  # (9), (10)
    l_star, n_star = system.outputs(alpha), ca.sparsify(ca.mtimes(system.m, beta))  # (11), (12)
    gradient, matrix = derivatives.constraint_gradient, derivatives.constraint_matrix
    return Elimination(
        gradient, matrix, alpha, beta, f_star, h_star, l_star, n_star, derivatives.pivot
    )


def eliminate_numbers(
    fields: Mapping[str, FloatArray],
    constraint_gradient: FloatArray,
    constraint_matrix: FloatArray,
    scale: FloatArray,
) -> tuple[Sized, Sized]:
    """Returns h* (10) and n* (12) at one state, without round-off."""
    h, size = fields["h"], np.abs(fields["h"])
    by_control = multiply(constraint_gradient, (h, size), scale)
    # Units of the constraints' derivatives, and of the constraint inputs.
    rows, columns = equilibration(np.abs(constraint_matrix))
    scaled = np.linalg.inv(constraint_matrix / rows[:, None] / columns)
    inverse = scaled / columns[:, None] / rows
    beta = multiply(-inverse, by_control, rows)
    added, added_size = multiply(fields["g"], beta, 1.0 / columns)
    h_star = without_round_off(h + added, size + added_size)
    return h_star, multiply(fields["m"], beta, 1.0 / columns)
