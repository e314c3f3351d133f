"""What an observer of disturbances computes at its samples, as traced functions."""

from dataclasses import dataclass
from typing import Self

import casadi as ca
import numpy as np

from drake_dae.dae.beyond.disturbance import DISTURBANCE, Observation, beside, shares
from drake_dae.dae.beyond.lags import Lags
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.systems.control.observer_rates import Observing
from drake_dae.trace.functions import TracedFunction

_SHARP = 10.0
"""Friction here is that of a motion so many times as fast: full from v_s / 10 on."""


@dataclass(frozen=True, eq=False)
class Memory:
    """What an observer holds between samples, as columns that stand below each other.

    Attributes:
        disturbance: r, shape (k,).
        friction: mu, shape (c,).
        rates: r', ..., r^(n), shape (n k,).
        lags: What r lags behind, shape (n k,).
        momentum, drift, control: p, its rate without inputs, and u of the sample before.
        seen: 0 before the first sample, then 1, shape (1,).
    """

    disturbance: ca.SX
    friction: ca.SX
    rates: ca.SX
    lags: ca.SX
    momentum: ca.SX
    drift: ca.SX
    control: ca.SX
    seen: ca.SX

    @classmethod
    def of(cls, size: int, frictions: int, degree: int, controls: int) -> Self:
        """Symbols, where r, mu and u have so many entries, and r has so many derivatives."""
        chain = degree * size
        sizes = (size, frictions, chain, chain, size, size, controls, 1)
        return cls(*(ca.SX.sym("held", each) for each in sizes))

    @property
    def column(self) -> ca.SX:
        """All of it."""
        return ca.vertcat(*vars(self).values())


class ObserverFunctions:
    """The functions of a `DisturbanceObserver`, whose class has the equations.

    Attributes:
        observation: What is observed.
        memory: What is held between samples.
        sample: (x, held, u, v, hold, parameters) -> what is held after a sample.
        exogenous: (x, held, v, R, parameters) -> what to cancel, mu, and their derivatives.
        hold: (v, hold) -> 1 where integrals stand still, else 0.

    Args:
        law, observing: As of the observer.
        period, lag, delay: Its `sample_period`, `control_lag` and `control_delay`.

    Raises:
        ModelError: The law's system has no disturbance.
    """

    def __init__(
        self, law: TrackingLaw, observing: Observing, period: float, lag: float, delay: float
    ) -> None:
        self.observation = found = Observation.of(law.structure)
        system, self._observing = law.system, observing
        self._system, self._period, self._lag = system, period, lag
        rates = observing.rate, observing.force_rate or observing.rate
        degree, size = max(law.exogenous_degrees), len(found.rows)
        self._lags = [Lags.of(rate, period, degree) for rate in rates]
        self.memory = Memory.of(size, len(found.frictions), degree, system.num_controls)
        self._force = ca.SX.sym("constraint_input", system.num_constraints)
        pressed = [self._force[i] for i in found.frictions.values()]
        self._is_lost = ca.vertcat(ca.SX(0, 1), *pressed) < observing.least_force
        hold = ca.SX.sym("hold", 1)
        self.sample = self._sampled(hold)
        self.exogenous = self._exogenous_function(law, delay)
        holds = ca.fmax(hold != 0, ca.mmax(self._is_lost) if pressed else 0)
        self.hold = TracedFunction(
            "hold", {"constraint_input": self._force, "hold": hold}, {"hold": holds}
        )

    def _parameters(self, friction: ca.SX) -> ca.SX:
        """The model's parameters with other coefficients of friction."""
        found, system = ca.SX(self._system.parameter_symbol), self._system
        for j, name in enumerate(self.observation.frictions):
            found[system.parameter_slice(name)] = friction[j]
        return found

    def _sampled(self, hold: ca.SX) -> TracedFunction:
        """What is held after a sample."""
        observation, observing, memory = self.observation, self._observing, self.memory
        x, v, size = self._system.state, self._force, len(observation.rows)
        u = ca.SX.sym("control", self._system.num_controls)
        r, mu, late = memory.disturbance, memory.friction, self._lag * memory.seen
        parameters = self._parameters(ca.SX.zeros(mu.numel()))
        acted = late * memory.control + (1.0 - late) * u
        momentum = observation.momentum.function(x, acted, v, parameters)
        of_friction = observation.friction.function(_faster(observation, x), v, parameters)
        directions = observation.directions.function(x, v, parameters)
        (p, drift, inputs), (frictional, speeds) = momentum[:3], of_friction[:2]
        metric, free, planes = directions[:3]
        d = (p - memory.momentum) / self._period - (memory.drift + drift) / 2.0 - inputs
        d -= ca.mtimes(frictional, mu)

        # Each lag is a column. What a contact that sticks may hold is not believed.
        fast, slow = self._lags
        chain = ca.horzcat(ca.reshape(memory.lags, size, fast.degree), r)
        is_slow = speeds < _SHARP * observing.least_speed
        sticks = ca.logic_and(is_slow, ca.logic_not(self._is_lost))
        held = planes * ca.repmat(ca.vec(ca.repmat(sticks.T, size, 1)).T, size, 1)
        by_fast, by_slow = (
            beside(held, metric, memory.seen * (lags.after(chain, d) - chain))
            for lags in (fast, slow)
        )
        chain += by_slow + ca.mtimes(free, by_fast - by_slow)

        # Friction takes its share of it.
        gain = -np.expm1(-observing.friction_rate * self._period)
        is_sure = ca.logic_not(ca.logic_or(is_slow, self._is_lost))
        velocity = x[list(observation.rows)]
        share = shares(frictional, planes, velocity, metric, chain[:, -1])
        found = mu + is_sure * gain * share
        found = ca.fmin(ca.fmax(found, 0.0), observing.largest_friction)
        change = ca.if_else(hold != 0, 0, found - mu)
        chain -= ca.repmat(ca.mtimes(frictional, change), 1, chain.shape[1])
        moves = ca.mtimes(free, chain)
        rates = fast.derivatives(moves) + slow.derivatives(chain - moves)
        after = [chain[:, -1], mu + change, ca.vec(rates), ca.vec(chain[:, :-1]), p, drift, u, 1.0]
        # What is not finite may end at a limit.
        valid = momentum[-1] + of_friction[-1] + directions[-1]
        return self._system.trace(
            "sample of the observer",
            {"held": ca.vertcat(*after), "valid": valid},
            {"held": memory.column, "control": u, "constraint_input": v, "hold": hold},
        )

    def _exogenous_function(self, law: TrackingLaw, delay: float) -> TracedFunction:
        """The output of the port `exogenous`: disturbance, coefficients and their derivatives."""
        observation, memory = self.observation, self.memory
        x, v, mu = self._system.state, self._force, memory.friction
        reference = ca.SX.sym("reference", law.layout.reference_size)
        parameters, r, pivot = self._parameters(mu), memory.disturbance, None
        if mu.numel():
            goal = x
            if observation.wanted is not None:
                wanted = observation.wanted.function(x, reference, delay, parameters)
                goal, pivot = wanted[:2]
            own, goes = (
                observation.friction.function(each, v, parameters)[0]
                for each in (x, _faster(observation, goal))
            )
            r = r + ca.mtimes(goes - own, mu)
        size = r.numel()
        rows = {DISTURBANCE: [[r[i], *memory.rates[i::size].elements()] for i in range(size)]}
        zeros = [ca.SX(0.0)] * self._lags[0].degree
        for j, name in enumerate(observation.frictions):
            rows[name] = [[mu[j], *zeros]]
        stacked, left = list[ca.SX](), iter(law.exogenous_degrees)
        for p in self._system.exogenous.moving:
            for row in rows[p.name]:
                stacked += row[: 1 + next(left)]
        return self._system.trace(
            "exogenous signals of the observer",
            {"exogenous": ca.vertcat(*stacked)},
            {"held": memory.column, "constraint_input": v, "reference": reference},
            pivot,
        )


def _faster(observation: Observation, state: ca.SX) -> ca.SX:
    """The state in a motion that is so fast that friction is full."""
    found, rows = ca.SX(state), list(observation.rows)
    found[rows] = _SHARP * found[rows]
    return found
