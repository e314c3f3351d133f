"""The log of a plant with opening contacts: its run and the current step."""

from dataclasses import dataclass, field

import numpy as np

from drake_dae.arrays import Booleans, FloatArray, show
from drake_dae.errors import SimulationError
from drake_dae.systems.blocks.dips import TOUCHING, lowest
from drake_dae.systems.plants.contact_events import ContactEvent
from drake_dae.systems.plants.unilateral.edges import until_passed

MARGIN = 1e-13
"""The rate of an opening contact above minus this, in m/s, is round-off."""

CROWD, CROWDED = 1000, 1e-6
"""A run ends where so many events, and steps made shorter to find them, take less than this, s."""


@dataclass
class RunLog:
    """The log of one run, in one context.

    Attributes:
        events: The events of contacts.
        time: The start time of the current step, in s.
        gaps, rates: The gaps and rates of all contacts then, in m and m/s; empty before a run.
        edges, edge_rates: The distances from edges and their rates then; see `Edges`.
        margins: The values of all guards then; empty after a reset.
        passed: The guards that were not positive at a later trial; empty before the first trial.
        counts: The number of events and of steps made shorter to find them, from 1 to `CROWD` anew.
        mark, counted: The times of the first and the last of these, in s.
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
    margins: FloatArray = field(default_factory=lambda: np.zeros(0))
    passed: Booleans = field(default_factory=lambda: np.zeros(0, dtype=bool))
    counts: int = 0
    counted: float = np.nan
    mark: float = np.nan
    before: tuple[float, bytes] = (np.nan, b"")
    held: bool = False
    pulled: set[int] = field(default_factory=set)
    waits: bool = False

    def note(self, time: float, margins: FloatArray) -> None:
        """Notes the guards that are not positive at a trial within the current step.

        Args:
            time: The time of the trial, in s.
            margins: The values of all guards then.
        """
        if time > self.time:
            passed = margins <= 0.0
            self.passed = passed | self.passed if self.passed.size else passed

    def begin(self, name: str, margins: FloatArray, state: FloatArray) -> bool:
        """Begins a step at `time`, and returns whether no guard is zero there.

        Drake halves a step that passes the zero of a guard until it ends before the zero. In so
        short a step a slow motion changes positions by less than their round-off: the guard keeps
        its value, and such steps would follow without end. So a guard also counts as zero if it is
        within `TOUCHING`, and the last step brought it no nearer although a longer one passed it.

        Args:
            name: The name of the robot.
            margins: The values of all guards.
            state: The state.

        Raises:
            SimulationError: See `count`.
        """
        passed, is_zero = self.passed, margins <= 0.0
        self.passed = passed[:0]
        self.pulled.clear()
        if passed.any():
            self.count(name, self.time, state)
            if self.margins.size:
                is_zero |= passed & (margins <= TOUCHING) & (margins >= self.margins)
        self.margins = margins[:0] if is_zero.any() else margins.copy()
        return not is_zero.any()

    def count(self, name: str, time: float, state: FloatArray) -> None:
        """Counts an event, or a step that was made shorter to find one.

        Args:
            name: The name of the robot.
            time, state: The time in s and the state then.

        Raises:
            SimulationError: `CROWD` of them advanced the time by less than `CROWDED`.
        """
        if time != self.counted:  # Several guards may trigger at the same time.
            if self.counts in (0, CROWD):
                self.counts, self.mark = 0, time
            self.counts, self.counted = self.counts + 1, time
        if self.counts == CROWD and time - self.mark < CROWDED:
            raise SimulationError(
                f"{name}: the last {CROWD} steps led from t = {self.mark:.12g} s only to "
                f"{time:.12g} s, state {show(state)}, and all of them to events of contacts; take "
                "smaller coefficients of restitution or a larger settling_time",
                time,
                state,
            )


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
