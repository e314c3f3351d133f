"""What a plant whose contacts open and close knows of its run, and of the step that is made."""

from dataclasses import dataclass, field

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.systems.blocks.dips import TOUCHING, lowest
from drake_dae.systems.plants.contact_events import ContactEvent

MARGIN = 1e-13
"""How far below zero, in m/s, the rate of a contact that begins to leave is still round-off."""


@dataclass
class Log:
    """What is known of one run, in one context.

    Attributes:
        events: What happened to contacts.
        time: When the step began that is being made, in s.
        gaps, rates: Those of all contacts then, in m and m/s; empty before a run.
        before: Time and state before the last reset.
        held: Whether the step began in the mode of that before, with all its contacts pushing.
        pulled: The places of contacts that pull since then, by a control that jumped.
        waits: Whether the first step is to choose the mode, with the control that there is then.
    """

    events: list[ContactEvent] = field(default_factory=list)
    time: float = np.nan
    gaps: FloatArray = field(default_factory=lambda: np.zeros(0))
    rates: FloatArray = field(default_factory=lambda: np.zeros(0))
    before: tuple[float, bytes] = (np.nan, b"")
    held: bool = False
    pulled: set[int] = field(default_factory=set)
    waits: bool = False


def clearance(log: Log, time: float, gaps: FloatArray, rates: FloatArray) -> FloatArray:
    """For each contact a number that is positive until it would be pierced, if it is open.

    A contact that leaves has a gap of round-off, whatever its sign. One that is below where its
    step began is pierced, even where it comes out again; and so is one that came out within the
    step, by the cubic in time through gaps and rates at both ends.

    Args:
        log: What is known of the begin of the step.
        time: The time, in s.
        gaps, rates: Those of the contacts then, in m and m/s.
    """
    found = np.maximum(gaps, rates + MARGIN)
    if not log.gaps.size:
        return found
    pierced = gaps < np.minimum(log.gaps, 0.0) - TOUCHING
    found[pierced] = gaps[pierced]
    dips = lowest(time - log.time, log.gaps, log.rates, gaps, rates)
    found[dips < -TOUCHING] = dips[dips < -TOUCHING]
    return found
