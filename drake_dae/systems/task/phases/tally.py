"""The sums and counts over samples for the guards of a task's phases."""

from collections.abc import Sequence

import casadi as ca

from drake_dae.arrays import FloatArray
from drake_dae.systems.task.phases.guards import PhaseGuard
from drake_dae.systems.task.phases.phase import Moment, Phase


class GuardMemory:
    """The numbers for guards that need more than one sample.

    They are the work since the phase began, if a guard watches it, and for each guard of several
    samples the number of consecutive samples at its limit. All numbers may be expressions.

    Args:
        phases: All phases of the task.
        sample_period: The sample period, in s.

    Attributes:
        size: The number of these numbers; 0 if one sample decides all guards.
    """

    def __init__(self, phases: Sequence[Phase], sample_period: float) -> None:
        self._works = int(any(guard.of == "work" for phase in phases for guard in phase.guards))
        counts = [sum(guard.samples > 1 for guard in phase.guards) for phase in phases]
        self._period, self.size = sample_period, self._works + max(counts, default=0)

    def work(self, tally: Sequence[float] | FloatArray) -> float:
        """The work so far, in J."""
        return tally[0] if self._works else 0.0

    def margins(
        self, phase: Phase, tally: Sequence[float] | FloatArray, now: Moment
    ) -> list[float]:
        """The margin of each guard of a phase, positive until it trips."""
        counts = self._counts(phase, tally)
        pairs = zip(phase.guards, counts, strict=True)
        return [_margin(guard, count, getattr(now, guard.of)) for guard, count in pairs]

    def after(self, phase: Phase, tally: Sequence[float] | FloatArray, now: Moment) -> list[float]:
        """The numbers after a sample in which the phase goes on."""
        counts = self._counts(phase, tally)
        numbers = [tally[0] + now.force * now.speed * self._period] if self._works else []
        numbers += [
            _counted(guard, count, getattr(now, guard.of))
            for guard, count in zip(phase.guards, counts, strict=True)
            if guard.samples > 1
        ]
        return numbers + [0.0] * (self.size - len(numbers))

    def _counts(self, phase: Phase, tally: Sequence[float] | FloatArray) -> list[float]:
        """For each guard the number of consecutive samples at its limit."""
        at_limit, place = list[float](), self._works
        for guard in phase.guards:
            counts = guard.samples > 1
            at_limit.append(tally[place] if counts else 0.0)
            place += counts
        return at_limit


def _counted(guard: PhaseGuard, count: float, value: float) -> float:
    """The number of consecutive samples at the limit after one more."""
    counted: float = ca.if_else(value >= guard.most, count + 1, 0)
    return counted


def _margin(guard: PhaseGuard, count: float, value: float) -> float:
    if guard.samples == 1:
        return guard.most - value
    return guard.samples - 0.5 - _counted(guard, count, value)
