"""The errors that a loop around springs leaves, and the springs for which it is stable."""

import casadi as ca
import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray, numbers, positive, vector
from drake_dae.dae.beyond.spring_loop import SpringLoop
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.errors import ModelError

SCALES = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
"""The examined stiffnesses of springs, relative to those in the model of the loop."""

_HORIZON = 20.0
"""Time constants of the slowest pole for which a response is integrated."""


def spring_error_bound(
    law: TrackingLaw,
    times: ArrayLike,
    states: ArrayLike,
    torques: ArrayLike,
    stiffness: ArrayLike,
    inertia: ArrayLike,
    loop: SpringLoop,
    period: float,
    delay: float = 0.0,
) -> FloatArray:
    """Returns a bound of the errors that springs add to those of a rigid law.

    The torque of a `TorqueLoop` differs from the desired one by e, where

        e'' + 2 zeta w e' + (w^2 + K M^-1 P) e = -(1 + zeta + zeta w T) tau_d'' - K B^-1 t u',

    since the slope of tau_d is fed ahead 1 / (2 w) + T / 2 late, and the control u = tau_d + B a_d
    acts a time t late: its delay and half a sample T. The loop is fast, and the motion along a
    reference is slow: if tau_d changes at a rate W, the derivatives of e add terms of relative size
    W / w only (Tikhonov), so that with the error (W / w)^2 relative to tau_d

        e = -(w^2 + K M^-1 P)^-1 ((1 + zeta + zeta w T) tau_d'' + K B^-1 t u').

    The errors of the outputs then have, as in `sampling_error`, e_i^(mu_i) + sum_j K_ij e_i^(j-1) =
    x_i = (B(x) e)_i. A bound is sup |x_i| times the integral of the absolute impulse response g_i,
    or sup |x_i'| times that of the integral of g_i; the smaller one is taken, and multiplied by
    coth(pi zeta / (2 sqrt(1 - zeta^2))), the overshoot of e.

    It holds for an exact model along a smooth reference, after the transients of the start; what
    observers leave of friction and disturbances is not in it.

    Args:
        law: The rigid law.
        times: Times in s, shape (k,), increasing and dense enough to resolve the torques.
        states: (q, v) along the reference, shape (k, n).
        torques: tau_d there, shape (k, p).
        stiffness, inertia: K and B, shape (p,) or (p, p).
        loop: The rates of the loop.
        period: T in s.
        delay: The delay of the control in s.

    Returns:
        A bound of the error of each output, shape (p,), in its unit.

    Raises:
        ModelError: A shape is wrong.
    """
    moments = vector("times", times, None)
    x, tau = numbers("states", states), numbers("torques", torques)
    K, B = (_square(value) for value in (stiffness, inertia))
    if moments.size < 5 or x.shape[0] != moments.size or tau.shape[0] != moments.size:
        raise ModelError(
            "times, states and torques must have the same number of rows, five or more"
        )
    elimination, system = law.structure.elimination, law.system
    rows = [i for i in range(system.num_states) if system.h[i, :].nnz()]
    function = system.trace(
        "response to torques",
        {
            "moves": elimination.h_star[rows, :],
            "rate": elimination.f_star[rows, :],
            "outputs": law.structure.control_matrix,
        },
        often=False,
    )
    values, traced, ahead = system.parameter_values, [], []
    for state in x:
        traced.append([part.copy() for part in function(state, values)])
    p = tau.shape[1]
    moves = [part[0].reshape(len(rows), p) for part in traced]
    # The actuated accelerations are the force's, by virtual work.
    select = np.linalg.pinv(_actuation(law, rows))
    for (_, rate, _), matrix, torque in zip(traced, moves, tau, strict=True):
        ahead.append(select @ (rate + matrix @ torque))
    control = tau + np.array(ahead) @ B.T
    bends = np.gradient(np.gradient(tau, moments, axis=0), moments, axis=0)
    bends *= 1.0 + loop.damping * (1.0 + loop.rate * period)
    late = (delay + period / 2.0) * np.gradient(control, moments, axis=0)
    driven = np.zeros_like(tau)
    for k, matrix in enumerate(moves):
        stiffness_of_error = loop.rate**2 * np.eye(p) + K @ select @ matrix
        error = -np.linalg.solve(stiffness_of_error, bends[k] + K @ np.linalg.solve(B, late[k]))
        driven[k] = traced[k][2].reshape(p, p) @ error
    # Differences at both ends are one-sided.
    inner = slice(2, -2)
    rates = np.gradient(driven, moments, axis=0)
    return _bounds(law, np.abs(driven[inner]).max(axis=0), np.abs(rates[inner]).max(axis=0), loop)


def _actuation(law: TrackingLaw, rows: list[int]) -> FloatArray:
    """Which accelerations are those of actuated joints, shape (nv, p)."""
    matrix = ca.DM(ca.sparsify(law.system.h[rows, :]))
    return np.asarray(matrix.full())


def _bounds(
    law: TrackingLaw, largest: FloatArray, fastest: FloatArray, loop: SpringLoop
) -> FloatArray:
    """Bounds of the errors by inputs with these largest values and rates."""
    degrees, integrated = law.degrees, law.integral.outputs
    matrix, heads = law.gains.error_matrix, law.gains.layout.starts
    result = np.zeros(len(degrees))
    for i, degree in enumerate(degrees):
        count = degree + (i in integrated)
        if not count:
            result[i] = largest[i]
            continue
        start = int(heads[i])
        block = matrix[start : start + count, start : start + count]
        at_once, summed = _sizes(block, degree, i in integrated)
        result[i] = min(at_once * largest[i], summed * fastest[i])
    zeta = loop.damping
    if zeta >= 1.0:
        return result
    return result / np.tanh(np.pi * zeta / (2.0 * np.sqrt(1.0 - zeta**2)))


def _sizes(matrix: FloatArray, degree: int, is_integrated: bool) -> tuple[float, float]:
    """The integrals of |g| and of |integral of g|; infinite where an error does not decay."""
    slowest = -np.max(np.linalg.eigvals(matrix).real)
    fastest = np.max(np.abs(np.linalg.eigvals(matrix)))
    step, count = 0.02 / fastest, int(_HORIZON * fastest / slowest / 0.02)
    advance, state = scipy.linalg.expm(matrix * step), np.zeros(len(matrix))
    state[-1] = 1.0
    course = np.empty((count + 1, len(matrix)))
    for k in range(count + 1):
        course[k] = state
        state = advance @ state
    sums = np.abs(course).sum(axis=0) * step
    if degree == 0:  # A force: sigma' = -K sigma + x, and its error is sigma'.
        return 2.0, float(sums[0])
    if is_integrated:
        return float(sums[1]), float(sums[0])
    return float(sums[0]), np.inf


def spring_loop_radius(
    stiffness: ArrayLike,
    inertia: ArrayLike,
    mobility: ArrayLike,
    loop: SpringLoop,
    period: float,
    delay: int,
    scale: float = 1.0,
) -> float:
    """Returns the spectral radius of a sampled `TorqueLoop` at rest, for other springs.

    The deflections d have, with the mobility L of the links and held torques u of `delay` samples
    before,

        d'' = B^-1 (u - s K d) - L s K d,    u = K d - B (w^2 d + 2 zeta w d') + f_o,

    exactly between samples, where the observer of motors takes s K d - K d for friction.

    Args:
        stiffness, inertia: K and B, shape (p,) or (p, p).
        mobility: L, shape (p, p): M^-1 of free links, less what constraints hold.
        loop, period: As for `TorqueLoop`.
        delay: The delay of the control in samples.
        scale: s, the stiffness of the springs relative to K.

    Raises:
        ModelError: A number is not positive.
    """
    K, B, L = (_square(value) for value in (stiffness, inertia, mobility))
    T, s, p = positive("period", period), positive("scale", scale), len(K)
    one, none = np.eye(p), np.zeros((p, p))
    inverse = np.linalg.inv(B)
    # (d, d', the integral of d, u).
    stiff = -s * (inverse + L) @ K
    A = np.block([[none, one, none, none], [stiff, none, none, inverse], [one, none, none, none]])
    A = np.vstack([A, np.zeros((p, 4 * p))])
    step = scipy.linalg.expm(A * T)
    # The measured state gives the next control, with the observer's f_o (its sign as added).
    w, zeta, gain = loop.rate, loop.damping, -np.expm1(-loop.motor_rate * T)
    # The rows that select d, d', f_o, and the delayed controls, of which the next to act is first.
    d, rate, friction, *delayed = np.split(np.eye((3 + delay) * p), 3 + delay)
    law = (K - w**2 * B) @ d - 2.0 * zeta * w * B @ rate + friction
    control, *delayed = [*delayed, law]
    next_d, next_rate, integral = (
        part[:, :p] @ d + part[:, p : 2 * p] @ rate + part[:, 3 * p :] @ control
        for part in np.split(step, 4)[:3]
    )
    # The observer takes the mean of K d at both ends, and the momentum has that of s K d.
    observed = s * K @ integral / T - K @ (d + next_d) / 2.0
    friction = friction + gain * (observed - friction)
    matrix = np.vstack([next_d, next_rate, friction, *delayed])
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def stable_scales(
    stiffness: ArrayLike,
    inertia: ArrayLike,
    mobilities: list[FloatArray],
    loop: SpringLoop,
    period: float,
    delay: int,
) -> tuple[float, float] | None:
    """Returns the range of relative stiffnesses for which a `TorqueLoop` is stable.

    Args:
        mobilities: The mobilities of free and of constrained links; the other arguments are those
            of `spring_loop_radius`.

    Returns:
        The lowest and the highest of `SCALES` between which all examined ones are stable; None if
        the loop is unstable for the given springs.
    """
    arguments = loop, period, delay
    is_stable = [
        all(spring_loop_radius(stiffness, inertia, L, *arguments, scale) < 1.0 for L in mobilities)
        for scale in SCALES
    ]
    low = high = SCALES.index(1.0)
    if not is_stable[low]:
        return None
    while low > 0 and is_stable[low - 1]:
        low -= 1
    while high + 1 < len(SCALES) and is_stable[high + 1]:
        high += 1
    return SCALES[low], SCALES[high]


def _square(value: ArrayLike) -> FloatArray:
    """Converts a diagonal, or a matrix, to a matrix."""
    matrix = np.asarray(value, dtype=float)
    return np.diag(matrix) if matrix.ndim == 1 else matrix
