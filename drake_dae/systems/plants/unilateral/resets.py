"""The reset of state and mode when a gap or a force of a contact reaches zero."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.system.contacts import PainleveOutcome
from drake_dae.dae.system.layout import Indices
from drake_dae.errors import SimulationError
from drake_dae.systems.blocks.dips import TOUCHING
from drake_dae.systems.plants.contact_events import ContactChange, ContactEvent
from drake_dae.systems.plants.unilateral.contacts import ConstraintTerms, UnilateralContacts
from drake_dae.systems.plants.unilateral.edges import Beside, Feet
from drake_dae.systems.plants.unilateral.frictional import impact
from drake_dae.systems.plants.unilateral.impacts import (
    MOST,
    ImpactSolution,
    TouchRows,
    complementary,
    rows_of,
    stopping,
)
from drake_dae.systems.plants.unilateral.modes import Closed, Modes

SLOW = 1e-11
"""A rate below this, in m/s, counts as zero."""

REPEATED = 100
"""The largest number of successive impacts at one time, as in a row of balls."""


@dataclass(frozen=True, eq=False)
class ResetResult:
    """The result of a reset.

    Attributes:
        state: x, shape (n,).
        closed: The mode.
        feet: The contacts that are beside their faces, and so open; see `Edges`.
        events: The events.
    """

    state: FloatArray
    closed: Closed
    feet: Feet
    events: tuple[ContactEvent, ...]


class Resets:
    """Impacts, and the choice of the mode.

    Touching contacts are those that are closed or whose gap is zero, and that are not beside their
    faces. While one of them approaches,
    there is an impact by Newton's law with each contact's coefficient of restitution e,

        c+ = c- + A Lambda,    0 <= Lambda_i,    0 <= c+_i + e_i c-_i,    Lambda_i (...) = 0,

    with the rates c and A = J M^-1 J^T; bilateral constraints have c+ = 0. The energy changes by
    Lambda . (c- + c+) / 2 <= 0, since every term of a contact is at most zero. With friction the
    tangential impulse follows Coulomb's law; see `frictional`.

    Bouncing ends by its limit: contacts that leave with c+ and the acceleration -a < 0 return after
    2 c+ / a, and from impact to impact the largest rate shrinks by rho = max c+ / max |c-|. With
    constant a and rho, infinitely many impacts take

        max(2 c+ / a) / (1 - rho)

    (exact for a single contact, and for two that a block rocks on, where a is constant). If that is
    at most `settling_time` T, all touching contacts come to rest immediately, which may need small
    negative impulses. This neglects gaps of at most a T^2 / 8 and rates of at most a T / 2, and no
    energy is gained. The event has the limit as its `rest_time`.

    Then the touching contacts with force are closed: lambda_i >= 0, c'_i >= 0, lambda_i c'_i = 0.

    Latches open and close by commands. Closed ones are bilateral: what is left of the rates of a
    latch that closes ends by an inelastic impact. It closes where no distance or angle of it is
    larger than `capture`, and the state is projected to its place.

    Args:
        contacts: The contacts.
        modes: Their modes.
        settling_time: T, s.
        capture: The largest distance or angle at which a latch closes, in m or rad.
    """

    def __init__(
        self, contacts: UnilateralContacts, modes: Modes, settling_time: float, capture: float
    ) -> None:
        self._contacts = contacts
        self._capture = capture
        self._modes = modes
        self._settling_time = settling_time

    def __call__(
        self,
        time: float,
        state: FloatArray,
        closed: Closed,
        control: FloatArray,
        parameters: FloatArray,
        restitution: FloatArray,
        latched: Closed = (),
        beside: Beside | None = None,
    ) -> ResetResult:
        """The reset at a time from a state, in a mode, with the e of each contact.

        Args:
            time, state, closed, control, parameters, restitution: As above.
            latched: The latches that are commanded to be closed, one flag for each.
            beside: The contacts that were beside their faces; None at the start of a run.

        Raises:
            SimulationError: No set of contacts fits, impacts do not end, or a latch is too far from
                its place.
        """
        contacts, count = self._contacts, len(self._contacts.names)
        events: list[ContactEvent] = []
        x, before = state, closed
        joining = [
            i for i, (now, was) in enumerate(zip(latched, closed[count:], strict=True)) if now > was
        ]
        for i in joining:
            contacts.check_capture(i, time, x, parameters, self._capture)
        bilateral = contacts.bilateral_in((*closed[:count], *latched))
        for _ in range(REPEATED):
            terms = contacts.terms(x, control, parameters)
            gaps, rates = (value.copy() for value in contacts.gaps.evaluate(x, parameters))
            feet = contacts.edges.feet(x, parameters, gaps, beside)
            touching = [
                i for i in range(count) if not feet.beside[i] and (closed[i] or gaps[i] <= TOUCHING)
            ]
            if len(touching) > MOST:
                names = ", ".join(contacts.names[i] for i in touching)
                raise SimulationError(
                    f"{contacts.dae.name}: {len(touching)} contacts touch at once at t = "
                    f"{time:.6g} s: {names}; there may be {MOST}, since all sets of them are tried",
                    time,
                    x,
                )
            # Separating contacts take no part.
            touching = [i for i in touching if rates[i] <= SLOW]
            own = [row for i in joining for row in contacts.latch_rows[i]]
            if not any(rates[i] < -SLOW for i in touching) and not (
                own and np.max(np.abs(terms.rates[own])) > SLOW
            ):
                break
            e = restitution[touching]
            x, event = self._impact(
                time, x, touching, terms, control, parameters, e, bilateral, joining
            )
            events.append(event)
        else:
            raise SimulationError(
                f"{contacts.dae.name}: {REPEATED} impacts follow each other at t = {time:.6g} s, "
                f"state {show(x)}, and none is the last. Take smaller coefficients of restitution",
                time,
                x,
            )
        touches = [contacts.touches[i] for i in touching]
        if contacts.dae.frictional_contacts:
            outcome = terms.painleve_outcome(
                bilateral.tolist(), [touch.normal for touch in touches]
            )
            if outcome in (PainleveOutcome.INCONSISTENT, PainleveOutcome.INDETERMINATE):
                in_paradox = [contacts.names[i] for i in touching]
                raise contacts.painleve_error(time, x, in_paradox, outcome)
        fit = self._fit(time, x, terms.force_matrix, terms.accelerations, touches, bilateral)
        pushing = {touching[place] for place in fit.pushing}
        closed = (*(i in pushing for i in range(count)), *latched)
        x = self._modes(closed, x).structure.manifold.projected(x, parameters)
        events += self._changes(time, before, closed, events)
        return ResetResult(x, closed, feet, tuple(self._completed(events, closed)))

    def resting(
        self, state: FloatArray, parameters: FloatArray, latched: Closed
    ) -> tuple[Closed, Feet]:
        """The contacts that touch at rest, as many as can be closed together, and the latches.

        Returns:
            The mode, and the places of the feet.
        """
        contacts = self._contacts
        control = np.zeros(contacts.dae.num_controls)
        matrix = contacts.terms(state, control, parameters).impulse_matrix
        gaps, rates = (value.copy() for value in contacts.gaps.evaluate(state, parameters))
        bilateral = contacts.bilateral_in((*(False for _ in contacts.names), *latched))
        closed: list[int] = []
        feet = contacts.edges.feet(state, parameters, gaps)
        is_beside = np.array(feet.beside, dtype=bool)
        touching = (gaps <= TOUCHING) & (np.abs(rates) <= SLOW) & ~is_beside
        for i in np.flatnonzero(touching).tolist():
            trial = [contacts.touches[j] for j in (*closed, i)]
            if rows_of(matrix, bilateral, trial) is not None:
                closed.append(i)
        return (*(i in closed for i in range(len(contacts.touches))), *latched), feet

    def _impact(
        self,
        time: float,
        state: FloatArray,
        touching: Sequence[int],
        terms: ConstraintTerms,
        control: FloatArray,
        parameters: FloatArray,
        e: FloatArray,
        bilateral: Indices,
        joining: Sequence[int],
    ) -> tuple[FloatArray, ContactEvent]:
        contacts, before = self._contacts, terms.all_rates
        touches = [contacts.touches[i] for i in touching]
        normals = np.array([touch.normal for touch in touches], dtype=int)
        matrix = terms.all_impulses
        frictional = [
            contacts.frictional_contact(i, parameters, coefficient)
            for i, coefficient in zip(touching, e, strict=True)
        ]
        if any(0.0 < contact.friction < np.inf for contact in frictional):
            impulse = impact(matrix, before, bilateral, frictional)
        else:
            offset = before.copy()
            offset[normals] *= 1.0 + e
            impulse = self._fit(time, state, matrix, offset, touches, bilateral).values
        if impulse is None:
            raise self._unfit(time, state)
        after = before + matrix @ impulse
        x = state + terms.velocity_change @ impulse
        rest = None
        if touches:
            rest = self._rest(time, x, touches, before, control, parameters, bilateral)
        if rest is not None:
            rows = np.array([*bilateral, *(r for touch in touches for r in touch.rows)])
            impulse = impulse + stopping(matrix, after, rows)
            after = before + matrix @ impulse
            x = state + terms.velocity_change @ impulse
        took_part = [i for i, n in zip(touching, normals, strict=True) if impulse[n] != 0.0]
        return x, ContactEvent(
            time=time,
            kind=ContactChange.IMPACT if rest is None else ContactChange.REST,
            contacts=(
                *(contacts.names[i] for i in took_part),
                *(contacts.latches[i] for i in joining),
            ),
            closed=(),
            impulses=(
                *(float(impulse[contacts.normals[i]]) for i in took_part),
                *(float(np.max(np.abs(impulse[contacts.latch_rows[i]]))) for i in joining),
            ),
            energy_lost=float(-0.5 * impulse @ (before + after)),
            rest_time=None if rest is None else float(time + rest),
        )

    def _rest(
        self,
        time: float,
        state: FloatArray,
        touches: Sequence[TouchRows],
        before: FloatArray,
        control: FloatArray,
        parameters: FloatArray,
        bilateral: Indices,
    ) -> float | None:
        """The remaining duration of bouncing after an impact, in s; None if it is long."""
        terms = self._contacts.terms(state, control, parameters)
        after = terms.rates
        leaving = [touch for touch in touches if after[touch.normal] > SLOW]
        if not leaving:
            return 0.0
        staying = [touch for touch in touches if touch not in leaving]
        fit = complementary(terms.force_matrix, terms.accelerations, bilateral, staying)
        if fit is None:
            return None
        normals = [touch.normal for touch in leaving]
        fall = -(terms.accelerations + terms.force_matrix @ fit.values)[normals]
        fastest = -min(before[touch.normal] for touch in touches)
        shrinks = float(max(after[normals])) / fastest
        if not (np.all(fall > 0.0) and shrinks < 1.0):
            return None
        rest = float(np.max(2.0 * after[normals] / fall)) / (1.0 - shrinks)
        return rest if rest <= self._settling_time else None

    def _fit(
        self,
        time: float,
        state: FloatArray,
        matrix: FloatArray,
        offset: FloatArray,
        touches: Sequence[TouchRows],
        bilateral: Indices,
    ) -> ImpactSolution:
        fit = complementary(matrix, offset, bilateral, touches)
        if fit is None:
            raise self._unfit(time, state)
        return fit

    def _unfit(self, time: float, state: FloatArray) -> SimulationError:
        return SimulationError(
            f"{self._contacts.dae.name}: no forces of the contacts that touch at t = {time:.6g} "
            f"s, state {show(state)}, prevent penetration by compressive forces alone",
            time,
            state,
        )

    def _changes(
        self, time: float, before: Closed, closed: Closed, events: Sequence[ContactEvent]
    ) -> list[ContactEvent]:
        """The contacts that opened or closed without impact."""
        named = {name for event in events for name in event.contacts}
        changes = []
        for kind, was in ((ContactChange.OPENING, True), (ContactChange.CLOSING, False)):
            names = tuple(
                name
                for name, old, new in zip(self._contacts.every, before, closed, strict=True)
                if old is was and new is not was and not (name in named and not was)
            )
            if names:
                changes.append(ContactEvent(time, kind, names, ()))
        return changes

    def _completed(self, events: Sequence[ContactEvent], closed: Closed) -> list[ContactEvent]:
        names = tuple(n for n, shut in zip(self._contacts.every, closed, strict=True) if shut)
        all_events = []
        for event in events:
            completed = replace(event, closed=names)
            if event.kind is ContactChange.REST and not set(event.contacts) & set(names):
                completed = replace(completed, kind=ContactChange.IMPACT, rest_time=None)
            all_events.append(completed)
        return all_events
