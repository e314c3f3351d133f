"""The law (28) in a sampled controller: with delay, and held between samples."""

from math import floor

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, number, numbers, positive, vector
from drake_dae.dae.law_model import acting_late
from drake_dae.dae.linearization import ComplexArray, Linearization, linearize, linearize_loop
from drake_dae.dae.tracking import TrackingLaw
from drake_dae.errors import ModelError

_SAME = 1e-9
"""Times that differ by less than this, in periods, count as equal."""

RESTS = 1e-4
"""A state counts as an equilibrium if its change within the time constant of the fastest pole is at
most this, relative to its scale."""

MOST_STATES = 2000
"""The largest number of states, including delayed ones; for more, the poles would take minutes."""


@checked(ModelError)
def sampled_poles(
    law: TrackingLaw,
    reference: ArrayLike,
    period: float,
    delay: float = 0.0,
    *,
    state: ArrayLike | None = None,
    parameters: ArrayLike | None = None,
) -> ComplexArray:
    """Returns the exact poles of a robot under a sampled law, about an equilibrium.

    The law samples at t_k = k T; its control acts from t_k + d until t_(k+1) + d. About an
    equilibrium a deviation x of the minimal states on N* has x' = A x without the law and x' = (A +
    G) x with it. With d = n T + c, 0 <= c < T, and Gamma(t) = int_0^t exp(A s) ds,

        x_(k+1) = exp(A T) x_k + Gamma(T - c) G x_(k-n) + exp(A (T - c)) Gamma(c) G x_(k-n-1).

    The loop is stable where all of these poles are within the unit circle, that is
    abs(sampled_poles(...)).max() < 1; where T and d tend to 0 they tend to exp(p T) for the poles p
    of the continuous loop, and to 0. A compliant constraint has further poles: see
    `contact_damping`.

    Args:
        law: The law, without integrals, whose control takes no measured force.
        reference: R, shape (sum (mu_i + 1),), at rest.
        period: T in s.
        delay: d in s.
        state: x on N*, shape (n,), an equilibrium under the law; the nominal consistent state if
            None.
        parameters: Values of the plant's parameters; the defaults if None.

    Returns:
        The poles, shape ((n + 2) k,) for k minimal states, largest first.

    Raises:
        InconsistentStateError: The state is not on N*.
        ModelError: The law is another one, the state is no equilibrium, or a number makes no sense.
    """
    _check(law)
    period, delay = positive("period", period), _delay(delay)
    loop = linearize_loop(law, reference, state, parameters=parameters)
    plant = linearize(
        law.system, loop.state, loop.control, structure=law.structure, parameters=parameters
    )
    A = plant.minimal.A
    G = loop.minimal.A - A
    _check_rest(law, loop, A + G)
    size, late = len(A), floor(delay / period + _SAME)
    if (late + 2) * size > MOST_STATES:
        raise ModelError(
            f"a delay of {delay:g} s is {late} periods of {period:g} s, which needs "
            f"{late + 2} x {size} states; at most {MOST_STATES} are allowed. Use a longer period"
        )
    rest = max(delay - late * period, 0.0)
    begin, end = (_held(A, G, length) for length in (rest, period - rest))
    matrix = np.eye((late + 2) * size, k=-size)
    matrix[:size] = 0.0
    matrix[:size, :size] = end[0] @ begin[0]
    matrix[:size, late * size : (late + 1) * size] += end[1]
    matrix[:size, (late + 1) * size :] += end[0] @ begin[1]
    eigenvalues = np.linalg.eigvals(matrix).astype(complex)
    return eigenvalues[np.argsort(-np.abs(eigenvalues), kind="stable")]


def _held(A: FloatArray, G: FloatArray, length: float) -> tuple[FloatArray, FloatArray]:
    """Returns exp(A t) and Gamma(t) G."""
    size = len(A)
    both = np.block([[A, G], [np.zeros((size, 2 * size))]])
    transition = scipy.linalg.expm(both * length)
    return transition[:size, :size], transition[:size, size:]


@checked(ModelError)
def sampling_error(
    law: TrackingLaw,
    times: ArrayLike,
    states: ArrayLike,
    controls: ArrayLike,
    period: float,
    delay: float = 0.0,
    *,
    parameters: ArrayLike | None = None,
) -> FloatArray:
    """Returns the error that sampling adds to (30), (31), to first order in period and delay.

    For any plant and reference, z_i^(mu_i) = a_i + B_i u gives without approximation

        e_i^(mu_i) + sum_j K_ij e_i^(j-1) = (B(x) (u - u_law(x, R)))_i,

    where u_law is the current output of the law, and u its output a time d + (t - t_k) earlier. To
    first order u - u_law = -(d + t - t_k) u', on average -(d + T / 2) u'. This drives the errors of
    outputs with mu_i >= 1, from zero at the start. An output with mu_i = 0 follows u without delay:
    its error is a sawtooth, given here by its peak before each new control, -(d + T) (B u')_i.

    So the error of a sampled loop is predicted from a run without sampling. It is proportional to
    the period; neglected terms are proportional to its square. For stability see `sampled_poles`.

    Args:
        law: The law, without integrals, whose control takes no measured force, and which does not
            compensate damping with a latency.
        times: Times in s, shape (k,), increasing, and dense enough to resolve the control.
        states: x of a run under the continuous law, shape (k, n).
        controls: u of that run, shape (k, p).
        period: T in s.
        delay: d in s.
        parameters: Values of all parameters; the defaults if None.

    Returns:
        The error of each output, shape (k, p).

    Raises:
        ModelError: The law is another one, a shape is wrong, or a number makes no sense.
    """
    _check(law)
    if acting_late(law.system, law.latency) is not law.system:
        raise ModelError(
            f"{law.system.name}: the law compensates damping with its latency of {law.latency:g} "
            "s, which this prediction does not include; use a law with latency=0, or simulate the "
            "loop"
        )
    period, delay = positive("period", period), _delay(delay)
    moments = vector("times", times, None)
    if moments.size < 3 or np.any(np.diff(moments) <= 0.0):
        raise ModelError("times must be three or more numbers, and increase")
    count, system = moments.size, law.system
    courses = [
        _course("states", states, (count, system.num_states)),
        _course("controls", controls, (count, system.num_controls)),
    ]
    values = law.system.parameter_vector(parameters)
    matrix = law.system.trace("control matrix", {"B": law.structure.control_matrix}, often=False)
    rates = np.gradient(courses[1], moments, axis=0, edge_order=2)
    driven = np.array(
        [
            matrix(state, values)[0].reshape(len(law.degrees), -1) @ rate
            for state, rate in zip(courses[0], rates, strict=True)
        ]
    )
    error = -(delay + period) * driven
    layout = law.layout
    push = np.zeros((layout.chain_size, moments.size))
    push[layout.ends] = -(delay + 0.5 * period) * driven[:, layout.dynamic].T
    chains = _response(law.gains.error_matrix, moments, push.T)
    error[:, layout.dynamic] = chains[:, layout.heads]
    return error


def _response(matrix: FloatArray, times: FloatArray, push: FloatArray) -> FloatArray:
    """The solution of e' = E e + input from zero, input linear between times, shape (k, N)."""
    size, lengths = len(matrix), np.diff(times)
    # The states e, 1 and the time since the start of the step form one linear system.
    both = np.zeros((lengths.size, size + 2, size + 2))
    both[:, :size, :size] = matrix
    both[:, :size, size] = push[:-1]
    both[:, :size, size + 1] = np.diff(push, axis=0) / lengths[:, None]
    both[:, size + 1, size] = 1.0
    steps = scipy.linalg.expm(both * lengths[:, None, None])
    states = np.zeros((times.size, size))
    for index, step in enumerate(steps):
        states[index + 1] = step[:size, :size] @ states[index] + step[:size, size]
    return states


def _check(law: TrackingLaw) -> None:
    if law.integral.outputs or law.control_takes_force:
        what = "integrals" if law.integral.outputs else "a measured force in its control"
        raise ModelError(
            f"{law.system.name}: a law with {what} has a state in the loop that the prediction "
            "does not include; use the law without it, or simulate the loop"
        )


def _delay(delay: float) -> float:
    seconds = number("delay", delay)
    if seconds < 0.0:
        raise ModelError(f"delay must be 0 s or more, got {delay:g}")
    return seconds


def _check_rest(law: TrackingLaw, loop: Linearization, matrix: FloatArray) -> None:
    """Checks that a state is an equilibrium."""
    moves = np.abs(loop.rate) / law.system.scale
    fastest = np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0)
    worst = int(np.argmax(moves))
    if moves[worst] > RESTS * fastest:
        signal = law.system.state_signals[worst]
        raise ModelError(
            f"{law.system.name}: poles are computed at an equilibrium under the law, but at this "
            f"state {signal.name} changes by {loop.rate[worst]:.3g} {signal.unit} per second. Give "
            "a constant reference, and its steady state"
        )


def _course(name: str, values: ArrayLike, shape: tuple[int, int]) -> FloatArray:
    """Checks an array with a row for each time."""
    rows = numbers(name, values)
    if rows.shape != shape or not np.isfinite(rows).all():
        raise ModelError(
            f"{name} must be finite and of shape {shape}, with a row for each of {shape[0]} times, "
            f"got {rows.shape}"
        )
    return rows
