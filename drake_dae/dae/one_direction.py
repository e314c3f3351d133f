"""The sampled loop of a law in one direction, as a linear system driven by noise."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from drake_dae.arrays import FloatArray
from drake_dae.dae.disturbance import filter_gain, transition


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
class DirectionGains:
    """The gains of a law and its observer in a direction, in 1/s.

    `gains` are those of the integral of the error, of the error and of its derivative; along a
    contact only the last is used, the damping c. `state_rate` is that of a `StateEstimator`.
    """

    gains: tuple[float, float, float]
    force_gain: float
    observer_rate: float
    state_rate: float | None = None


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


def sampled_loop(
    rates: DirectionGains,
    noise: SensorNoise,
    period: float,
    delay: int,
    mobility: float = 1.0,
    stiffness: float = 0.0,
    mass_error: float = 1.0,
) -> SampledLoop:
    """Returns the loop of a law in one direction, sampled each `period` seconds and delayed.

    In a free direction the error moves as e'' = m a + d, where a is the acceleration that the law
    commands, held for a sample after its delay of some samples, and m the mass_error: what a force
    accelerates, relative to the law's model. In a contact of the stiffness k the depth moves as
    phi'' = m (a - A k phi) + d, and the law measures the force -k phi. With the estimates e, e' and
    d of observer or estimator the law commands

        a = -K_1 sigma - K_2 e - K_3 e' - d            free,
        a = -c phi' - A K_i sigma_F - d                in a contact,

    with the sums sigma of the error and sigma_F of the force's error.

    If samples are fast, white noise n of free positions leaves with the estimator's gains l_1 to
    l_3 for q, v and a, whose poles are the roots of D = s^3 + l_1 s^2 + l_2 s + l_3,

        e = -(l_3 s^3 + K_3 s^2 (l_2 s + l_3) + (K_2 s + K_1) (l_1 s^2 + l_2 s + l_3)) n / (P D),

    P = s^3 + K_3 s^2 + K_2 s + K_1, of the variance T sigma_n^2 / (2 pi) int |e/n|^2 dw.
    """
    T, mass, A, stiff = period, mass_error, mobility, mobility * stiffness
    K_1, K_2, K_3 = rates.gains
    held = [f"held{i}" for i in range(delay)]
    parts = ["e", "v", "sum", *held]
    parts += ["q", "w", "a"] if rates.state_rate else ["r", "before", "acted"]
    parts += ["difference", "measured"] if noise.velocity_bandwidth else []
    # Each quantity is a row of its dependence on the state, the three noises and the disturbance.
    size, count = len(parts), len(parts) + 3
    names = [*parts, "position", "velocity", "force", "push"]
    now = dict(zip(names, np.eye(count + 1), strict=True))
    after = dict(now)

    # What is measured.
    position = now["e"] + noise.position * now["position"]
    velocity = now["v"] + noise.velocity * now["velocity"]
    if noise.velocity_bandwidth:
        kept = np.exp(-noise.velocity_bandwidth * T)
        velocity = kept * now["difference"] + (1.0 - kept) / T * (position - now["measured"])
        after |= {"difference": velocity, "measured": position}
    felt = bool(stiff) * A * noise.force * now["force"]

    # The estimates of e, e' and d: by the estimator, or by the observer, with exact velocities.
    error, rate, disturbance = position, velocity, now["r" if "r" in now else "a"]
    if rates.state_rate:
        ratio = noise.velocity / noise.position if noise.velocity and noise.position else None
        gain = _filter(rates.state_rate, rates.observer_rate, T, ratio)
        ahead = np.array([now["q"], now["w"], now["a"]])
        new = np.array([position, velocity])[: gain.shape[1]] - ahead[: gain.shape[1]]
        error, rate, disturbance = estimated = ahead + gain @ new

    # The law, and the motion over the sample, exact for what is held.
    if stiff:
        command = -K_3 * rate - rates.force_gain * now["sum"] - disturbance
        after["sum"] = now["sum"] + T * (stiff * now["e"] - felt)
    else:
        command = -K_1 * now["sum"] - K_2 * error - K_3 * rate - disturbance
        after["sum"] = now["sum"] + T * error
    acts, *after_held = [*(now[name] for name in held), command]
    after |= dict(zip(held, after_held, strict=True))
    w, push = (mass * stiff) ** 0.5, mass * acts + now["push"]
    c, s = np.cos(w * T), np.sinc(w * T / np.pi) * T
    half = (1.0 - c) / w**2 if w else T**2 / 2.0
    after["e"] = c * now["e"] + s * now["v"] + half * push
    after["v"] = -(w**2) * s * now["e"] + c * now["v"] + s * push

    # What the model expects to follow: of a contact with the mean force.
    acted = acts - stiff * (now["e"] + after["e"]) / 2.0 + felt
    if rates.state_rate:
        predicted = transition(T) @ estimated + np.outer([T**2 / 2.0, T, 0.0], acted)
        after |= dict(zip(["q", "w", "a"], predicted, strict=True))
    else:
        d = (velocity - now["before"]) / T - now["acted"]
        after["r"] = now["r"] - np.expm1(-rates.observer_rate * T) * (d - now["r"])
        after |= {"before": velocity, "acted": acted}

    # In units of e, e / T and e / T^2, so that all parts are of one size.
    orders = {"e": 0, "q": 0, "measured": 0, "v": 1, "w": 1, "before": 1, "difference": 1}
    orders["sum"] = 1 if stiff else -1
    units = T ** np.array([orders.get(name, 2) for name in parts])
    both = np.array([after[name] for name in parts]) * units[:, None]
    shown = np.array([-stiffness * now["e"] if stiff else now["e"], command])[:, :count]
    both[:, :size] /= units
    shown[:, :size] /= units
    return SampledLoop(both[:, :size], both[:, size:count], shown, both[:, count], T)


_filter = lru_cache(maxsize=256)(filter_gain)
"""The same filter serves all masses and stiffnesses."""
