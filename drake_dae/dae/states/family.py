"""Random members of a system: states, parameters and exogenous signals together."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.manifold.manifold import Manifold
from drake_dae.dae.states.samples import fields_at
from drake_dae.errors import InconsistentStateError

MEMBERS = 4
"""The number of random members. Functions are analytic almost everywhere: one that is zero at a few
random members is zero at all."""

VISIBLE = 1e-6
"""An action above this, relative to the sizes of its terms, is not round-off."""

_NEARER = 0.25
"""If there is no consistent state for drawn numbers, they are moved towards the defaults by this
factor, repeatedly."""

_TRIES = 6


@dataclass(frozen=True, eq=False)
class Deciding:
    """Parameters for which an expression is not zero, although it is zero at the defaults."""

    names: tuple[str, ...]
    values: tuple[float, ...]
    defaults: tuple[float, ...]

    @property
    def pairs(self) -> tuple[tuple[str, float, float], ...]:
        """Name, value and default of each."""
        return tuple(zip(self.names, self.values, self.defaults, strict=True))

    def __str__(self) -> str:
        there, here = (
            " and ".join(f"{n} = {v:.3g}" for n, v in zip(self.names, values, strict=True))
            for values in (self.values, self.defaults)
        )
        return f"at {there}, and not at the default {here}"


class Family:
    """Random members of a system: consistent states, each with parameters of its own.

    A parameter is drawn within its bounds, or within a factor of two of its default (if that is 0,
    from -1 to 1). So are the derivatives of an exogenous signal, unless its bounds are equal.
    """

    def __init__(self, manifold: Manifold, states: FloatArray) -> None:
        self._manifold, self._states = manifold, states
        self._system = manifold.system

    def deciding(self, acts: Callable[[FloatArray, FloatArray], bool]) -> Deciding | None:
        """Returns the parameters for which an input acts that does not act at the defaults."""
        hits = [member for member in self._members if acts(*member)]
        # One of many may be round-off of a nearly singular matrix.
        if 2 * len(hits) <= len(self._members):
            return None
        state, values = hits[0]
        defaults = self._system.parameter_values

        def acts_with(places: list[int], others: FloatArray, those: FloatArray) -> bool:
            mixed = others.copy()
            mixed[places] = those[places]
            member = self._consistent(state, mixed)
            return member is not None and acts(*member)

        numbers = self._numbers
        candidates = [n for n in numbers if acts_with(n[1], others=defaults, those=values)]
        # No parameter alone decides: those without which it does not act.
        candidates = candidates or [
            n for n in numbers if not acts_with(n[1], others=values, those=defaults)
        ]
        largest = [
            (name, places[int(np.argmax(np.abs(values[places] - defaults[places])))])
            for name, places in candidates or numbers
        ]
        return Deciding(
            tuple(name for name, _ in largest),
            tuple(float(values[place]) for _, place in largest),
            tuple(float(defaults[place]) for _, place in largest),
        )

    def lost(self, determinant: Callable[[FloatArray, FloatArray], float]) -> Deciding | None:
        """Returns a parameter for which a determinant vanishes within the bounds, or None."""
        system, state = self._system, self._states[0]
        defaults = system.parameter_values
        here = determinant(state, defaults)
        for p in system.parameters:
            if p.bounds is None:
                continue
            places = system.parameter_slice(p.name)
            for i in range(p.value.size):
                for bound in (p.low[i], p.high[i]):
                    values = defaults.copy()
                    values[places.start + i] = bound
                    member = self._consistent(state, values)
                    if member is None or determinant(*member) == here:
                        continue
                    name = p.signals[i].name
                    return Deciding((name,), (float(bound),), (float(p.value[i]),))
        return None

    @cached_property
    def _numbers(self) -> list[tuple[str, list[int]]]:
        """The parameters and derivatives of signals to draw, with their indices."""
        system = self._system
        entries, start, following = [], 0, sum(p.value.size for p in system.parameters)
        rates = []
        for p in system.parameters:
            size = p.value.size
            free = [start + i for i in range(size) if p.low[i] < p.high[i]]
            if free:
                entries.append((p.name, free))
            for order in range(1, len(p.derivatives) + 1):
                if free:
                    rates.append((p.name + "'" * order, [following + i - start for i in free]))
                following += size
            start += size
        return entries + rates

    @cached_property
    def _members(self) -> list[tuple[FloatArray, FloatArray]]:
        if not self._numbers:
            return []
        system, random = self._system, np.random.default_rng(0)
        low, high = system.parameter_box
        defaults, members = system.parameter_values, []
        for number in range(MEMBERS):
            away = random.uniform(low, high) - defaults
            state = self._states[number % len(self._states)]
            for _ in range(_TRIES):
                member = self._consistent(state, defaults + away)
                if member is not None:
                    members.append(member)
                    break
                away *= _NEARER
        return members

    def _consistent(
        self, state: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Returns a consistent state near a state for other parameters; None if there is none."""
        try:
            consistent = self._manifold.project(state, parameters)
        except InconsistentStateError:
            return None
        fields = fields_at(self._system, consistent, parameters)
        is_finite = all(np.all(np.isfinite(field)) for field in fields.values())
        return (consistent, parameters) if is_finite else None
