"""The distance of frictional contacts from the Painleve paradox: critical coefficients."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.contacts import critical_factor
from drake_dae.dae.states.margins import surroundings
from drake_dae.dae.states.region import ConsistentRegion
from drake_dae.dae.states.samples import Samples
from drake_dae.dae.system import DaeSystem

MEANINGLESS = 1e6
"""Critical coefficients above this are meaningless: they occur where sliding is only round-off."""

CLOSER = (0.9, 0.99)
"""The fractions of the lowest critical friction so far for which a paradoxical state is sought."""


@dataclass(frozen=True, eq=False)
class ContactMargin:
    """The distance of frictional contacts from the Painleve paradox, over some states."""

    reserve: float
    critical_friction: dict[str, float]
    state: FloatArray
    time: float | None = None

    @property
    def is_paradoxical(self) -> bool:
        """Whether the Painleve paradox occurs with the present friction."""
        return not self.reserve > 0.0


class ContactMargins:
    """Computes the contact margins of a system at states."""

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
