"""The common period of all sample rates of a diagram: every update is at a multiple of it."""

from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from math import ceil, gcd
from typing import Self

from drake_dae.compiler.rates import UpdateRate
from drake_dae.errors import ModelError

FINEST = 1000
"""The largest ratio of the shortest sample period to the common period."""

_SAME = 1e-9
"""Times that differ by less than this, in common periods, count as equal."""


@dataclass(frozen=True)
class Ticks:
    """The sample instants of a controller: tick k is at the time k period, k = 0, 1, ...

    Attributes:
        period: The time between two ticks, in s.
        every, first: Rate i has updates at the ticks first[i] + j every[i], j = 0, 1, ...
        rates: The (period, offset) of each rate, in s.
    """

    period: float
    every: tuple[int, ...] = ()
    first: tuple[int, ...] = ()
    rates: tuple[tuple[float, float], ...] = ()

    @classmethod
    def of(cls, rates: tuple[UpdateRate, ...], alone: float = 0.0) -> Self:
        """Finds the ticks of some rates; without any rate, the period is `alone`.

        Raises:
            ModelError: Periods and offsets are no multiples of a common period.
        """
        if not rates:
            return cls(alone)
        periods = [_fraction(rate.period) for rate in rates]
        offsets = [_fraction(rate.offset) for rate in rates]
        tick = reduce(_common, [*periods, *offsets])
        if tick * FINEST < min(periods):
            times = ", ".join(f"{float(time):g} s" for time in sorted({*periods, *offsets} - {0}))
            raise ModelError(
                f"periods and delays have no common tick above {float(tick):g} s: {times}. Choose "
                "multiples of one period"
            )
        every = tuple(int(period / tick) for period in periods)
        first = tuple(int(offset / tick) for offset in offsets)
        own = tuple((rate.period, rate.offset) for rate in rates)
        return cls(float(tick), every, first, own)

    def at(self, time: float) -> int:
        """The first tick at or after a time in s."""
        return ceil(time / self.period - _SAME)

    def time(self, tick: int) -> float:
        """The time of a tick in s, equal to Drake's to the last bit: offset + k period."""
        time = tick * self.period
        for every, first, (period, offset) in zip(self.every, self.first, self.rates, strict=True):
            if tick >= first and (tick - first) % every == 0:
                time = offset + (tick - first) // every * period
        return time


def _fraction(time: float) -> Fraction:
    """The time in s as a fraction, without the round-off of computed times."""
    return Fraction(time).limit_denominator(10**9)


def _common(a: Fraction, b: Fraction) -> Fraction:
    return Fraction(
        gcd(a.numerator * b.denominator, b.numerator * a.denominator), a.denominator * b.denominator
    )
