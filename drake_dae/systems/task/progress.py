"""How far a task is: what a context holds of it, and what is left of it as a record."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.layout import DerivativeLayout, Indices
from drake_dae.systems.blocks.feedback import Immutable
from drake_dae.systems.control.phase_change import PhaseChange
from drake_dae.systems.task.fade import fade

DONE, HELD = "done", "held"
"""What the record calls the time after the last phase, and after a reaction that ends the task."""


@dataclass(frozen=True, eq=False)
class ReferenceSegment:
    """The references from one change of phases on:

        R(t) = goal(t - t_0) + base + rate (t - t_0) + fade(t - t_0).

    Attributes:
        change: What began.
        layout: How the references of the law are stacked that acts.
        goal: References of the phase in s after its begin, zero where it names none.
        base, rate: Where and how fast the others go at last, shape (p,).
        faded: The factors of the polynomials that take over, see `fade`.
        over: How long they last, in s.
        origin: All outputs in m, with the distance, when it began.
    """

    change: PhaseChange
    layout: DerivativeLayout
    goal: Callable[[float], FloatArray]
    base: FloatArray
    rate: FloatArray
    faded: FloatArray
    over: float
    origin: FloatArray

    @classmethod
    def begin(
        cls,
        change: PhaseChange,
        layout: DerivativeLayout,
        goal: Callable[[float], FloatArray],
        named: Sequence[int],
        rate: FloatArray,
        present: FloatArray,
        over: float,
        origin: FloatArray,
    ) -> "ReferenceSegment":
        """The references that begin with present values and derivatives.

        Args:
            change: What begins.
            layout: How the references of the law are stacked that acts.
            goal: References of the phase, in s after its begin.
            named: Which outputs these are for.
            rate: How fast the other outputs go at last, shape (p,).
            present: R at the begin.
            over: How long it takes, in s.
            origin: The outputs in m at the begin.
        """
        lowest = layout.lowest
        has_rate = np.array(layout.degrees) > 0
        moving = np.where(has_rate, present[np.minimum(lowest + 1, present.size - 1)], 0.0)
        # With the mean of the two speeds on the way it does not swing over.
        base = present[lowest] + (moving - rate) * over / 2.0
        base[list(named)] = 0.0
        rate = rate.copy()
        rate[list(named)] = 0.0
        found = cls(change, layout, goal, base, rate, np.zeros((present.size, 1)), over, origin)
        offset = present - found._goal(0.0)
        return replace(found, faded=fade(offset, layout.degrees, over))

    def reference(self, time: float) -> FloatArray:
        """R at a time in s, shape (sum (mu_i + 1),)."""
        passed = time - self.change.time
        found = self._goal(passed)
        if passed < self.over:
            found += self.faded @ (passed / self.over) ** np.arange(self.faded.shape[1])
        return found

    def _goal(self, passed: float) -> FloatArray:
        found = self.goal(passed).copy()
        found[self.layout.lowest] += self.base + self.rate * passed
        for i, degree in enumerate(self.layout.degrees):
            if degree:
                found[self.layout.lowest[i] + 1] += self.rate[i]
        return found


@dataclass(frozen=True, eq=False)
class TaskProgress(Immutable):
    """What a context holds of a task.

    Attributes:
        segments: All that began; none before a run.
        step: When the step began that is being made, in s.
        felt: When the contact was felt last, in s.
        is_felt: Whether it has been felt since then.
    """

    segments: tuple[ReferenceSegment, ...] = ()
    step: float = -inf
    felt: float = -inf
    is_felt: bool = False

    @property
    def changes(self) -> tuple[PhaseChange, ...]:
        """The record of the task."""
        return tuple(segment.change for segment in self.segments)


def places_at(segments: Sequence[ReferenceSegment], times: FloatArray) -> Indices:
    """Which segment held at each time; at the moment of a change that before."""
    starts = [segment.change.time for segment in segments[1:]]
    return np.searchsorted(starts, times, side="left")
