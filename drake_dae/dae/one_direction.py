"""The sampled loop of a law in one direction, as a linear system driven by noise."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from drake_dae.arrays import FloatArray
from drake_dae.dae.disturbance import ChainFilter, transition


@dataclass(frozen=True)
class SensorNoise:
    """The standard deviations of measurements in one direction, from sample to sample.

    Attributes:
        position: In m, or rad.
        velocity: In m/s, or rad/s; 0 if it is exact, not measured, or a difference.
        force: In N, or N m.
        velocity_bandwidth: The bandwidth of filtered differences of positions, in rad/s, which are
            then the velocities; 0 for measured velocities. See `Encoders`.
    """

    position: float = 0.0
    velocity: float = 0.0
    force: float = 0.0
    velocity_bandwidth: float = 0.0


@dataclass(frozen=True)
class Direction:
    """The motion in one direction, sampled each `period` seconds and delayed by some samples.

    `mobility` is the acceleration per force in the model of the law, `mass_error` the true one
    relative to it; `stiffness` in N/m is 0 in a free direction.
    """

    period: float
    delay: int
    mobility: float = 1.0
    stiffness: float = 0.0
    mass_error: float = 1.0


@dataclass(frozen=True)
class DirectionGains:
    """The gains of a law and its observer in a direction, in 1/s.

    `gains` are those of the integral of the error, of the error and of its derivative; along a
    contact only the last is used, the damping c. `state_rate` is that of a `StateEstimator`.
    """

    gains: tuple[float, float, float]
    force_gain: float
    observer_rate: float
    state_rate: float | None = None

    @property
    def poles(self) -> tuple[float, float]:
        """p and zeta of `pole_gains`."""
        p = self.gains[0] ** (1.0 / 3.0)
        return p, (self.gains[2] / p - 1.0) / 2.0


@dataclass(frozen=True)
class SampledLoop:
    """A sampled linear loop: x+ = A x + B n with noise n of deviation 1, and outputs C x + D n.

    `step` and `noise` are A and B. `shown` has the rows (C, D) of the error, of a contact that of
    its force, and of the acceleration that the law commands. `push` is the change of x during a
    sample by a disturbing acceleration of 1.
    """

    step: FloatArray
    noise: FloatArray
    shown: FloatArray
    push: FloatArray
    period: float

    @property
    def radius(self) -> float:
        """The spectral radius; the loop is stable below 1."""
        return float(np.abs(np.linalg.eigvals(self.step)).max())

    def deviations(self) -> tuple[float, float]:
        """Returns the standard deviations of the error, and of the acceleration's changes."""
        size = len(self.step)
        if not self.radius < 1.0:
            return np.inf, np.inf
        spread = solve_discrete_lyapunov(self.step, self.noise @ self.noise.T, method="bilinear")
        error, command = self.shown
        c, d = error[:size], error[size:]
        first = float(c @ spread @ c + d @ d)
        # The difference of two samples: C x+ + D n+ - (C x + D n), with x+ = A x + B n.
        c, d = command[:size], command[size:]
        change, along = c @ self.step - c, c @ self.noise - d
        second = float(change @ spread @ change + along @ along + d @ d)
        return max(first, 0.0) ** 0.5, max(second, 0.0) ** 0.5

    def after_step(self) -> float:
        """Returns sqrt(sum of squares) of the error after a disturbing acceleration steps to 1."""
        size = len(self.step)
        if not self.radius < 1.0:
            return np.inf
        rest = np.linalg.solve(np.eye(size) - self.step, self.push)
        spread = solve_discrete_lyapunov(
            self.step.T, np.outer(*[self.shown[0, :size]] * 2), method="bilinear"
        )
        return float(max(rest @ spread @ rest, 0.0)) ** 0.5


def sampled_loop(direction: Direction, rates: DirectionGains, noise: SensorNoise) -> SampledLoop:
    """Returns the loop of a law whose model is right, except for the `mass_error`.

    In a free direction the error moves as e'' = m a + d, where a is the acceleration that the law
    commands, held for a sample after its delay, and m the mass_error. In a contact the depth moves
    as phi'' = m (a - A k phi) + d, and the law measures the force -k phi. With the estimates
    e, e' and d of observer or estimator the law commands

        a = -K_1 sigma - K_2 e - K_3 e' - d            free,
        a = -c phi' - A K_i sigma_F - d                in a contact,

    with the sums sigma of the error and sigma_F of the force's error.

    If samples are fast, white noise n of free positions leaves with the estimator's gains l_1 to
    l_3 for q, v and a, whose poles are the roots of D = s^3 + l_1 s^2 + l_2 s + l_3,

        e = -(l_3 s^3 + K_3 s^2 (l_2 s + l_3) + (K_2 s + K_1) (l_1 s^2 + l_2 s + l_3)) n / (P D),

    P = s^3 + K_3 s^2 + K_2 s + K_1, of the variance T sigma_n^2 / (2 pi) int |e/n|^2 dw.
    """
    parts = ["e", "v", "sum", *(f"held{i}" for i in range(direction.delay))]
    parts += ["q", "w", "a"] if rates.state_rate else ["r", "before", "acted"]
    parts += ["difference", "measured"] if noise.velocity_bandwidth else []
    kinds = ["position", "velocity", "force", "held"]
    size, count = len(parts), len(parts) + 3
    # Each quantity is a row of its dependence on the state, the three noises and the disturbance.
    rows = dict(zip([*parts, *kinds], np.eye(count + 1), strict=True))
    after, shown = _step(direction, rates, noise, rows)
    # In units of e, e / T and e / T^2, so that all parts are of one size.
    orders = {**_ORDERS, "sum": 1 if direction.stiffness else -1}
    units = direction.period ** np.array([orders.get(name, 2) for name in parts])
    both = np.array([after[name] for name in parts]) * units[:, None]
    both[:, :size] /= units
    looked = np.array([row[:count] for row in shown])
    looked[:, :size] /= units
    return SampledLoop(
        both[:, :size], both[:, size:count], looked, both[:, count], direction.period
    )


_ORDERS = {"e": 0, "q": 0, "measured": 0, "v": 1, "w": 1, "before": 1, "difference": 1}
"""The order of the derivative that each part is; others are accelerations."""


Rows = dict[str, FloatArray]


def _step(
    direction: Direction, rates: DirectionGains, noise: SensorNoise, now: Rows
) -> tuple[Rows, tuple[FloatArray, FloatArray]]:
    """The quantities at the next sample; and the error, and the commanded acceleration."""
    period, mass = direction.period, direction.mass_error
    stiff = direction.mobility * direction.stiffness
    after = dict(now)
    position = now["e"] + noise.position * now["position"]
    velocity = now["v"] + noise.velocity * now["velocity"]
    if noise.velocity_bandwidth:
        a = np.exp(-noise.velocity_bandwidth * period)
        rise = (position - now["measured"]) / period
        velocity = a * now["difference"] + (1.0 - a) * rise
        after |= {"difference": velocity, "measured": position}
    pressed = -stiff * now["e"] + direction.mobility * noise.force * now["force"]

    estimates, update = (_estimated if rates.state_rate else _observed)(rates, period, noise, now)
    error, rate, disturbance = estimates(position, velocity)
    if stiff:
        command = -rates.gains[2] * rate - rates.force_gain * now["sum"] - disturbance
        after["sum"] = now["sum"] - period * pressed
    else:
        gains = rates.gains
        command = -gains[0] * now["sum"] - gains[1] * error - gains[2] * rate - disturbance
        after["sum"] = now["sum"] + period * error
    pending = [now[f"held{i}"] for i in range(direction.delay)] + [command]
    acts = pending[0]
    for i in range(direction.delay):
        after[f"held{i}"] = pending[i + 1]

    # The motion over the sample, exact for what is held.
    push = mass * acts + now["held"]
    w = (mass * stiff) ** 0.5
    c, s = np.cos(w * period), np.sinc(w * period / np.pi) * period
    half = (1.0 - c) / w**2 if w else period**2 / 2.0
    after["e"] = c * now["e"] + s * now["v"] + half * push
    after["v"] = -(w**2) * s * now["e"] + c * now["v"] + s * push
    mean = -stiff * (now["e"] + after["e"]) / 2.0 if stiff else 0.0 * push
    mean = mean + direction.mobility * noise.force * now["force"] * bool(stiff)
    after |= update(position, velocity, acts + mean)
    force = -direction.stiffness * now["e"] if stiff else now["e"]
    return after, (force, command)


_filter = lru_cache(maxsize=256)(ChainFilter.of)
"""The same filter serves all masses and stiffnesses."""

Known = Callable[[FloatArray, FloatArray], tuple[FloatArray, ...]]
Update = Callable[[FloatArray, FloatArray, FloatArray], Rows]


def _observed(
    rates: DirectionGains, period: float, noise: SensorNoise, now: Rows
) -> tuple[Known, Update]:
    """With exact velocities: the estimates that the law reads, and the next state."""
    gain = -np.expm1(-rates.observer_rate * period)

    def estimates(position: FloatArray, velocity: FloatArray) -> tuple[FloatArray, ...]:
        return position, velocity, now["r"]

    def update(position: FloatArray, velocity: FloatArray, acted: FloatArray) -> Rows:
        d = (velocity - now["before"]) / period - now["acted"]
        return {"r": now["r"] + gain * (d - now["r"]), "before": velocity, "acted": acted}

    return estimates, update


def _estimated(
    rates: DirectionGains, period: float, noise: SensorNoise, now: Rows
) -> tuple[Known, Update]:
    """With a state_rate: the same; q, w and a are the prediction."""
    ratio = noise.velocity / noise.position if noise.velocity and noise.position else None
    assert rates.state_rate is not None
    observer = _filter(rates.state_rate, rates.observer_rate, period, ratio)
    ahead = np.array([now["q"], now["w"], now["a"]])

    def corrected(position: FloatArray, velocity: FloatArray) -> FloatArray:
        measured = np.array([position, velocity][: observer.gain.shape[1]])
        result: FloatArray = ahead + observer.gain @ (measured - ahead[: len(measured)])
        return result

    def estimates(position: FloatArray, velocity: FloatArray) -> tuple[FloatArray, ...]:
        return tuple(corrected(position, velocity))

    def update(position: FloatArray, velocity: FloatArray, acted: FloatArray) -> Rows:
        q, w, a = transition(period) @ corrected(position, velocity)
        return {"q": q + period**2 / 2.0 * acted, "w": w + period * acted, "a": a}

    return estimates, update
