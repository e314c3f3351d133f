"""The computations of a `DisturbanceObserver` at its samples, as traced functions."""

from dataclasses import dataclass
from typing import Self

import casadi as ca
import numpy as np

from drake_dae.dae import Lags, TrackingLaw
from drake_dae.dae.beyond.friction_share import beside, shares
from drake_dae.errors import ModelError
from drake_dae.systems.observing.observed import ContactTerms, Observed, disturbance_degree
from drake_dae.systems.observing.observer_rates import Observing
from drake_dae.systems.observing.parameter_filter import ParameterFilter, Sampled
from drake_dae.trace.functions import TracedFunction

BREAK_RATE = 12.0
"""The rate in 1/s at which a coefficient of friction rises until its contact breaks away."""

STICKS = 0.5
"""A contact sticks below this share of the wanted speed."""

LEAST_SHARE = 0.06
"""The least wanted speed for which this is tested, relative to `Observing.least_speed`."""

EARLY = 2.0
"""The number of samples that the first value of a coefficient counts for."""


@dataclass(frozen=True, eq=False)
class ObserverMemory:
    """The discrete state of an observer, as columns that are stacked.

    Attributes:
        disturbance: r, shape (k,).
        friction: mu, shape (c,).
        rates: r', ..., r^(n), shape (n k,).
        lags: The inputs of the lags before r, shape (n k,).
        momentum, drift, control: p, its rate without inputs, and u of the sample before.
        has_sample: 0 before the first sample, then 1, shape (1,).
        experience: The samples for which each contact slides, while they are few, shape (c,).
        filter: The state of the `ParameterFilter`.
        identified: The part of it that are parameters, without the coefficients of friction.
    """

    disturbance: ca.SX
    friction: ca.SX
    rates: ca.SX
    lags: ca.SX
    momentum: ca.SX
    drift: ca.SX
    control: ca.SX
    has_sample: ca.SX
    experience: ca.SX
    filter: ca.SX
    identified: ca.SX

    @classmethod
    def of(
        cls, size: int, frictions: int, degree: int, controls: int, filtered: ca.SX, known: int
    ) -> Self:
        """Symbols for given sizes of r, mu and u, and a given number of derivatives of r."""
        chain = degree * size
        sizes = (size, frictions, chain, chain, size, size, controls, 1, frictions)
        symbols = [ca.SX.sym("held", count) for count in sizes]
        return cls(*[*symbols, filtered, filtered[:known]])

    @property
    def column(self) -> ca.SX:
        """The whole state as one column."""
        return ca.vertcat(*(part for name, part in vars(self).items() if name != "identified"))


class ObserverFunctions(Observed):
    """The functions of a `DisturbanceObserver`, whose class has the equations.

    Attributes:
        memory: The symbols of the discrete state.
        sample: (x, held, u, v, hold, R, parameters) -> the discrete state after a sample.
        exogenous: (x, held, v, R, parameters) -> the disturbance to compensate, mu, and their
            derivatives.

    Args:
        law, observing, is_ideal: The arguments of the observer.
        period, lag, delay: Its `sample_period`, `control_lag` and `control_delay`.

    Raises:
        ModelError: The law's system has no disturbance.
    """

    def __init__(
        self,
        law: TrackingLaw,
        observing: Observing,
        period: float,
        lag: float,
        delay: float,
        is_ideal: bool,
    ) -> None:
        super().__init__(law, observing, period, is_ideal)
        self._lag, self._delay, self._reference_size = lag, delay, law.layout.reference_size
        rates = observing.rate, observing.force_rate or observing.rate
        degree, size = disturbance_degree(law), len(self.observation.rows)
        self._lags = [Lags.of(rate, period, degree) for rate in rates]
        frictions = len(self.observation.frictions)
        identified, controls = self.observation.identified, law.system.num_controls
        known = identified.low.size
        if known and degree:
            raise ModelError(
                f"{law.system.name}: parameters are estimated for rigid joints; behind springs "
                "and motors only coefficients of friction are"
            )
        values = law.system.parameter_values
        start = (
            values[self._places],
            *(values[law.system.parameter_slice(name)] for name in self.observation.frictions),
        )
        self.filter = ParameterFilter(
            identified,
            np.concatenate(start) if known else np.zeros(0),
            observing.largest_friction,
            size,
            rates[0],
            period,
        )
        column = self.filter.memory.column
        self.memory = memory = ObserverMemory.of(size, frictions, degree, controls, column, known)
        self.sample = self._sampled(ca.SX.sym("hold", 1))
        self.exogenous = self.compensated(law, delay, memory.column, memory)

    def _sampled(self, held_up: ca.SX) -> TracedFunction:
        """The discrete state after a sample."""
        observation, memory = self.observation, self.memory
        x, v, size = self._system.state, self._force, len(observation.rows)
        u = ca.SX.sym("control", self._system.num_controls)
        r, mu, late = memory.disturbance, memory.friction, self._lag * memory.has_sample
        parameters = self._parameters(ca.SX.zeros(mu.numel()), memory.identified)
        acted = late * memory.control + (1.0 - late) * u
        momentum = observation.momentum.function(x, acted, v, parameters)
        contact = self.contact(x, parameters)
        reference = ca.SX.sym("reference", self._reference_size)
        p, drift, inputs = momentum[:3]
        hold = ca.ne(held_up, 0)
        d = (p - memory.momentum) / self._period - (memory.drift + drift) / 2.0 - inputs
        d -= ca.mtimes(contact.friction, mu)

        # Each lag is a column. A sticking contact may hide forces, so these do not enter.
        fast, slow = self._lags
        chain = self._passed(contact, ca.horzcat(ca.reshape(memory.lags, size, fast.degree), r), d)

        # Friction, or all parameters, take their share of r.
        if self.observation.identified.parameters:
            sample = self._slopes(x, acted, v, parameters, contact, hold)
            before = ca.reshape(memory.filter[self.filter.memory.parts["regressor"]], size, -1)
            regressor = self.filter.regressor(sample)
            columns = zip(ca.horzsplit(before), ca.horzsplit(regressor), strict=True)
            regressor = ca.horzcat(*(self._passed(contact, *pair) for pair in columns))
            is_first = 1.0 - memory.has_sample
            filtered, moved = self.filter.after(sample, regressor, chain[:, -1], mu, is_first)
            known = memory.identified.numel()
            change = moved[known : known + mu.numel()]
            chain -= ca.mtimes(regressor, moved)
            p += ca.mtimes(sample.momentum, moved[:known])
            drift += ca.mtimes(sample.drift, moved[:known])
        else:
            filtered = ca.SX(0, 1)
            change = self.change(contact, mu, chain[:, -1], hold)
            chain -= ca.repmat(ca.mtimes(contact.friction, change), 1, chain.shape[1])
        early, experience = self._early(contact, x, v, reference, parameters, d, hold)
        change = ca.fmin(ca.fmax(mu + change + early, 0.0), self._observing.largest_friction) - mu
        moves = ca.mtimes(contact.free, chain)
        rates = fast.derivatives(moves) + slow.derivatives(chain - moves)
        lags = ca.vec(chain[:, :-1])
        after = [
            chain[:, -1],
            mu + change,
            ca.vec(rates),
            lags,
            p,
            drift,
            u,
            1.0,
            experience,
            filtered,
        ]
        # A value that is not finite may be hidden by a limit.
        valid = momentum[-1] + contact.valid
        return self._system.trace(
            "sample of the observer",
            {"held": ca.vertcat(*after), "valid": valid},
            {
                "held": memory.column,
                "control": u,
                "constraint_input": v,
                "hold": held_up,
                "reference": reference,
            },
        )

    def _early(
        self,
        contact: ContactTerms,
        x: ca.SX,
        v: ca.SX,
        reference: ca.SX,
        parameters: ca.SX,
        d: ca.SX,
        hold: ca.SX,
    ) -> tuple[ca.SX, ca.SX]:
        """The change of friction at the first break-away, and the samples of sliding after it.

        While a contact sticks where it should slide, its coefficient rises with `BREAK_RATE`, so
        that it breaks away before the reference is far. Then samples of d are averaged, without a
        low-pass, until `friction_rate` is faster. Not with a law that needs derivatives of d.
        """
        memory, observation = self.memory, self.observation
        if observation.wanted is None or memory.rates.numel():  # Springs answer jumps by swings.
            return 0.0 * memory.friction, memory.experience
        goal = observation.wanted.function(x, reference, self._delay, parameters)[0]
        wanted, actual = (
            observation.friction.function(state, v, parameters)[1] for state in (goal, x)
        )
        least = LEAST_SHARE * self._observing.least_speed
        follows = actual >= STICKS * wanted
        weight = 1.0 / (memory.experience + EARLY)
        is_early = weight > EARLY * self._observing.friction_rate * self._period
        used = is_early * (wanted > least) * ca.logic_not(ca.logic_or(self._is_lost, hold))
        slides = used * follows * (actual > least)
        terms = contact.friction, contact.planes, contact.velocity, contact.metric
        change = slides * weight * shares(*terms, d)
        change += used * ca.logic_not(follows) * BREAK_RATE * self._period
        return change, memory.experience + slides

    def _passed(self, contact: ContactTerms, chain: ca.SX, signal: ca.SX) -> ca.SX:
        """The lags of a signal after a sample; what a sticking contact may hide does not enter."""
        by_fast, by_slow = (
            beside(
                contact.held,
                contact.metric,
                self.memory.has_sample * (lags.after(chain, signal) - chain),
            )
            for lags in self._lags
        )
        return chain + by_slow + ca.mtimes(contact.free, by_fast - by_slow)

    def _slopes(
        self, x: ca.SX, u: ca.SX, v: ca.SX, parameters: ca.SX, contact: ContactTerms, hold: ca.SX
    ) -> Sampled:
        """The sample of the functions of the filter."""
        identified, rows = self.observation.identified, list(self.observation.rows)
        slopes = identified.slopes.function(x, u, v, parameters)
        forces = v[list(identified.pressed), :]
        mass = self._system.mass_matrix[rows, rows]
        inertia = ca.diag(ca.substitute(mass, self._system.parameter_symbol, parameters))
        sliding = ca.mtimes(contact.friction, ca.diag(contact.slides))
        is_closed = forces >= self._observing.least_force
        momentum, drift, inputs, gaps, gap_slopes, gap_bends = slopes[:6]
        known = momentum, drift, inputs, sliding, gaps, gap_slopes, gap_bends
        return Sampled(*known, forces, is_closed, inertia, hold)
