"""The first break-away of a contact as encoders show it, whose friction is not known yet."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae import Observation
from drake_dae.systems.observing.observer_functions import (
    BREAK_RATE,
    EARLY,
    LEAST_SHARE,
)
from drake_dae.systems.observing.observer_rates import Observing

_CLEAR = 4.0
"""A displacement is no noise from this multiple of its standard deviation on: one angle that passes
to the next value of its encoder makes sqrt(12)."""

_SHORT, _LONG = 2.0, 30.0
"""The least and the largest number of samples until a break-away is seen."""

_UNSURE = 0.5
"""The standard deviation of the coefficient of friction at a break-away, relative to its rise since
then."""

_DRIFT = 0.003
"""The standard deviation of the change of a coefficient from sample to sample."""

_FAST = 1e6
"""A displacement of 1 m is tested as a speed of this many m/s: friction is then fully developed."""

_TINY = 1e-9
"""The least denominator, in N or m/s^2."""


@dataclass(frozen=True, eq=False)
class Slides:
    """What is known of the first slide of each contact, as columns of shape (c, 1).

    Attributes:
        samples: The samples for which it slides, 0 while it sticks.
        ss, sv, sm, vv, vm, mm: The covariance of displacement, speed and coefficient.
    """

    samples: ca.SX
    ss: ca.SX
    sv: ca.SX
    sm: ca.SX
    vv: ca.SX
    vm: ca.SX
    mm: ca.SX

    @classmethod
    def of(cls, column: ca.SX) -> Self:
        """The parts of a column of shape (7 c, 1)."""
        count = len(fields(cls))
        size = column.numel() // count
        return cls(*(column[i * size : (i + 1) * size] for i in range(count)))

    @property
    def column(self) -> ca.SX:
        """All values as one column."""
        return ca.vertcat(*vars(self).values())


@dataclass(frozen=True, eq=False)
class SampledContacts:
    """The contacts at a sample, as expressions.

    Attributes:
        planes: T of `Observation.directions`.
        forces, accelerations: The friction force per unit of each coefficient, and the acceleration
            that it causes, shape (k, c) each.
        towards: The friction force per unit of each coefficient at the wanted velocity.
        coefficients: The estimated ones, shape (c, 1).
        needed: Those that the control needs while the contacts stick, shape (c, 1).
        pressing: The normal forces, shape (c, 1).
        is_unused: 1 for each contact that is lost, or all where drives are limited.
    """

    planes: Sequence[ca.SX]
    forces: ca.SX
    accelerations: ca.SX
    towards: ca.SX
    coefficients: ca.SX
    needed: ca.SX
    pressing: ca.SX
    is_unused: ca.SX


@dataclass(frozen=True, eq=False)
class Correction:
    """How the estimate of each contact is corrected at a sample, as columns of shape (c, 1).

    Attributes:
        is_early: 1 for each contact that slides for the first time.
        displacement, speed, friction: The gains of the displacement, the speed and the coefficient.
        begins: 1 for each contact that breaks away.
        start: The coefficient of a contact that breaks away.
        rise: The rise of the coefficient of a contact that sticks.
        slides: What is known after it.
    """

    is_early: ca.SX
    displacement: ca.SX
    speed: ca.SX
    friction: ca.SX
    begins: ca.SX
    start: ca.SX
    rise: ca.SX
    slides: Slides


class BreakAway:
    """The first break-away of each contact, for a `StateEstimator`.

    A contact that has not slid yet sticks in the prediction, with any friction that this needs.
    While it should slide, its coefficient rises with the rate k = `BREAK_RATE`, so that it breaks
    away before the reference is far. It has broken away where measured positions leave the
    predicted ones along the surface by more than noise, by S. With s'' = b mu of a unit of friction
    this takes the time t = (6 S / (k |b|))^(1/3), since s = k |b| t^3 / 6: the speed is then 3 S /
    t, and the coefficient less by k t than it has risen to, or than the control needs. From there
    on a Kalman filter of s, s' and mu takes the place of the stationary one along the motion, until
    `friction_rate` is faster.

    Args:
        observation, observing: The observed functions, and the rates, with a state_rate.
        period: T in s.
        deviations: The standard deviations of measured positions, shape (k,).
    """

    def __init__(
        self, observation: Observation, observing: Observing, period: float, deviations: FloatArray
    ) -> None:
        self._observation, self._observing, self._period = observation, observing, period
        self._squares = ca.DM(np.square(deviations))
        self._count = max(round(1.0 / (EARLY * observing.friction_rate * period)), 1)
        self._least = LEAST_SHARE * observing.least_speed

    def is_stuck(self, slides: Slides, is_unused: ca.SX) -> ca.SX:
        """1 for each contact that has not slid yet."""
        return ca.logic_not(ca.logic_or(is_unused, slides.samples > 0))

    def corrected(
        self,
        states: tuple[ca.SX, ca.SX],
        error: ca.SX,
        contacts: SampledContacts,
        force: ca.SX,
        parameters: ca.SX,
        slides: Slides,
    ) -> Correction:
        """The correction of a sample.

        Args:
            states: The state of the sample before, and the same with the wanted velocities.
            error: The errors of the predicted positions, shape (k, 1).
            contacts: The contacts.
            force: The constraint force.
            parameters: Those of the functions.
            slides: What is known of the slides.
        """
        speeds = self._observation.friction.function
        actual, wanted = (speeds(state, force, parameters)[1] for state in states)
        is_moved, is_used = wanted > self._least, ca.logic_not(contacts.is_unused)
        noise = self._noise(contacts.forces, contacts.pressing)
        displaced = ca.SX(states[0])
        displaced[list(self._observation.rows)] = _FAST * error
        distance = speeds(displaced, force, parameters)[1] / _FAST
        leaves = self._leaves(error, contacts, distance, is_moved)
        stuck = self.is_stuck(slides, contacts.is_unused)
        is_early = (slides.samples < self._count) * is_used
        sliding = is_early * ca.if_else(stuck, leaves, 1)
        rests = is_early * (slides.samples > _SHORT) * is_moved * (actual <= self._least)
        rise = is_early * stuck * is_moved * ca.logic_not(leaves) * BREAK_RATE * self._period

        b = -ca.sum1(contacts.forces * contacts.accelerations).T / contacts.pressing
        size = _CLEAR**2 * noise
        since = 6.0 * ca.sqrt(size) / (BREAK_RATE * ca.fmax(ca.fabs(b), _TINY))
        shortest, longest = _SHORT * self._period, _LONG * self._period
        since = ca.fmin(ca.fmax(since ** (1.0 / 3.0), shortest), longest)
        risen = BREAK_RATE * since
        sure = ca.fmin(contacts.needed, contacts.coefficients)
        unsure = (_UNSURE * risen) ** 2 + (_UNSURE * (contacts.needed - sure)) ** 2
        fresh = size, 3.0 * size / since, 0, 9.0 * size / since**2, 0, unsure
        before = [
            ca.if_else(stuck, first, later)
            for first, later in zip(fresh, self._predicted(slides, b, noise), strict=True)
        ]
        ss, sv, sm, vv, vm, mm = before
        by_s, by_v, by_m = (sliding * column / (ss + noise) for column in (ss, sv, sm))
        after = (
            *(ss - by_s * ss, sv - by_s * sv, sm - by_s * sm),
            *(vv - by_v * sv, vm - by_v * sm, mm - by_m * sm),
        )
        samples = ca.if_else(rests, 0, slides.samples + sliding)
        known = Slides(samples, *(sliding * each for each in after))
        start = ca.fmax(sure - risen, 0.0)
        return Correction(sliding, by_s, by_v, by_m, stuck * sliding, start, rise, known)

    def _noise(self, forces: ca.SX, pressing: ca.SX) -> ca.SX:
        """The variances of measured displacements against forces of friction, in m^2."""
        noise = ca.sum1(forces**2 * self._squares).T / pressing**2
        return ca.fmax(noise, (self._least * self._period / _CLEAR) ** 2)

    def _leaves(
        self, error: ca.SX, contacts: SampledContacts, distance: ca.SX, is_moved: ca.SX
    ) -> ca.SX:
        """1 for each contact whose displacement is no noise: as it is wanted, or in any way."""
        ahead = -ca.mtimes(contacts.towards.T, error) / contacts.pressing
        deviation = ca.sqrt(self._noise(contacts.towards, contacts.pressing))
        as_wanted = ca.logic_and(is_moved, ahead > _CLEAR * deviation)
        squares = [
            ca.sumsqr(ca.mtimes(plane.T, error))
            > _CLEAR**2 * ca.dot(ca.sum2(plane**2), self._squares)
            for plane in contacts.planes
        ]
        is_far = distance > self._least * self._period
        return ca.logic_or(as_wanted, ca.logic_and(ca.vertcat(*squares), is_far))

    def _predicted(self, slides: Slides, b: ca.SX, noise: ca.SX) -> tuple[ca.SX, ...]:
        """The covariance a sample later."""
        T, a = self._period, self._period**2 / 2.0 * b
        ss, sv, sm = slides.ss, slides.sv, slides.sm
        vv, vm, mm = slides.vv, slides.vm, slides.mm
        assert self._observing.state_rate is not None
        random = (self._observing.state_rate * T) ** 4 / T**2 * noise  # As in a `ChainFilter`.
        return (
            ss + 2.0 * (T * sv + a * sm + T * a * vm) + T**2 * vv + a**2 * mm,
            sv + T * b * sm + T * vv + 3.0 * a * vm + a * T * b * mm,
            sm + T * vm + a * mm,
            vv + 2.0 * T * b * vm + (T * b) ** 2 * mm + random,
            vm + T * b * mm,
            mm + _DRIFT**2,
        )
