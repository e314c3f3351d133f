"""The control within limits by which the error leaves its prediction least."""

import casadi as ca
import numpy as np

from drake_dae.dae.governing.quadratic import nearest_within
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.timing.limited_signals import LimitedSignals
from drake_dae.dae.timing.motion_limits import MotionLimits
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction

SOFTNESS = 1e-8
"""How far forces give way where drives cannot hold them, for a multiplier of one."""

WITHIN = 1e-9
"""An excess over a limit, as a share of it, that is round-off."""


def feasible_control(structure: Structure, limits: MotionLimits) -> TracedFunction:
    """Builds the function that limits a control so that the outputs change least.

    By (26), (27) z_i^(mu_i) = a_i + B_i u. With ubar_d = a + B u_d of the control (28) it is

        min |W (ubar - ubar_d)|^2 = |W B (u - u_d)|^2   with   |u_j| <= U_j,
        least <= v = alpha + beta u <= largest,

    where W divides each output by the length of its row of B diag(U). Limits of u hold always;
    those of v, and of cones, as far as they allow it. u is u_d where that is within all limits.
    ubar - ubar_d is by how much the derivative e^(mu) of the error leaves (30).

    Args:
        structure: The structure of the system, with as many controls as outputs.
        limits: Symmetric limits of all controls, and limits of forces and cones; others are not
            used.

    Returns:
        (state, control, parameters) -> control, excess, departure, is_limited: excess is u_d - u,
        departure ubar - ubar_d.

    Raises:
        ModelError: A control has no limit or one that is not symmetric, there are more controls
            than outputs, or a limit names no signal.
    """
    system = structure.system
    limits.check(system)
    low, high = limits.bounds("controls", system.control_signals)
    if system.control_metric is not None:
        raise ModelError(f"{system.name}: needs as many outputs as controls")
    for signal, least, most in zip(system.control_signals, low, high, strict=True):
        if not (np.isfinite(most) and least == -most):
            raise ModelError(
                f"{system.name}: each control needs a limit of its magnitude, '{signal.name}' has "
                f"{least:g} to {most:g} {signal.unit}"
            )
    desired, scale = ca.SX.sym("wanted", system.num_controls), ca.DM(high)
    matrix = ca.densify(structure.control_matrix)  # (16)
    inputs_of_matrix = [system.state, system.parameter_symbol]
    usual = ca.Function("B", inputs_of_matrix, [matrix])(
        structure.states[0], system.parameter_values
    ).full()
    weights = 1.0 / np.linalg.norm(usual * high, axis=1)
    effect = ca.mtimes(ca.diag(ca.DM(weights)), matrix) @ ca.diag(scale)
    metric = ca.mtimes(effect.T, effect)
    metric /= ca.trace(metric) / high.size
    rows, bounds = _forces(structure, limits, scale)
    goal = desired / scale
    nearest = nearest_within(metric, goal, rows, bounds, SOFTNESS)
    over = ca.vertcat(ca.fabs(goal) - 1.0, ca.mtimes(rows, goal) - bounds)
    is_limited = ca.mmax(over) > WITHIN
    limited_control = ca.if_else(is_limited, nearest * scale, desired)
    control = ca.fmax(-scale, ca.fmin(scale, limited_control))
    excess = ca.if_else(is_limited, desired - control, 0.0)
    outputs = {
        "control": control,
        "excess": excess,
        "departure": -ca.mtimes(matrix, excess),
        "is_limited": is_limited,
    }
    inputs = {"state": system.state, "control": desired, "parameters": system.parameter_symbol}
    name = f"{system.name} feasible control"
    return TracedFunction(name, inputs, outputs, compiled=system.compiled)


def _forces(structure: Structure, limits: MotionLimits, scale: ca.DM) -> tuple[ca.SX, ca.SX]:
    """Returns A and b of A x <= b for u = U x, with rows of length one."""
    limited = LimitedSignals(structure, MotionLimits(forces=limits.forces, cones=limits.cones))
    free, by = limited.by_control()
    slopes, rows, bounds = ca.mtimes(by, ca.diag(scale)), [], []
    for i, (low, high) in enumerate(zip(limited.low, limited.high, strict=True)):
        length = ca.norm_2(slopes[i, :]) + np.finfo(float).tiny
        for bound, sign in ((high, 1.0), (low, -1.0)):
            if np.isfinite(bound):
                rows.append(sign * slopes[i, :] / length)
                bounds.append(sign * (bound - free[i]) / length)
    columns = structure.system.num_controls
    return ca.vertcat(ca.SX(0, columns), *rows), ca.vertcat(ca.SX(0, 1), *bounds)
