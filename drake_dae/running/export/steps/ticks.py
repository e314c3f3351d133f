"""The common tick of all rates of a diagram: each of its updates falls on one."""

from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from math import ceil, gcd
from typing import Self

from drake_dae.compiler.rates import UpdateRate
from drake_dae.errors import ModelError

FINEST = 1000
"""A tick is at least the shortest period over this."""

_SAME = 1e-9
"""Times that differ by less than this, in ticks, are one."""


@dataclass(frozen=True)
class Ticks:
    """When a step is due: at k period, k = 0, 1, ...; and which updates are due then.

    Attributes:
        period: In s.
        every, first: For each rate: it is due at ticks first, first + every, first + 2 every, ...
        rates: The period and the offset of each rate, in s.
    """

    period: float
    every: tuple[int, ...] = ()
    first: tuple[int, ...] = ()
    rates: tuple[tuple[float, float], ...] = ()

    @classmethod
    def of(cls, rates: tuple[UpdateRate, ...], alone: float = 0.0) -> Self:
        """The ticks of some rates, or of a single period where there are none.

        Raises:
            ModelError: There is no period, or periods and offsets have no common tick.
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
        """The first tick from a time in s on."""
        return ceil(time / self.period - _SAME)

    def time(self, tick: int) -> float:
        """The time of a tick in s, to the bit as Drake has it: offset + k period of a due rate."""
        found = tick * self.period
        for every, first, (period, offset) in zip(self.every, self.first, self.rates, strict=True):
            if tick >= first and (tick - first) % every == 0:
                found = offset + (tick - first) // every * period
        return found


def _fraction(time: float) -> Fraction:
    """The time in s that a user wrote; what was computed from such times has their round-off."""
    return Fraction(time).limit_denominator(10**9)


def _common(a: Fraction, b: Fraction) -> Fraction:
    return Fraction(
        gcd(a.numerator * b.denominator, b.numerator * a.denominator), a.denominator * b.denominator
    )
