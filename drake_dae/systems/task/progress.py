"""The progress of a task in a context, which is also its record."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any, Self

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.layout import DerivativeLayout, Indices
from drake_dae.systems.control.phase_change import PhaseChange
from drake_dae.systems.task.contacts.outputs import TaskOutputs
from drake_dae.systems.task.fade import fade

DONE, HELD = "done", "held"
"""Names in a record for the time after the last phase, and after a task that ended otherwise."""

LET_GO = 1e-3
"""A contact ceases to be felt this share below `contact_force`, so that a force that stays there,
apart from round-off, does not begin and cease to be felt all the time."""


@dataclass(frozen=True, eq=False)
class ReferenceSegment:
    """The references of one phase, from its start t_0 on:

        R(t) = goal(t - t_0) + base + rate (t - t_0) + fade(t - t_0).

    Attributes:
        change: The start of the phase.
        layout: The layout of the references of the active law.
        goal: The goals of the phase, zero for outputs without any.
        base, rate: The final values and rates of the other outputs, shape (p,).
        faded: The factors of the polynomials of `fade`.
        over: The duration of the fade, in s.
        origin: All outputs in m, including the distance, at t_0.
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
        """The references that start with the present values and derivatives.

        Args:
            change, layout, goal, over, origin: The attributes.
            named: The indices of the outputs with goals.
            rate: The final rates of the other outputs, shape (p,).
            present: R at the start.
        """
        lowest = layout.lowest
        has_rate = np.array(layout.degrees) > 0
        moving = np.where(has_rate, present[np.minimum(lowest + 1, present.size - 1)], 0.0)
        # With the mean of both rates during the fade, the outputs do not overshoot.
        base = present[lowest] + (moving - rate) * over / 2.0
        base[list(named)] = 0.0
        rate = rate.copy()
        rate[list(named)] = 0.0
        none = np.zeros((present.size, 1))
        segment = cls(change, layout, goal, base, rate, none, over, origin)
        offset = present - segment._goal(0.0)
        return replace(segment, faded=np.array(fade(offset, layout.degrees, over)))

    @property
    def law(self) -> int:
        """The number of the active law."""
        return int(self.change.in_contact)

    def reference(self, time: float) -> FloatArray:
        """R at a time in s, shape (sum (mu_i + 1),)."""
        passed = time - self.change.time
        reference = self._goal(passed)
        if passed < self.over:
            reference += self.faded @ (passed / self.over) ** np.arange(self.faded.shape[1])
        return reference

    def desired(self, columns: TaskOutputs, time: float) -> FloatArray:
        """The desired positions, forces and distances at a time in s, shape (columns.size,).

        Args:
            columns: The places of the outputs of each law among them.
            time: The time, in s.
        """
        desired = np.zeros(columns.size)
        desired[columns.of_law(self.law)] = self.reference(time)[self.layout.lowest]
        return desired

    def _goal(self, passed: float) -> FloatArray:
        reference = self.goal(passed).copy()
        reference[self.layout.lowest] += self.base + self.rate * passed
        for i, degree in enumerate(self.layout.degrees):
            if degree:
                reference[self.layout.lowest[i] + 1] += self.rate[i]
        return reference


@dataclass(frozen=True, eq=False)
class TaskProgress:
    """The progress of a task in a context.

    Attributes:
        segments: The references of all phases that began; empty before a run.
        step: The start time of the current step, in s.
        felt: The last time at which the contact was felt, in s.
        is_felt: Whether the contact is felt now.
    """

    segments: tuple[ReferenceSegment, ...] = ()
    step: float = -inf
    felt: float = -inf
    is_felt: bool = False

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self  # It never changes, so that contexts may share it.

    @property
    def changes(self) -> tuple[PhaseChange, ...]:
        """The starts of phases."""
        return tuple(segment.change for segment in self.segments)


def places_at(segments: Sequence[ReferenceSegment], times: FloatArray) -> Indices:
    """The index of the segment at each time; at the time of a change that before."""
    starts = [segment.change.time for segment in segments[1:]]
    return np.searchsorted(starts, times, side="left")
