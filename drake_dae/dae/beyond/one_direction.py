"""The sampled loop of a law in one direction, as a linear system driven by noise, and its gains."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from drake_dae.arrays import FloatArray
from drake_dae.dae.beyond.chain_filter import ChainFilter, transition


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


@dataclass(frozen=True)
class DirectionLoop:
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


def sampled_loop(direction: Direction, rates: DirectionGains, noise: SensorNoise) -> DirectionLoop:
    """Returns the loop of a law whose model is right, except for the `mass_error`.

    In a free direction the error moves as e'' = m a + d, where a is the acceleration that the law
    commands, held for a sample after its delay, and m the mass_error. In a contact the depth moves
    as phi'' = m (a - A k phi) + d, and the law measures the force -k phi. With the estimates
    e, e' and d of observer or estimator the law commands

        a = -K_1 sigma - K_2 e - K_3 e' - d            free,
        a = -c phi' - A K_i sigma_F - d                in a contact,

    with the sums sigma of the error and sigma_F of the force's error.
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
    return DirectionLoop(
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


PHASE = 0.3
"""The phase in rad that sampling and delay cost at the crossover with the fastest gains of a
contact; the fastest free directions are twice as fast."""

MODEL_ERROR, EVERY = 1.0, 2.0
"""An unknown force of 1 N appears or turns every 2 s."""

RAMP = 10.0
"""The reference of a force changes by 10 N/s."""

_RATES = np.geomspace(1.0, 1.0 / 120.0, 20).tolist()
"""The rates that are tried, relative to the fastest."""

_STATE_RATES = (2.0, 4.0, 7.0, 12.0, 20.0)
"""The rates of an estimate of the state that are tried, relative to half of the fastest."""


@dataclass(frozen=True)
class SensedContact:
    """The numbers of a robot in contact, its sampling and its sensors that decide its gains.

    Attributes:
        period, delay: T in s, and the delay of the control in samples.
        stiffness: k of the contact in N/m.
        mobility, free_mobility: J M^-1 J^T of the contact, and of points on a path, in 1/kg.
        lever, contact_lever: The displacement of such a point, and of the contact, per radian of
            noise of all joints: the length of a row of J, in m/rad.
        inertia: sqrt(tr M M): the torque per acceleration of all joints, in kg m^2.
        noise: That of a joint's angle and velocity, in rad and rad/s, and of the force in N.
        estimates: Whether the state is estimated from positions.
        leads: Whether the law knows the deflection of a force that changes.
    """

    period: float
    delay: int
    stiffness: float
    mobility: float
    free_mobility: float
    lever: float
    contact_lever: float
    inertia: float
    noise: SensorNoise
    estimates: bool
    leads: bool = False

    def of(self, lever: float) -> SensorNoise:
        """The noise of a distance that is computed from noisy angles."""
        noise = self.noise
        position, velocity = lever * noise.position, lever * noise.velocity
        return replace(noise, position=position, velocity=velocity)


@dataclass(frozen=True)
class Part:
    """One direction: its rate w and gains, the error in m or N, and the roughness in N m."""

    rate: float
    gains: DirectionGains
    error: float
    roughness: float


def direction_gains(situation: SensedContact, roughness: float) -> tuple[Part, Part]:
    """The gains of free directions and of the contact with the least errors, each for itself.

    Free directions have Butterworth's poles at p = 1.5 w and the estimator's rate 2 w; a contact
    the damping c = 2.3 w, at most 2 sqrt(A k), the integral 0.4 c and the estimator's rate w. The
    product of both rms errors is least, by noise and by `MODEL_ERROR`, among those that change the
    controls by `roughness` from sample to sample at most; and where all are rougher, the roughness.
    Nothing here knows of friction, tilt and posture: see `contact_gains`.
    """
    highest = PHASE / (3.0 * (situation.delay + 0.5) * situation.period)
    fast: list[float | None] = [None]
    if situation.estimates:
        most = 0.5 / situation.period
        fast = [rate for share in _STATE_RATES if (rate := share * highest / 2.0) <= most]
    pairs = []
    for state_rate in fast:
        free = _best(
            [_free(situation, 2.0 * share * highest, state_rate) for share in _RATES], roughness
        )
        most = max(roughness**2 - free.roughness**2, 0.5 * roughness**2) ** 0.5
        contact = [_contact(situation, share * highest, state_rate) for share in _RATES]
        pairs.append((free, _best(contact, most)))

    def order(pair: tuple[Part, Part]) -> tuple[float, float]:
        total = float(np.hypot(pair[0].roughness, pair[1].roughness))
        return max(total / roughness, 1.5), pair[0].error * pair[1].error

    return min(pairs, key=order)


def _best(parts: list[Part], roughness: float) -> Part:
    smooth = [part for part in parts if part.roughness <= roughness]
    if not smooth:
        return min(parts, key=lambda part: part.roughness)
    return min(smooth, key=lambda part: part.error)


def _free(situation: SensedContact, w: float, state_rate: float | None) -> Part:
    p, direction = 1.5 * w, Direction(situation.period, situation.delay)
    gains = DirectionGains((p**3, 2.0 * p**2, 2.0 * p), 0.0, 2.0 * w, state_rate)
    loop = sampled_loop(direction, gains, situation.of(situation.lever))
    by_noise, _ = loop.deviations()
    _, jump = sampled_loop(direction, gains, situation.of(1.0)).deviations()
    by_force = MODEL_ERROR * situation.free_mobility * _rms(loop)
    return Part(w, gains, float(np.hypot(by_noise, by_force)), situation.inertia * jump)


def _contact(situation: SensedContact, w: float, state_rate: float | None) -> Part:
    A, k = situation.mobility, situation.stiffness
    c = min(2.3 * w, 2.0 * (A * k) ** 0.5)
    gains = DirectionGains((0.0, 0.0, c), 0.4 * c, w, state_rate)
    direction = Direction(situation.period, situation.delay, A, k)
    loop = sampled_loop(direction, gains, situation.of(situation.contact_lever))
    by_noise, jump = loop.deviations()
    ramp = 0.0 if situation.leads else c * RAMP / (A * k)
    errors = by_noise, MODEL_ERROR * A * _rms(loop), ramp
    return Part(w, gains, float(np.linalg.norm(errors)), situation.contact_lever * jump / A)


def _rms(loop: DirectionLoop) -> float:
    """The rms error per disturbing acceleration that appears every `EVERY` seconds."""
    return loop.after_step() * float(np.sqrt(loop.period / EVERY))
