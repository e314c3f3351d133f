"""The distance of frictional contacts from the Painleve paradox: critical coefficients."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.states.margins import surroundings
from drake_dae.dae.states.region import ConsistentRegion
from drake_dae.dae.states.samples import Samples
from drake_dae.dae.system.contacts import critical_factor
from drake_dae.dae.system.system import DaeSystem
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction

MEANINGLESS = 1e6
"""Critical coefficients above this are meaningless: they occur where sliding is only round-off."""

FAST = 1e3
"""A sliding speed in m/s at which friction is fully developed."""

FLAT = 1e-9
"""The ratio of singular values of sliding velocities below which they do not span a direction."""

CLOSER = (0.9, 0.99)
"""The fractions of the lowest critical friction so far for which a paradoxical state is sought."""


@dataclass(frozen=True, eq=False)
class ContactMargin:
    """The distance of frictional contacts from the Painleve paradox, over some states.

    Attributes:
        reserve: The smallest principal minor of A(x) over the contacts, each divided by its value
            without friction: 1 - mu / mu_crit for a single contact. If it is not positive, the
            Painleve paradox occurs.
        critical_friction: Name of a coefficient of friction -> its lowest critical value if all
            coefficients grow in proportion (equal ones if all are zero); infinite if there is none.
        state: The state with the smallest value, shape (n,).
        time: Its time in s; None if the states are not from a motion.
    """

    reserve: float
    critical_friction: dict[str, float]
    state: FloatArray
    time: float | None = None

    @property
    def is_paradoxical(self) -> bool:
        """Whether the Painleve paradox occurs with the present friction."""
        return not self.reserve > 0.0


class ContactMargins:
    """Computes the contact margins of a system at states.

    Args:
        system: The system.
        matrix: A(x), shape (m, m).
    """

    def __init__(self, system: DaeSystem, matrix: ca.SX) -> None:
        self._system, self._contacts = system, system.frictional_contacts
        self._places = [
            system.parameter_slice(p.name).start for p in self._contacts.frictions if p is not None
        ]
        self._names = [p.name for p in self._contacts.frictions if p is not None]
        reserve = self._contacts.reserve(matrix)
        outputs = {"matrix": ca.densify(matrix), "reserve": reserve}
        self._values = system.trace("contact margin", outputs, often=False)
        slope = {"reserve": reserve, "gradient": ca.gradient(reserve, system.state)}
        self._slope = system.trace("slope of a contact margin", slope, often=False)

    def at(
        self, state: FloatArray, parameters: FloatArray, time: float | None = None
    ) -> ContactMargin:
        """Returns the margin at one state, for values of all parameters."""
        without = self._with_friction(parameters, 0.0)
        unit = self._direction(parameters)
        reserve = self._values(state, parameters)[1]
        size = len(self._system.constraint_input_signals)
        A_0, A_1 = (
            self._values(state, values)[0].reshape(size, size)
            for values in (without, self._with_friction(parameters, unit))
        )
        factor = critical_factor(A_0, A_0 - A_1, self._contacts.rows)
        if factor * unit.max() > MEANINGLESS:
            factor = np.inf
        critical = dict(zip(self._names, (factor * unit).tolist(), strict=True))
        return ContactMargin(float(reserve.item()), critical, state, time)

    def over(self, samples: Samples, search: bool) -> ContactMargin:
        """Returns the smallest margin at samples and, downhill from the worst, between them."""
        p = self._system.parameter_values
        margins = sorted((self.at(state, p) for state in samples.states), key=_first)
        worst = margins[0]
        if not search:
            return worst
        box = ConsistentRegion(samples.manifold, surroundings(samples))
        for start in margins[:3]:
            for better in self._downhill(box, start, p):
                worst = min(worst, better, key=_first)
        return worst

    def along(self, times: FloatArray, states: FloatArray, parameters: FloatArray) -> ContactMargin:
        """Returns the smallest margin along a motion of at least one state."""
        rows = zip(states, parameters, times.tolist(), strict=True)
        return min((self.at(*row) for row in rows), key=_first)

    def in_worst_directions(
        self, states: FloatArray, parameters: FloatArray, velocities: slice, times: FloatArray
    ) -> ContactMargin:
        """Returns the smallest margin along a motion if each contact slides in its worst direction.

        Friction that opposes sliding in the direction s leaves A_ii = a_0 - mu a^T s of a contact,
        which is least for s = a / |a|. The velocities of each state are replaced by others with
        these directions; with several contacts each slides in the direction that is worst for it
        alone, as far as the robot can move so.

        Args:
            states: Shape (N, n).
            parameters: The values of all parameters, with positive coefficients of friction.
            velocities: The velocities among the states.
            times: Of the states, in s, shape (N,).

        Raises:
            ModelError: The sliding velocities of a contact are not known.
        """
        sliding = self._sliding(velocities)
        worst = [self._with_worst_directions(x, parameters, velocities, sliding) for x in states]
        return self.along(times, np.array(worst), np.tile(parameters, (len(worst), 1)))

    def _with_worst_directions(
        self, x: FloatArray, parameters: FloatArray, velocities: slice, sliding: TracedFunction
    ) -> FloatArray:
        """The state with the velocities of `in_worst_directions`."""
        without, state = self._with_friction(parameters, 0.0), x.copy()
        size = len(self._system.constraint_input_signals)
        count = velocities.stop - velocities.start
        A_0 = self._values(x, without)[0].reshape(size, size)
        slopes = [slope.reshape(-1, count) for slope in sliding(x, without)]
        directions = []
        for i, slope in zip(self._contacts.rows, slopes, strict=True):
            left, sizes, right = np.linalg.svd(slope, full_matrices=False)
            rank = np.count_nonzero(sizes > FLAT * sizes.max(initial=0.0))
            losses = np.zeros(rank)
            for j in range(rank):  # Here the contact slides along column j of `left`.
                state[velocities] = FAST / sizes[j] * right[j]
                A = self._values(state, parameters)[0].reshape(size, size)
                losses[j] = A_0[i, i] - A[i, i]
            length = np.linalg.norm(losses)
            directions.append(left[:, :rank] @ losses / (length if length > 0.0 else 1.0))
        wanted = FAST * np.concatenate(directions)
        state[velocities] = np.linalg.lstsq(np.vstack(slopes), wanted, rcond=FLAT)[0]
        return state

    def _sliding(self, velocities: slice) -> TracedFunction:
        """x -> the derivatives of the sliding velocities of each contact by the velocities."""
        rates, slopes = self._system.state[velocities], {}
        inputs = [signal.name for signal in self._system.constraint_input_signals]
        for contact in self._system.contacts:
            if contact.force not in inputs:
                continue
            if contact.friction and contact.sliding is None:
                raise ModelError(f"the sliding velocities of {contact.force} are not known")
            still = ca.SX(1, 1) if contact.sliding is None else contact.sliding
            slopes[contact.force] = ca.densify(ca.jacobian(still, rates))
        return self._system.trace("slopes of sliding", slopes, often=False)

    def _downhill(
        self, box: ConsistentRegion, start: ContactMargin, parameters: FloatArray
    ) -> Iterator[ContactMargin]:
        """Generates states in the Painleve paradox with decreasing friction."""
        unit, best = self._direction(parameters), start
        for part in CLOSER:
            for _ in range(20):
                factor = _first(best)
                size = part * factor if np.isfinite(factor) else 1e3
                values = self._with_friction(parameters, size * unit / max(unit))
                lower = self.at(box.descend(partial(self._reserve, values), best.state), parameters)
                if not _first(lower) < factor:
                    break
                best = lower
                yield best

    def _reserve(self, parameters: FloatArray, state: FloatArray) -> tuple[float, FloatArray]:
        """The margin as far as it is positive, and its gradient."""
        margin, gradient = self._slope(state, parameters)
        if not self._slope.is_finite:
            return np.inf, np.zeros(state.size)
        return max(float(margin.item()), 0.0), gradient

    def _direction(self, parameters: FloatArray) -> FloatArray:
        """The coefficients of friction, or ones if all are zero."""
        friction = parameters[self._places]
        return friction if np.any(friction) else np.ones(len(self._places))

    def _with_friction(self, parameters: FloatArray, friction: FloatArray | float) -> FloatArray:
        values = parameters.copy()
        values[self._places] = friction
        return values


def _first(margin: ContactMargin) -> float:
    """The lowest critical coefficient of friction."""
    return max(margin.critical_friction.values())
