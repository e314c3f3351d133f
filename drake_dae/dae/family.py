"""Random members of a system: states, parameters and exogenous signals together."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy  # SciPy loads its large parts when they are used.

from drake_dae.arrays import FloatArray
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.samples import fields_at
from drake_dae.errors import InconsistentStateError
from drake_dae.trace.round_off import positive

# The number of random members. Functions are analytic almost everywhere: one that is zero at a few
# random members is zero at all.
MEMBERS = 4
# If there is no consistent state for drawn numbers, they are moved towards the defaults by this
# factor, so often.
NEARER, TRIES = 0.25, 6
# How a box of bounds is searched: random corners, random places, minima from the best of them.
CORNERS, STARTS = 16, 3
UNKNOWN = 10.0  # A margin where there is no consistent state; others are at most about 1.
# Parameters that differ less from their defaults, relative to the others, do not decide.
SAME = 1e-3
# A function of a consistent state and the values of all parameters.
OfMember = Callable[[FloatArray, FloatArray], float]


@dataclass(frozen=True, eq=False)
class Deciding:
    """Parameters that decide a degree or a rank: name, value and default of each."""

    pairs: tuple[tuple[str, float, float], ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for name, _, _ in self.pairs)

    def __str__(self) -> str:
        there = " and ".join(f"'{name}' = {value:.3g}" for name, value, _ in self.pairs)
        here = " and ".join(f"'{name}' = {default:.3g}" for name, _, default in self.pairs)
        return f"at {there}, and not at the default {here}"


class Family:
    """Random members of a system: consistent states, each with parameters of its own.

    A parameter is drawn within its bounds, or within a factor of two of its default (if that is 0,
    from -1 to 1). So are the derivatives of an exogenous signal, unless its bounds are equal.
    """

    def __init__(self, manifold: Manifold, states: FloatArray) -> None:
        self._manifold, self._states = manifold, states
        self._system = manifold.system

    def deciding(self, acts: OfMember) -> Deciding | None:
        """Returns the parameters for which an input acts that does not act at the defaults."""
        hits = [member for member in self._members if acts(*member)]
        # One of many may be round-off of a nearly singular matrix.
        if 2 * len(hits) <= len(self._members):
            return None
        (state, values), every = hits[0], self._places
        defaults = self._system.parameter_values

        def acts_with(places: list[int], others: FloatArray, those: FloatArray) -> bool:
            mixed = others.copy()
            mixed[places] = those[places]
            member = self._consistent(state, mixed)
            return member is not None and bool(acts(*member))

        chosen = [n for n in every if acts_with(every[n], others=defaults, those=values)]
        # No parameter alone decides: those without which it does not act.
        chosen = chosen or [
            n for n in every if not acts_with(every[n], others=values, those=defaults)
        ]
        pairs = []
        for name in chosen or every:
            i = max(every[name], key=lambda i: abs(values[i] - defaults[i]))
            pairs.append((name, float(values[i]), float(defaults[i])))
        return Deciding(tuple(pairs))

    def lost(self, margin: OfMember, least: float) -> Deciding | None:
        """Returns parameters within their bounds where a margin is not above the least, or None.

        It is tried at corners and random places of the box of bounds, and minimized from the best.
        """
        system, defaults = self._system, self._system.parameter_values
        bounded = [p for p in system.parameters if p.bounds is not None]
        names = [signal.name for p in bounded for signal in p.signals]
        places = np.concatenate([np.r_[system.parameter_slice(p.name)] for p in bounded])
        low, high = (bound[places] for bound in system.parameter_box)
        width, random = high - low, np.random.default_rng(0)
        default = (defaults[places] - low) / positive(width)

        def at(box: FloatArray) -> float:
            values = defaults.copy()
            values[places] = low + width * box
            member = self._consistent(self._states[0], values)
            return UNKNOWN if member is None else min(margin(*member), UNKNOWN)

        alone = [np.where(row > 0, end, default) for row in np.eye(places.size) for end in (0, 1)]
        corners = random.integers(0, 2, (CORNERS, places.size))
        inside = random.uniform(size=(CORNERS, places.size))
        tried = np.array([*alone, *np.unique(corners, axis=0), *inside], dtype=float)
        values = np.array([at(box) for box in tried])
        for k in np.argsort(values, kind="stable")[:STARTS]:
            box, value = tried[k], float(values[k])
            if value > least:
                found = scipy.optimize.minimize(
                    at, box, method="L-BFGS-B", bounds=[(0.0, 1.0)] * box.size
                )
                box, value = found.x, float(found.fun)
            if value <= least:
                moved = np.abs(box - default)
                rows = zip(names, low + width * box, defaults[places], moved, strict=True)
                far = SAME * np.max(moved)
                return Deciding(
                    tuple((n, float(v), float(d)) for n, v, d, off in rows if off > far)
                )
        return None

    @cached_property
    def _places(self) -> dict[str, list[int]]:
        """The parameters and derivatives of signals to draw, with their indices."""
        exogenous, places, rates = self._system.exogenous, dict[str, list[int]](), {}
        for p in self._system.parameters:
            free = np.flatnonzero(p.low < p.high)
            places[p.name] = (exogenous.slices[p.name].start + free).tolist()
            for order in range(len(p.derivatives)):
                first = exogenous.rates[p.name].start + order * p.value.size
                rates[p.name + "'" * (order + 1)] = (first + free).tolist()
        return {name: drawn for name, drawn in (places | rates).items() if drawn}

    @cached_property
    def _members(self) -> list[tuple[FloatArray, FloatArray]]:
        if not self._places:
            return []
        random, (low, high) = np.random.default_rng(0), self._system.parameter_box
        defaults, members = self._system.parameter_values, []
        for number in range(MEMBERS):
            away = random.uniform(low, high) - defaults
            state = self._states[number % len(self._states)]
            for _ in range(TRIES):
                member = self._consistent(state, defaults + away)
                if member is not None:
                    members.append(member)
                    break
                away *= NEARER
        return members

    def _consistent(
        self, state: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """A consistent state near a state for other parameters; None if there is none."""
        try:
            consistent = self._manifold.project(state, parameters)
        except InconsistentStateError:
            return None
        fields = fields_at(self._system, consistent, parameters)
        is_finite = all(np.all(np.isfinite(field)) for field in fields.values())
        return (consistent, parameters) if is_finite else None
