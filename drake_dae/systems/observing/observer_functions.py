"""The computations of a `DisturbanceObserver` at its samples, as traced functions."""

from dataclasses import dataclass
from typing import Self

import casadi as ca

from drake_dae.dae.beyond.disturbance import beside
from drake_dae.dae.beyond.lags import Lags
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.systems.observing.observed import Observed
from drake_dae.systems.observing.observer_rates import Observing
from drake_dae.trace.functions import TracedFunction


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
    """

    disturbance: ca.SX
    friction: ca.SX
    rates: ca.SX
    lags: ca.SX
    momentum: ca.SX
    drift: ca.SX
    control: ca.SX
    has_sample: ca.SX

    @classmethod
    def of(cls, size: int, frictions: int, degree: int, controls: int) -> Self:
        """Symbols for given sizes of r, mu and u, and a given number of derivatives of r."""
        chain = degree * size
        sizes = (size, frictions, chain, chain, size, size, controls, 1)
        return cls(*(ca.SX.sym("held", count) for count in sizes))

    @property
    def column(self) -> ca.SX:
        """The whole state as one column."""
        return ca.vertcat(*vars(self).values())


class ObserverFunctions(Observed):
    """The functions of a `DisturbanceObserver`, whose class has the equations.

    Attributes:
        memory: The symbols of the discrete state.
        sample: (x, held, u, v, hold, parameters) -> the discrete state after a sample.
        exogenous: (x, held, v, R, parameters) -> the disturbance to compensate, mu, and their
            derivatives.

    Args:
        law, observing: The arguments of the observer.
        period, lag, delay: Its `sample_period`, `control_lag` and `control_delay`.

    Raises:
        ModelError: The law's system has no disturbance.
    """

    def __init__(
        self, law: TrackingLaw, observing: Observing, period: float, lag: float, delay: float
    ) -> None:
        super().__init__(law, observing, period)
        self._lag = lag
        rates = observing.rate, observing.force_rate or observing.rate
        degree, size = max(law.exogenous_degrees), len(self.observation.rows)
        self._lags = [Lags.of(rate, period, degree) for rate in rates]
        frictions = len(self.observation.frictions)
        self.memory = memory = ObserverMemory.of(size, frictions, degree, law.system.num_controls)
        self.sample = self._sampled(ca.SX.sym("hold", 1))
        self.exogenous = self.compensated(law, delay, memory.column, memory)

    def _sampled(self, hold: ca.SX) -> TracedFunction:
        """The discrete state after a sample."""
        observation, memory = self.observation, self.memory
        x, v, size = self._system.state, self._force, len(observation.rows)
        u = ca.SX.sym("control", self._system.num_controls)
        r, mu, late = memory.disturbance, memory.friction, self._lag * memory.has_sample
        parameters = self._parameters(ca.SX.zeros(mu.numel()))
        acted = late * memory.control + (1.0 - late) * u
        momentum = observation.momentum.function(x, acted, v, parameters)
        contact = self.contact(x, parameters)
        p, drift, inputs = momentum[:3]
        d = (p - memory.momentum) / self._period - (memory.drift + drift) / 2.0 - inputs
        d -= ca.mtimes(contact.friction, mu)

        # Each lag is a column. A sticking contact may hide forces, so these do not enter.
        fast, slow = self._lags
        chain = ca.horzcat(ca.reshape(memory.lags, size, fast.degree), r)
        by_fast, by_slow = (
            beside(contact.held, contact.metric, memory.has_sample * (lags.after(chain, d) - chain))
            for lags in (fast, slow)
        )
        chain += by_slow + ca.mtimes(contact.free, by_fast - by_slow)

        # Friction takes its share of r.
        change = self.change(contact, mu, chain[:, -1], hold)
        chain -= ca.repmat(ca.mtimes(contact.friction, change), 1, chain.shape[1])
        moves = ca.mtimes(contact.free, chain)
        rates = fast.derivatives(moves) + slow.derivatives(chain - moves)
        after = [chain[:, -1], mu + change, ca.vec(rates), ca.vec(chain[:, :-1]), p, drift, u, 1.0]
        # A value that is not finite may be hidden by a limit.
        valid = momentum[-1] + contact.valid
        return self._system.trace(
            "sample of the observer",
            {"held": ca.vertcat(*after), "valid": valid},
            {"held": memory.column, "control": u, "constraint_input": v, "hold": hold},
        )
