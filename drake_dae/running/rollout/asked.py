"""A request for rollouts: the settings, and the decision on machine code."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arrays import FloatArray, by_columns
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.running.rollout.lanes import library as lanes
from drake_dae.running.rollout.problems import checked_times
from drake_dae.running.rollout.program import RolloutProgram, program_of
from drake_dae.running.rollout.run import Settings
from drake_dae.running.rollout.stepping import machine
from drake_dae.simulation.records.record import (
    Record,
    RecordAfter,
    computed_record,
    recorded_values,
)
from drake_dae.simulation.simulate import check_config
from drake_dae.trace.compiled import Compiled, attempts, check_choice

STAGES_PER_SECOND = 500
"""An estimate of the evaluations in a simulated second under error control."""

FASTER = 0.05
"""The time that runs side by side save per evaluation, over that of an interpreted one."""


@dataclass(frozen=True, eq=False)
class RolloutRequest:
    """The arguments of `run_loop`, checked.

    Attributes:
        program: The program.
        times: The times of the rows in s.
        choice: Whether to make machine code.
        settings: How to step.
        lasting: As of `run_loop`.
    """

    program: RolloutProgram
    times: FloatArray
    choice: Compiled
    settings: Settings
    lasting: float | None

    @classmethod
    def of(
        cls,
        loop: ClosedLoop | Diagram,
        times: ArrayLike,
        config: SimulatorConfig | None,
        compiled: Compiled | None,
        lasting: float | None,
        look: Callable[[RecordAfter], bool] | None = None,
    ) -> Self:
        """Checks the arguments of `run_loop`; errors as of `rollout`."""
        config = config or SimulatorConfig()
        check_config(config)
        program = program_of(loop)
        choice: Compiled = program.choice if compiled is None else compiled
        check_choice("rollout", choice)
        moments = checked_times(times)

        def look_at_rows(rows: Callable[[], FloatArray], context: Context | None) -> bool:
            if look is None:
                return False
            return look(lambda after: record_of(program, moments, rows(), after, context))

        settings = Settings.of(config, program.compiled.scale, look_at_rows)
        return cls(program, moments, choice, settings, lasting)

    def machine_code(self, program: RolloutProgram, count: int) -> machine.Library | None:
        """Returns a diagram as machine code, or None if compiling takes longer than it saves.

        Code that is already in the cache is used in any case, unless further runs will follow.
        """
        if self.choice is False:
            return None
        make = self._pays(program, count, 1.0)
        if program.library is None and (make or self.lasting is None):
            program.library = machine.load(program, self.choice, make)
        return program.library

    def lanes(self, program: RolloutProgram, count: int) -> lanes.Lanes | None:
        """Returns as `machine_code`, for runs side by side."""
        can_run = program.kept("can run side by side", lambda: lanes.can_run(program))
        make = self._pays(program, count, FASTER)
        if not can_run or not (make or self.lasting is None):
            return None
        return program.kept(f"lanes {make}", lambda: lanes.load(program, self.choice, make))

    def _pays(self, program: RolloutProgram, count: int, saved: float) -> bool:
        """Whether machine code pays that saves a fraction of each interpreted evaluation."""
        if self.choice is True:
            return True
        seconds = count * float(np.ptp(self.times)) if self.lasting is None else self.lasting
        calls = STAGES_PER_SECOND * seconds
        if self.settings.tableau is not None:
            calls = len(self.settings.tableau.b) / self.settings.longest * seconds
        calls += seconds * sum(1.0 / rate.period for rate in program.compiled.rates)
        tries = attempts("auto", program.num_operations)
        return any(each.make and saved * calls >= each.calls for each in tries)


def record_of(
    program: RolloutProgram,
    times: FloatArray,
    rows: FloatArray,
    after: float | None = None,
    context: Context | None = None,
) -> Record:
    """Returns the record of a run, or of its rows after a time in s."""
    times = times[: len(rows)]
    first = 0 if after is None else int(np.searchsorted(times, after, side="right"))
    columns, stop, signals = by_columns(rows[first:]), 0, {}
    for name, entries in program.signals.items():
        start, stop = stop, stop + len(entries)
        signals[name] = recorded_values(columns[start:stop].T, tuple(entries))
    return program.complete(computed_record(times[first:], signals), context)
