"""The functions that all observers share: the part of friction, and the signals for the law."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Protocol

import casadi as ca
import numpy as np

from drake_dae.dae import Observation, TrackingLaw
from drake_dae.dae.beyond.disturbance import DISTURBANCE
from drake_dae.dae.beyond.friction_share import Metric, shares
from drake_dae.systems.observing.observer_rates import Observing
from drake_dae.trace.functions import TracedFunction

_SHARP = 10.0
"""Friction of a contact that gives way is taken as that of a motion faster by this factor: it is
fully developed from v_s / 10 on. An ideal contact has the friction of the model."""


class Estimates(Protocol):
    """The estimates of an observer, as columns of expressions.

    Attributes:
        disturbance: r, shape (k,).
        friction: mu, shape (c,).
        rates: r', ..., r^(n), shape (n k,).
        identified: Estimates of other parameters, shape (c,).
    """

    @property
    def disturbance(self) -> ca.SX: ...

    @property
    def friction(self) -> ca.SX: ...

    @property
    def rates(self) -> ca.SX: ...

    @property
    def identified(self) -> ca.SX: ...


def disturbance_degree(law: TrackingLaw) -> int:
    """The number of derivatives of the disturbance that a law needs."""
    degrees = iter(law.exogenous_degrees)
    own = {
        p.name: [next(degrees) for _ in range(p.value.size)] for p in law.system.exogenous.moving
    }
    return max(own[DISTURBANCE])


@dataclass(frozen=True, eq=False)
class ContactTerms:
    """The directions of friction and constraints at a state, as expressions.

    Attributes:
        friction: C, the friction force per unit of each coefficient, shape (k, c).
        metric: W of `Observation.metric`, as a function of columns.
        free: Q of `Observation.directions`.
        planes: T of `Observation.directions`, of each contact.
        held: T of the contacts that stick, side by side; zero for others.
        velocity: The velocities, shape (k, 1).
        slides: 1 for each contact that certainly slides, shape (c,).
        valid: Finite if all of these are valid.
    """

    friction: ca.SX
    metric: Metric
    free: ca.SX
    planes: Sequence[ca.SX]
    held: ca.SX
    velocity: ca.SX
    slides: ca.SX
    valid: ca.SX


class Observed:
    """The functions that all observers of a law's disturbance share.

    Attributes:
        observation: The observed functions.
        hold: (v, hold) -> 1 if integrals are not updated, otherwise 0.

    Args:
        law, observing: The arguments of the observer.
        period: Its sample period in s.
        is_ideal: Whether friction is that of the model at small speeds, too.

    Raises:
        ModelError: The law's system has no disturbance.
    """

    def __init__(
        self, law: TrackingLaw, observing: Observing, period: float, is_ideal: bool = False
    ) -> None:
        self._sharpness = 1.0 if is_ideal else _SHARP
        self.observation = observation = Observation.of(law.structure, law.layout)
        self._system, self._observing, self._period = law.system, observing, period
        self._stops = [0, *accumulate(observation.widths)]
        self._force = ca.SX.sym("constraint_input", law.system.num_constraints)
        entries = (law.system.parameter_slice(p.name) for p in observation.identified.parameters)
        self._places = [i for part in entries for i in range(part.start, part.stop)]
        normal_forces = [self._force[i] for i in observation.frictions.values()]
        self._is_lost = ca.vertcat(ca.SX(0, 1), *normal_forces) < observing.least_force
        hold = ca.SX.sym("hold", 1)
        holds = ca.fmax(hold != 0, ca.mmax(self._is_lost) if normal_forces else 0)
        self.hold = TracedFunction(
            "hold", {"constraint_input": self._force, "hold": hold}, {"hold": holds}
        )

    def _parameters(self, friction: ca.SX, identified: ca.SX | None = None) -> ca.SX:
        """The model's parameters with other coefficients of friction and other estimates."""
        parameters = ca.SX(self._system.parameter_symbol)
        if identified is not None:
            parameters[self._places] = identified
        for j, name in enumerate(self.observation.frictions):
            parameters[self._system.parameter_slice(name)] = friction[j]
        return parameters

    def contact(self, state: ca.SX, parameters: ca.SX) -> ContactTerms:
        """The directions of friction and constraints at a state."""
        observation = self.observation
        friction = observation.friction.function(self._faster(state), self._force, parameters)
        directions = observation.directions.function(state, self._force, parameters)
        free, planes = directions[0], ca.horzsplit(directions[1], self._stops)

        def metric(columns: ca.SX) -> ca.SX:
            function = observation.metric.function
            moved = [function(state, d, parameters)[0] for d in ca.horzsplit(columns)]
            return ca.horzcat(ca.SX(columns.shape[0], 0), *moved)

        is_slow = friction[1] < self._sharpness * self._observing.least_speed
        sticks = ca.logic_and(is_slow, ca.logic_not(self._is_lost))
        held = self._side_by_side(planes, sticks)
        slides = ca.logic_not(ca.logic_or(is_slow, self._is_lost))
        velocity, valid = state[list(observation.rows)], friction[-1] + directions[-1]
        return ContactTerms(friction[0], metric, free, planes, held, velocity, slides, valid)

    def _side_by_side(self, planes: Sequence[ca.SX], of_contacts: ca.SX) -> ca.SX:
        """T of all contacts side by side, each times its entry of a column."""
        scaled = [plane * of_contacts[j] for j, plane in enumerate(planes)]
        return ca.horzcat(ca.SX(len(self.observation.rows), 0), *scaled)

    def change(self, contact: ContactTerms, mu: ca.SX, r: ca.SX, hold: ca.SX) -> ca.SX:
        """The change of the estimate mu at a sample, by the part of r that friction explains."""
        gain = -np.expm1(-self._observing.friction_rate * self._period)
        terms = contact.friction, contact.planes, contact.velocity, contact.metric
        after = mu + contact.slides * gain * shares(*terms, r)
        after = ca.fmin(ca.fmax(after, 0.0), self._observing.largest_friction)
        return ca.if_else(hold != 0, 0, after - mu)

    def compensated(
        self, law: TrackingLaw, delay: float, held: ca.SX, estimates: Estimates
    ) -> TracedFunction:
        """The signals for the law: disturbance, coefficients of friction and their derivatives.

        Args:
            law: The law.
            delay: The mean time in s until its control acts.
            held: The symbols of the discrete state.
            estimates: The estimates in it.

        Returns:
            (x, held, v, R, parameters) -> the port `exogenous` of its controller.
        """
        observation, mu = self.observation, estimates.friction
        x, v = self._system.state, self._force
        reference = ca.SX.sym("reference", law.layout.reference_size)
        theta = estimates.identified
        parameters, r, pivot = self._parameters(mu, theta), estimates.disturbance, None
        if mu.numel() or self._system.dry:
            goal = x
            if observation.wanted is not None:
                wanted = observation.wanted.function(x, reference, delay, parameters)
                goal, pivot = wanted[:2]
            friction, goal_friction = (
                observation.friction.function(state, v, parameters)[0]
                for state in (x, self._faster(goal))
            )
            r = r + ca.mtimes(goal_friction - friction, mu)
            r = r + self._dry(goal, parameters) - self._dry(x, parameters)
        size, rates = r.numel(), estimates.rates
        rows = {DISTURBANCE: [[r[i], *rates[i::size].elements()] for i in range(size)]}
        numbers = dict(zip(observation.frictions, mu.elements(), strict=True))
        for name, value in numbers.items():
            rows[name] = [[value]]
        known = iter(theta.elements())
        for p in observation.identified.parameters:
            rows[p.name] = [[next(known)] for _ in range(p.value.size)]
        stacked, degrees = list[ca.SX](), iter(law.exogenous_degrees)
        for p in self._system.exogenous.moving:
            for row in rows[p.name]:
                degree = next(degrees)
                stacked += [*row, *[ca.SX(0.0)] * degree][: 1 + degree]  # Others are constant.
        return self._system.trace(
            "exogenous signals of the observer",
            {"exogenous": ca.vertcat(*stacked)},
            {"held": held, "constraint_input": v, "reference": reference},
            pivot,
        )

    def _dry(self, state: ca.SX, parameters: ca.SX) -> ca.SX:
        """The generalized force of Coulomb friction in joints, shape (k, 1)."""
        rows = list(self.observation.rows)
        if not self._system.dry:
            return ca.SX(len(rows), 1)
        without = ca.SX(parameters)
        for name in self._system.dry:
            without[self._system.parameter_slice(name)] = 0.0
        symbols = [self._system.state, self._system.parameter_symbol]
        f = ca.Function("f", symbols, [self._system.f[rows]])
        return f(state, parameters) - f(state, without)

    def _faster(self, state: ca.SX) -> ca.SX:
        """The state in whose motion the model's friction is that of the contact."""
        faster, rows = ca.SX(state), list(self.observation.rows)
        faster[rows] = self._sharpness * faster[rows]
        return faster
