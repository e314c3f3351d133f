"""What a task counts from sample to sample for the guards of its phases."""

from collections.abc import Sequence

import casadi as ca

from drake_dae.arrays import FloatArray
from drake_dae.systems.task.phases.guards import PhaseGuard
from drake_dae.systems.task.phases.phase import Moment, Phase


class GuardMemory:
    """Numbers from which guards are decided that one sample does not decide.

    They are the work since the phase began, where a guard watches it, and for each guard that takes
    several samples, in how many it has been at its largest value. All numbers may be expressions.

    Args:
        phases: All phases of the task.
        sample_period: In s.

    Attributes:
        size: How many numbers there are; 0 where one sample decides all guards.
    """

    def __init__(self, phases: Sequence[Phase], sample_period: float) -> None:
        self._works = int(any(guard.of == "work" for one in phases for guard in one.guards))
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
        found = [tally[0] + now.force * now.speed * self._period] if self._works else []
        found += [
            _counted(guard, count, getattr(now, guard.of))
            for guard, count in zip(phase.guards, counts, strict=True)
            if guard.samples > 1
        ]
        return found + [0.0] * (self.size - len(found))

    def _counts(self, phase: Phase, tally: Sequence[float] | FloatArray) -> list[float]:
        """For each guard, in how many samples it has been at its largest value."""
        found, place = list[float](), self._works
        for guard in phase.guards:
            counts = guard.samples > 1
            found.append(tally[place] if counts else 0.0)
            place += counts
        return found


def _counted(guard: PhaseGuard, count: float, value: float) -> float:
    """In how many consecutive samples a value has been at the largest one, with one more."""
    found: float = ca.if_else(value >= guard.most, count + 1, 0)
    return found


def _margin(guard: PhaseGuard, count: float, value: float) -> float:
    if guard.samples == 1:
        return guard.most - value
    return guard.samples - 0.5 - _counted(guard, count, value)
