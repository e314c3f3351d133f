"""The log of a plant with opening contacts: its run and the current step."""

from dataclasses import dataclass, field

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.systems.blocks.dips import TOUCHING, lowest
from drake_dae.systems.plants.contact_events import ContactEvent
from drake_dae.systems.plants.unilateral.edges import until_passed

MARGIN = 1e-13
"""The rate of an opening contact above minus this, in m/s, is round-off."""


@dataclass
class RunLog:
    """The log of one run, in one context.

    Attributes:
        events: The events of contacts.
        time: The start time of the current step, in s.
        gaps, rates: The gaps and rates of all contacts then, in m and m/s; empty before a run.
        edges, edge_rates: The distances from edges and their rates then; see `Edges`.
        before: Time and state before the last reset.
        held: Whether the step began in the previous mode, with positive forces of all its contacts.
        pulled: The indices of contacts with negative force since then, after a jump of the control.
        waits: Whether the first step must choose the mode, with the control at its start.
    """

    events: list[ContactEvent] = field(default_factory=list)
    time: float = np.nan
    gaps: FloatArray = field(default_factory=lambda: np.zeros(0))
    rates: FloatArray = field(default_factory=lambda: np.zeros(0))
    edges: FloatArray = field(default_factory=lambda: np.zeros(0))
    edge_rates: FloatArray = field(default_factory=lambda: np.zeros(0))
    before: tuple[float, bytes] = (np.nan, b"")
    held: bool = False
    pulled: set[int] = field(default_factory=set)
    waits: bool = False


def clearance(log: RunLog, time: float, gaps: FloatArray, rates: FloatArray) -> FloatArray:
    """For each open contact a number that is positive until it penetrates.

    An opening contact has a gap of round-off size with any sign. A contact penetrates if its gap is
    smaller than at the start of the step, also if it increases again; or if the cubic in time
    through gaps and rates at both ends of the step has a negative minimum within the step.

    Args:
        log: The log at the start of the step.
        time: The time, in s.
        gaps, rates: The gaps and rates of the contacts then, in m and m/s.
    """
    clearances = np.maximum(gaps, rates + MARGIN)
    if not log.gaps.size:
        return clearances
    pierced = gaps < np.minimum(log.gaps, 0.0) - TOUCHING
    clearances[pierced] = gaps[pierced]
    dips = lowest(time - log.time, log.gaps, moving(log.rates), gaps, moving(rates))
    clearances[dips < -TOUCHING] = dips[dips < -TOUCHING]
    return clearances


def moving(rates: FloatArray) -> FloatArray:
    """Rates in m/s, those of round-off size as zero."""
    return np.where(np.abs(rates) < MARGIN, 0.0, rates)


def edges_passed(
    log: RunLog, time: float, on: FloatArray, edges: FloatArray, rates: FloatArray
) -> FloatArray:
    """The distances to edges, or their least values within the step where these are negative.

    Args:
        log: The log at the start of the step.
        time: The time, in s.
        on: As of `Feet`.
        edges, rates: The distances from edges and their rates at the time, in m and m/s.
    """
    until, speeds = until_passed(on, edges, rates)
    if not log.edges.size:
        return until
    first, first_speeds = until_passed(on, log.edges, log.edge_rates)
    dips = lowest(time - log.time, first, moving(first_speeds), until, moving(speeds))
    return np.where(dips < -TOUCHING, dips, until)
