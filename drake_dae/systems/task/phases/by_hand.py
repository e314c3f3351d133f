"""Phases that also end by hand."""

from dataclasses import fields
from typing import Any, ClassVar

import casadi as ca

from drake_dae.systems.task.phases.phase import Moment, Phase

BY_HAND = "by_hand_"
"""Begins the names of the signals that end phases by hand."""


class _EndedByHand(Phase):
    """A phase that succeeds when it would, or when a signal comes."""

    by_hand: ClassVar[str]

    @property
    def signal(self) -> str:
        return self.by_hand

    def margin(self, now: Moment, contact_force: float) -> float:
        own = super().margin(now, contact_force)  # type: ignore[safe-super]
        found: float = ca.fmin(own, 0.5 - now.signal)
        return found


def ended_by_hand(phase: Phase, place: int) -> Phase:
    """A phase that also succeeds when the signal by_hand_<place> comes.

    Args:
        phase: A phase that waits for no signal.
        place: Its place in the task.
    """
    kind: Any = type(phase)
    made = type(kind)(kind.__name__, (_EndedByHand, kind), {"by_hand": f"{BY_HAND}{place}"})
    values = {one.name: getattr(phase, one.name) for one in fields(phase) if one.init}
    found: Phase = made(**values)
    return found
