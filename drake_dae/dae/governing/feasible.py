"""The control within limits by which the error leaves its prediction least."""

from dataclasses import replace

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.governing.quadratic import nearest_within
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.timing.limited_signals import APPROACH, LimitedSignals
from drake_dae.dae.timing.motion_limits import MotionLimits
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction

SOFTNESS = 1e-8
"""How far forces give way where drives cannot hold them, for a multiplier of one."""

SOFTER = 1e-6
"""The same for speeds of joints, which give way before forces."""

WITHIN = 1e-9
"""An excess over a limit, as a share of it, that is round-off."""


def feasible_control(
    structure: Structure, limits: MotionLimits, sample_period: float = 0.0
) -> TracedFunction:
    """Builds the function that limits a control so that the outputs change least.

    By (26), (27) z_i^(mu_i) = a_i + B_i u. With ubar_d = a + B u_d of the control (28) it is

        min |W (ubar - ubar_d)|^2 = |W B (u - u_d)|^2   with   |u_j| <= U_j,
        least <= v = alpha + beta u <= largest,

    and with the limits of states, the speeds of joints, where W divides each output by the length
    of its row of B diag(U). Limits of u hold always; those of v and of cones as far as they allow
    it; those of speeds as far as these allow it, by w' <= APPROACH (W - w) close to W, see
    `LimitedSignals.approach`. Limits of rates, the accelerations of joints, are not kept: a robot
    that may not brake leaves its path, and with an error of its model it does not return. u is u_d
    where that is within all limits. ubar - ubar_d is by how much the derivative e^(mu) of the error
    leaves (30).

    Args:
        structure: The structure of the system, with as many controls as outputs.
        limits: Symmetric limits of all controls, and others; those of rates are not used.
        sample_period: The time in s in which the control is constant; 0 if it is continuous.

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
    rows, sides, bounds, softness = _soft(structure, limits, sample_period, scale)
    goal = desired / scale
    nearest = nearest_within(metric, goal, rows, sides, bounds, softness)
    over = ca.vertcat(ca.fabs(goal) - 1.0, ca.mtimes(sides, ca.mtimes(rows, goal)) - bounds)
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


def _soft(
    structure: Structure, limits: MotionLimits, sample_period: float, scale: ca.DM
) -> tuple[ca.SX, ca.DM, ca.SX, FloatArray]:
    """Returns A, S, b and the softness of S A x <= b for u = U x, with rows of A of length one.

    States stay within their limits with the rates of `LimitedSignals.approach`. b is cut off where
    no x is near it.
    """
    limited = LimitedSignals(structure, replace(limits, controls={}, rates={}))
    parts = zip(limited.by_control(), limited.rates_of_states(), strict=True)
    free, by = (ca.vertsplit(ca.vertcat(*part)) for part in parts)
    pairs = zip((limited.low, limited.high), limited.approach(sample_period), strict=True)
    low, high = (ca.vertsplit(ca.vertcat(ca.SX(bound), rate)) for bound, rate in pairs)
    softness = [SOFTNESS] * len(limited.signals) + [SOFTER] * len(limited.states)
    columns = structure.system.num_controls
    rows, bounds, soft, sides = [], [], [], []
    furthest = columns**0.5 + 1.0
    for i, slope in enumerate(by):
        slope = ca.sparsify(ca.mtimes(slope, ca.diag(scale)))
        if not slope.nnz():
            continue  # The rate of a position, which no control changes at once.
        length = ca.norm_2(slope) + np.finfo(float).tiny
        rows.append(slope / length)
        for bound, sign in ((high[i], 1.0), (low[i], -1.0)):
            if _is_finite(bound):
                sides.append((len(rows) - 1, sign))
                bound = sign * (bound - free[i]) / length
                bounds.append(ca.fmin(ca.fmax(bound, -furthest), furthest))
                soft.append(softness[i])
    chosen = np.zeros((len(sides), len(rows)))
    for i, (row, sign) in enumerate(sides):
        chosen[i, row] = sign
    matrix, column = ca.vertcat(ca.SX(0, columns), *rows), ca.vertcat(ca.SX(0, 1), *bounds)
    return matrix, ca.sparsify(ca.DM(chosen)), column, np.array(soft)


def _is_finite(bound: ca.SX) -> bool:
    return not bound.is_constant() or bool(np.isfinite(float(bound)))


def limits_reached(
    structure: Structure, limits: MotionLimits, sample_period: float = 0.0
) -> tuple[TracedFunction, tuple[str, ...]]:
    """Builds the function that says which limits a control exceeds.

    Args:
        structure: The structure of the system.
        limits: The limits.
        sample_period: As of `feasible_control`.

    Returns:
        (state, control, parameters) -> excess over each limit as a share of it, positive beyond it,
        shape (k,); and the name of each, such as "largest joint1_motor". A limit of 0 counts as 1.
    """
    system, limited = structure.system, LimitedSignals(structure, limits)
    control = ca.SX.sym("control", system.num_controls)
    free, by = limited.by_control()
    of_states, by_states = limited.rates_of_states()
    values = ca.vertcat(free + ca.mtimes(by, control), of_states + ca.mtimes(by_states, control))
    slowest, fastest = limited.approach(sample_period)
    low, high = ca.vertcat(ca.SX(limited.low), slowest), ca.vertcat(ca.SX(limited.high), fastest)
    sizes = [
        *np.minimum(np.abs(limited.low), np.abs(limited.high)),
        *(APPROACH * np.minimum(np.abs(limited.state_low), np.abs(limited.state_high))),
    ]
    over, names = [], list[str]()
    for i, signal in enumerate([*limited.signals, *limited.state_signals]):
        for bound, sign, side in ((high[i], 1.0, "largest"), (low[i], -1.0, "least")):
            if _is_finite(bound):
                over.append(sign * (values[i] - bound) / (sizes[i] or 1.0))
                names.append(f"{side} {signal.name}")
    inputs = {"state": system.state, "control": control, "parameters": system.parameter_symbol}
    outputs = {"over": ca.vertcat(ca.SX(0, 1), *over)}
    return TracedFunction(f"{system.name} limits", inputs, outputs), tuple(names)
