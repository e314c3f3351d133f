"""Phases that a person can end by hand."""

from dataclasses import fields
from typing import Any, ClassVar

import casadi as ca

from drake_dae.systems.task.phases.phase import Moment, Phase

BY_HAND = "by_hand_"
"""The prefix of the names of the signals that end phases by hand."""


class _EndedByHand(Phase):
    """A phase that succeeds by its own condition, or when a signal exceeds 0.5."""

    by_hand: ClassVar[str]

    @property
    def signal(self) -> str:
        return self.by_hand

    def margin(self, now: Moment, contact_force: float) -> float:
        margin: float = super().margin(now, contact_force)  # type: ignore[safe-super]
        margin = ca.fmin(margin, 0.5 - now.signal)
        return margin


def ended_by_hand(phase: Phase, index: int) -> Phase:
    """Returns a copy of a phase that also succeeds when the signal by_hand_<index> exceeds 0.5.

    Args:
        phase: A phase that does not wait for a signal.
        index: Its index in the task.
    """
    kind: Any = type(phase)
    new_kind = type(kind)(kind.__name__, (_EndedByHand, kind), {"by_hand": f"{BY_HAND}{index}"})
    values = {field.name: getattr(phase, field.name) for field in fields(phase) if field.init}
    new_phase: Phase = new_kind(**values)
    return new_phase
