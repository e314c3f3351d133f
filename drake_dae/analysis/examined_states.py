"""The states that an analysis examines, and their description."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from drake_dae.analysis.tables import count_of
from drake_dae.arrays import FloatArray, numbers, unknown_name
from drake_dae.dae import DaeSystem, Manifold, Region
from drake_dae.errors import InconsistentStateError, ModelError

Bounds = Mapping[str, tuple[float, float]]
"""A region: state name -> (lowest, highest)."""

_NEIGHBOURS = 5
"""How many states are added close to the first given one, which may be a zero of a function."""


@dataclass(frozen=True, eq=False)
class ExaminedStates:
    """The states that an analysis starts from."""

    guesses: FloatArray
    num_given: int
    bounds: Bounds
    region: Region | None

    @classmethod
    def drawn(
        cls, system: DaeSystem, bounds: Bounds | None, count: int, random: np.random.Generator
    ) -> "ExaminedStates":
        """Draws random states in a region or around the nominal state, which comes first."""
        nominal = system.nominal_state
        drawn = nominal + system.spread_around(nominal) * random.standard_normal(
            (count, nominal.size)
        )
        if bounds is None:
            return cls(np.vstack([nominal, drawn]), 0, {}, None)
        region = _box(system, bounds)
        named = np.isfinite(region.low)
        low, high = region.low[named], region.high[named]
        drawn[:, named] = random.uniform(low, high, (count, low.size))
        guesses = np.vstack([np.clip(nominal, region.low, region.high), drawn])
        return cls(guesses, 0, bounds, region)

    @classmethod
    def given(
        cls, system: DaeSystem, states: ArrayLike, random: np.random.Generator
    ) -> "ExaminedStates":
        """Returns the states of the user and a few close to the first one."""
        rows = numbers(f"{system.name}: states", states)
        shape = (len(rows) if rows.ndim else 0, system.num_states)
        if rows.shape != shape or not rows.size or not np.all(np.isfinite(rows)):
            raise ModelError(
                f"{system.name}: states must be finite numbers of shape (k, {system.num_states}), "
                f"got {states!r}"
            )
        around = system.spread_around(rows[0]) * random.standard_normal((_NEIGHBOURS, shape[1]))
        return cls(np.vstack([rows, rows[0] + 0.1 * around]), len(rows), {}, None)

    def describe(self, count: int, noun: str) -> str:
        """Returns a text that says which states were examined."""
        if self.num_given:
            return f"{count_of(self.num_given, noun)} as given"
        region = f"with {self.describe_region()}" if self.bounds else "around the nominal one"
        left_out = len(self.guesses) - count
        missing = f"; {left_out} more were outside the domain or off N*" if left_out else ""
        return f"{count_of(count, noun)} {region}{missing}"

    def describe_region(self) -> str:
        """Returns the bounds as "x in [0, 1], ..."."""
        return ", ".join(f"{name} in [{a:g}, {b:g}]" for name, (a, b) in self.bounds.items())


def check_consistent(manifold: Manifold, states: FloatArray, projected: FloatArray) -> None:
    """Checks that the user's states are consistent and inside the domain of the system."""
    name = manifold.system.name
    for number, state in enumerate(states):
        if not manifold.is_consistent(state):
            residual = manifold.residual(state)
            worst = int(np.argmax(np.abs(residual)))
            raise InconsistentStateError(
                f"{name}: states[{number}] is not consistent: "
                f"{manifold.residual_signals[worst].name} = {residual[worst]:.3g}; project it, for "
                "example with `find_structure(system).manifold.project`",
                residual,
            )
        near = 1e-4 * np.maximum(np.abs(state), np.abs(projected).max(axis=0))
        if not np.any(np.all(np.abs(projected - state) <= near, axis=1)):
            raise ModelError(
                f"{name}: states[{number}] is outside the domain: functions of (1)-(3) are not "
                "finite there"
            )


def _box(system: DaeSystem, bounds: Bounds) -> Region:
    low, high = np.full(system.num_states, -np.inf), np.full(system.num_states, np.inf)
    names = [signal.name for signal in system.state_signals]
    for name, interval in bounds.items():
        if name not in names:
            raise ModelError(f"{system.name}: region: {unknown_name('state', name, names)}")
        pair = numbers(f"{system.name}: region: the bounds of '{name}'", interval)
        if pair[0] > pair[1]:
            raise ModelError(
                f"{system.name}: region: '{name}' needs the lowest and the highest value, got "
                f"{interval!r}"
            )
        low[names.index(name)], high[names.index(name)] = pair
    return Region(low, high)
