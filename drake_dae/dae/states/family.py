"""The family that a system is: its states, its parameters and its exogenous signals together."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.states.samples import fields_at
from drake_dae.errors import InconsistentStateError

MEMBERS = 4
"""So many members are drawn. Functions are analytic almost everywhere: one that is zero at a few
members that have nothing special is zero at all."""

VISIBLE = 1e-6
"""What acts on a member by more than this, relative to the sizes of its terms, is no round-off."""

_NEARER = 0.25
"""Where there is no consistent state with some numbers, they are taken so much nearer to the
defaults, and again."""

_TRIES = 6


@dataclass(frozen=True, eq=False)
class Deciding:
    """Numbers with which something is zero at their defaults and not elsewhere.

    Attributes:
        names: The parameters, and the derivatives of exogenous signals, of which each alone
            decides; or, where only several together do, those that it takes.
        values: A value of each with which it is not zero.
        defaults: Their defaults.
    """

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
    """Members of the family that a system is, each a consistent state and numbers of its own.

    A parameter is drawn within its bounds, or within a factor of two of its default, and at 0
    within one of its unit; the derivatives of an exogenous signal likewise, unless its bounds hold
    it at one value.

    Args:
        manifold: N*, or what is known of it.
        states: Consistent states with the default parameters, shape (samples, n).
    """

    def __init__(self, manifold: Manifold, states: FloatArray) -> None:
        self._manifold, self._states = manifold, states
        self._system = manifold.system

    def deciding(self, acts: Callable[[FloatArray, FloatArray], bool]) -> Deciding | None:
        """What decides whether something acts that does not with the default parameters.

        Args:
            acts: Whether it acts at a state, with values of all parameters.

        Returns:
            The numbers that decide; None if it acts nowhere.
        """
        hits = [member for member in self._members if acts(*member)]
        # One of many may be the round-off of a matrix that is nearly singular.
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
        found = [n for n in numbers if acts_with(n[1], others=defaults, those=values)]
        # None alone: those without which it does not.
        found = found or [n for n in numbers if not acts_with(n[1], others=values, those=defaults)]
        largest = [
            (name, places[int(np.argmax(np.abs(values[places] - defaults[places])))])
            for name, places in found or numbers
        ]
        return Deciding(
            tuple(name for name, _ in largest),
            tuple(float(values[place]) for _, place in largest),
            tuple(float(defaults[place]) for _, place in largest),
        )

    def lost(self, determinant: Callable[[FloatArray, FloatArray], float]) -> Deciding | None:
        """Where a determinant is zero on the way to bounds that somebody gave, if it is.

        Args:
            determinant: Its sign at a state, with values of all parameters; 0 where it vanishes.

        Returns:
            A parameter with a bound on the way to which, the bound included, it vanishes.
        """
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
        """What can be drawn: parameters and derivatives of signals, and where they stand."""
        system = self._system
        found, start, following = [], 0, sum(p.value.size for p in system.parameters)
        rates = []
        for p in system.parameters:
            size = p.value.size
            free = [start + i for i in range(size) if p.low[i] < p.high[i]]
            if free:
                found.append((p.name, free))
            for order in range(1, len(p.derivatives) + 1):
                if free:
                    rates.append((p.name + "'" * order, [following + i - start for i in free]))
                following += size
            start += size
        return found + rates

    @cached_property
    def _members(self) -> list[tuple[FloatArray, FloatArray]]:
        if not self._numbers:
            return []
        system, random = self._system, np.random.default_rng(0)
        low, high = system.parameter_box
        defaults, found = system.parameter_values, []
        for number in range(MEMBERS):
            away = random.uniform(low, high) - defaults
            state = self._states[number % len(self._states)]
            for _ in range(_TRIES):
                member = self._consistent(state, defaults + away)
                if member is not None:
                    found.append(member)
                    break
                away *= _NEARER
        return found

    def _consistent(
        self, state: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """A consistent state near one with other numbers; None if there is none in the domain."""
        try:
            found = self._manifold.project(state, parameters)
        except InconsistentStateError:
            return None
        fields = fields_at(self._system, found, parameters)
        return (found, parameters) if all(np.all(np.isfinite(f)) for f in fields.values()) else None
