"""Lie derivatives of expressions, exact and without Jacobians where a direction is enough."""

import casadi as ca


def lie_derivative(expression: ca.SX, field: ca.SX, state: ca.SX) -> ca.SX:
    """Returns L_f k = (dk/dx) f, by one forward sweep."""
    return ca.jtimes(expression, state, ca.densify(field))


def lie_derivative_along(expression: ca.SX, fields: ca.SX, state: ca.SX) -> ca.SX:
    """Returns [L_g1 k, ..., L_gm k] with structural zeros."""
    return ca.sparsify(ca.mtimes(ca.jacobian(expression, state), fields))
