"""The friction of contacts as an estimator sees it, and their first break-away."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import accumulate

import casadi as ca
import numpy as np

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive
from drake_dae.dae import Observation
from drake_dae.dae.disturbance import Metric, shares
from drake_dae.errors import ModelError
from drake_dae.trace.factorization import PositiveDefiniteFactorization


@checked(ModelError)
@dataclass(frozen=True)
class Observing:
    """The rates of a `StateEstimator` in 1/s, and its thresholds for friction.

    Attributes:
        rate: k_o, the rate of disturbances along the free directions.
        force_rate: k_n, the rate of disturbances along the constrained directions, which change
            only constraint forces; None for k_o.
        state_rate: w, the rate at which the state is corrected by measured positions; None for the
            state as it is measured.
        friction_rate: k_f, the rate at which coefficients of friction are identified, unless other
            parameters are estimated, and friction with these.
        largest_friction: The upper bound of coefficients of friction.
        least_speed: The speed in m/s below which a contact may stick, so that its friction is not
            identified.
        ranges: Parameter name -> the largest deviation from its value, of estimated parameters that
            have no bounds.
        least_force: The force in N below which a contact counts as lost: its coefficient and
            integrals are not updated.
    """

    rate: float
    friction_rate: float = 3.0
    largest_friction: float = 1.0
    least_speed: float = 0.005
    least_force: float = 1.0
    force_rate: float | None = None
    state_rate: float | None = None
    ranges: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for each in fields(Observing):  # A form may have more.
            value = getattr(self, each.name)
            for number in value.values() if each.name == "ranges" else [value]:
                if number is not None:
                    positive(each.name, number)


BREAK_RATE = 12.0  # 1/s, at which a coefficient of friction rises until its contact breaks away

STICKS = 0.5  # A contact sticks below this share of the wanted speed,

LEAST_SHARE = 0.06  # which is tested from this share of `Observing.least_speed` on.

EARLY = 2.0  # the number of samples that the first value of a coefficient counts for

CLEAR = 4.0
"""A displacement is no noise from this multiple of its standard deviation on: one angle that passes
to the next value of its encoder makes sqrt(12)."""

_SHARP = 10.0
"""Friction of a contact that gives way is taken as that of a motion faster by this factor: it is
fully developed from v_s / 10 on. An ideal contact has the friction of the model."""

LITTLE = 1e-9  # the least normal force, in N, by which is divided


@dataclass(frozen=True, eq=False)
class ContactTerms:
    """The directions of friction and constraints at a state, as in `Observation`."""

    friction: ca.SX  # C, the friction force per unit of each coefficient, shape (k, c)
    metric: Metric  # W
    free: ca.SX  # Q
    planes: Sequence[ca.SX]  # T of each contact
    held: ca.SX  # those of contacts that stick, side by side, zero for others
    velocity: ca.SX
    slides: ca.SX  # 1 for each contact that certainly slides, shape (c,)
    sticks: ca.SX  # 1 for each that may stick
    valid: ca.SX  # finite if all of these are valid


class Contacts:
    """The contacts of a robot at a sample, as expressions.

    An ideal contact has the friction of the model at small speeds, too; `deviations` are those of
    measured positions, shape (k,).
    """

    def __init__(
        self,
        observation: Observation,
        observing: Observing,
        period: float,
        delay: float,
        is_ideal: bool,
        deviations: FloatArray,
        reference: ca.SX,
        hold: ca.SX,
    ) -> None:
        self._observation, self._observing = observation, observing
        self._period, self._delay, self._deviations = period, delay, deviations
        self._sharpness = 1.0 if is_ideal else _SHARP
        self._reference, self._hold = reference, hold
        self._stops = [0, *accumulate(observation.widths)]
        self._least_speed = LEAST_SHARE * observing.least_speed

    def is_lost(self, v: ca.SX) -> ca.SX:
        """1 for each contact that is lost, shape (c, 1)."""
        return self._pressing(v) < self._observing.least_force

    def _pressing(self, v: ca.SX) -> ca.SX:
        """The normal force of each contact."""
        return ca.vertcat(ca.SX(0, 1), *(v[i] for i in self._observation.frictions.values()))

    def terms(self, state: ca.SX, v: ca.SX, parameters: ca.SX) -> ContactTerms:
        """The directions of friction and constraints at a state."""
        observation = self._observation
        friction = observation.friction.function(self.faster(state), v, parameters)
        directions = observation.directions.function(state, v, parameters)
        free, planes = directions[0], ca.horzsplit(directions[1], self._stops)

        def metric(columns: ca.SX) -> ca.SX:
            function = observation.metric.function
            moved = [function(state, d, parameters)[0] for d in ca.horzsplit(columns)]
            return ca.horzcat(ca.SX(columns.shape[0], 0), *moved)

        is_slow = friction[1] < self._sharpness * self._observing.least_speed
        is_lost = self.is_lost(v)
        sticks = ca.logic_and(is_slow, ca.logic_not(is_lost))
        held = self.side_by_side(planes, sticks)
        slides = ca.logic_not(ca.logic_or(is_slow, is_lost))
        velocity, valid = state[list(observation.rows)], friction[-1] + directions[-1]
        return ContactTerms(
            friction[0], metric, free, planes, held, velocity, slides, sticks, valid
        )

    def side_by_side(self, planes: Sequence[ca.SX], of_contacts: ca.SX) -> ca.SX:
        """T of all contacts side by side, each times its entry of a column."""
        scaled = [plane * of_contacts[j] for j, plane in enumerate(planes)]
        return ca.horzcat(ca.SX(len(self._observation.rows), 0), *scaled)

    def faster(self, state: ca.SX) -> ca.SX:
        """The state in whose motion the model's friction is that of the contact."""
        faster, rows = ca.SX(state), list(self._observation.rows)
        faster[rows] = self._sharpness * faster[rows]
        return faster

    def developed(self, state: ca.SX, v: ca.SX, parameters: ca.SX) -> ca.SX:
        """The friction force per unit of each coefficient, fully developed, shape (k, c)."""
        friction = self._observation.friction.function
        return friction(self.faster(state), v, parameters)[0]

    def early(
        self, slid: ca.SX, contact: ContactTerms, x: ca.SX, v: ca.SX, parameters: ca.SX, d: ca.SX
    ) -> tuple[ca.SX, ca.SX]:
        """The change of friction at the first break-away, and the samples of sliding after it.

        While a contact sticks where it should slide, its coefficient rises with `BREAK_RATE`, so
        that it breaks away before the reference is far. Then samples of d are averaged, without a
        low-pass, until `friction_rate` is faster. Not with a law that needs derivatives of d.
        """
        observation, least = self._observation, self._least_speed
        wanted, actual = (
            observation.friction.function(state, v, parameters)[1]
            for state in (self.goal(x, parameters)[0], x)
        )
        follows = actual >= STICKS * wanted
        weight = 1.0 / (slid + EARLY)
        is_early = weight > EARLY * self._observing.friction_rate * self._period
        unused = ca.logic_or(self.is_lost(v), self._hold != 0)
        used = is_early * (wanted > least) * ca.logic_not(unused)
        slides = used * follows * (actual > least)
        terms = contact.friction, contact.planes, contact.velocity, contact.metric
        change = slides * weight * shares(*terms, d)
        change += used * ca.logic_not(follows) * BREAK_RATE * self._period
        return change, slid + slides

    def goal(self, x: ca.SX, parameters: ca.SX) -> tuple[ca.SX, ca.SX]:
        """The state with the wanted velocities when the control acts, and its check."""
        wanted, reference = self._observation.wanted, self._reference
        assert wanted is not None
        values = wanted.function(x, reference, self._delay, parameters)
        return values[0], values[-1]

    def slipped(
        self,
        slid: ca.SX,
        contact: ContactTerms,
        middle: ca.SX,
        speed: ca.SX,
        v: ca.SX,
        parameters: ca.SX,
        momentum: ca.SX,
        error: ca.SX,
        factors: PositiveDefiniteFactorization,
        unused: ca.SX,
        usual: Sequence[float],
    ) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """The same as `early` by measured positions.

        A contact has broken away where positions leave the predicted ones by more than noise, by S.
        While its coefficient rises with the rate k, a unit of friction makes s'' = b: so this takes
        the time t = (6 S / (k |b|))^(1/3), from s = k |b| t^3 / 6; the speed is then 3 S / t, and
        the coefficient less by k t than it has risen to. From there on the gains along the friction
        are those of the least squares of all positions since it broke away, a parabola.

        Returns the change of mu, the samples of sliding, the change of the state, and the samples
        in which friction explains all of r along it.
        """
        T = self._period
        least = self._least_speed * T / CLEAR
        squares = ca.DM(np.square(np.maximum(self._deviations, least)))
        goal = self.goal(middle, parameters)[0]
        now = ca.vertcat(middle[: error.numel()], speed)
        friction = self._observation.friction.function
        wanted, actual = (friction(each, v, parameters)[1] for each in (goal, now))
        towards, forces = (self.developed(each, v, parameters) for each in (goal, now))
        pressing = ca.fmax(ca.fabs(self._pressing(v)), LITTLE)
        is_moved, sticks = wanted > self._least_speed, slid == 0
        ahead = -ca.mtimes(towards.T, error) > CLEAR * ca.sqrt(ca.sum1(towards**2 * squares).T)
        aside = [
            ca.sumsqr(ca.mtimes(plane.T, error)) > CLEAR**2 * ca.dot(ca.sum2(plane**2), squares)
            for plane in contact.planes
        ]
        leaves = ca.logic_or(ca.logic_and(is_moved, ahead), ca.vertcat(*aside))
        most = max(round(1.0 / (EARLY * self._observing.friction_rate * T)), 1)
        is_early = (slid < most) * ca.logic_not(unused)
        stuck = is_early * sticks
        breaks = stuck * leaves
        slides = is_early * ca.logic_not(sticks)

        along = factors.solve(ca.mtimes(contact.free, forces))
        b = ca.fmax(ca.fabs(ca.sum1(forces * along).T) / pressing, LITTLE)
        distance = CLEAR * ca.sqrt(ca.sum1(forces**2 * squares).T) / pressing
        since = (6.0 * distance / (BREAK_RATE * b)) ** (1.0 / 3.0)
        since = ca.fmin(ca.fmax(since, 2.0 * T), 30.0 * T)
        rests = slides * (slid > EARLY) * is_moved * (actual <= self._least_speed)
        kick = ca.mtimes(along, breaks * 3.0 * distance / (since * b))

        share = slides * shares(forces, contact.planes, speed, contact.metric, momentum)
        by_all = 60.0 / ((slid + 1.0) * (slid + 2.0) * (slid + 3.0))
        by_q = by_all * (3.0 * slid * (slid + 1.0) + 2.0) / 20.0
        by_v = by_all * (2.0 * slid + 1.0) * 0.3
        moved = [
            ca.mtimes(along, share * (by_q - usual[0])),
            ca.mtimes(along, share * (by_v / T - usual[1])) - kick,
        ]
        change = share * by_all / T**2 - breaks * BREAK_RATE * since
        change += stuck * is_moved * ca.logic_not(breaks) * BREAK_RATE * T
        after = ca.if_else(rests, 0, slid + slides + breaks * ca.floor(since / T))
        return change, after, ca.vertcat(*moved), slides
