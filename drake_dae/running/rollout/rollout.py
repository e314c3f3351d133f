"""Rollouts: runs of a whole diagram without Drake's Simulator."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, by_columns
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.record import (
    Record,
    RecordAfter,
    computed_record,
    recorded_values,
)
from drake_dae.errors import ModelError, SimulationError
from drake_dae.running.diagnosis import explained, too_long
from drake_dae.running.rollout.drake_stepped import run_stepped
from drake_dae.running.rollout.events import Seed
from drake_dae.running.rollout.failures import failure_of
from drake_dae.running.rollout.lanes import library
from drake_dae.running.rollout.lanes.batch import run_many
from drake_dae.running.rollout.lanes.library import Lanes
from drake_dae.running.rollout.problems import Problems, checked_times, problems_of
from drake_dae.running.rollout.program import MAKING, RolloutProgram, program_of
from drake_dae.running.rollout.run import Run, RunEnding, Settings, num_cores
from drake_dae.running.rollout.stepping import interpreted, machine
from drake_dae.running.rollout.stepping.functions import functions_of
from drake_dae.running.simulate import check_config
from drake_dae.trace.compiled import Compiled, attempts, check_choice

SEVERAL = 8
"""The least number of runs that go side by side; fewer give the bits of single runs."""

STAGES_PER_SECOND = 500
"""An estimate of the evaluations in a simulated second under error control."""

FASTER = 0.05
"""The time that runs side by side save per evaluation, over that of an interpreted one."""


DIAGNOSED = 8
"""The most failed runs of one call whose cause is looked for, which takes up to a second each."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """A run of a closed loop, or of any diagram.

    Attributes:
        steps: The number of its steps.
        failure: The reason of an early end, with time and state; None if it reached its end.
    """

    steps: int
    failure: SimulationError | None
    _program: RolloutProgram = field(repr=False)
    _times: FloatArray = field(repr=False)
    _rows: FloatArray = field(repr=False)

    @cached_property
    def record(self) -> Record:
        """The signals at the times of the rows, up to the end of the run."""
        return _record_of(self._program, self._times, self._rows)

    def ended(self, failure: SimulationError) -> Self:
        """Returns the run as one that ended with a failure; its record ends at the failure."""
        stop = int(np.searchsorted(self._times[: len(self._rows)], failure.time, side="right"))
        return replace(self, failure=failure, _rows=self._rows[:stop])


@checked(ModelError)
def rollout(
    loop: ClosedLoop | Diagram,
    starts: ArrayLike,
    parameters: ArrayLike | None,
    times: ArrayLike,
    *,
    config: SimulatorConfig | None = None,
    compiled: Compiled | None = None,
    seeds: Sequence[Seed] | None = None,
) -> list[Rollout]:
    """Runs a diagram from one start or from thousands, without Drake, on all cores.

    The results are those of `simulate`: all blocks that `compile_diagram` traces are evaluated, and
    the state is projected onto N* at the start of each step. With fixed steps, the record is
    Drake's, with states before their projection. Under error control, steps are those of DOP853
    (Hairer, Norsett and Wanner, 1993) with a thousandth of the accuracy as their error, and rows
    between them are on N*. If a C compiler is found, the whole diagram becomes machine code;
    otherwise CasADi interprets its functions. If the plant and the model of the law have equal
    parameters, the plant's acceleration is that which the law commands. Drake steps a
    `ContactPlant`, and one call computes all other blocks at a sample.

    Args:
        loop: The closed loop, as `make_closed_loop` or `build_scenario` returns it, or any diagram
            of blocks that can be traced; its record has the vector-valued output ports. Loggers and
            visualizers in it are ignored.
        starts: The states and discrete states at the start, as `start_values` returns them, shape
            (n,) for all runs or (k, n).
        parameters: All parameters, as `start_values` returns them, shape (m,) for all runs or
            (k, m); the defaults of the diagram if None.
        times: The times of the rows in s, from the start of the runs to their end, shape (j,).
        config: Drake's settings: with `use_error_control` the accuracy and the longest step,
            without it steps of max_step_size by the scheme. Drake's default if None.
        compiled: Whether to make machine code. "auto" makes it if that takes less time than it
            saves. The default is the choice of the plant's system, and "auto" for a diagram.
        seeds: The seed of the noise in each run, or name of a RandomSource -> seed; if None, all
            runs have the same noise.

    Returns:
        k runs: one for each start, row of parameters or seed. A run that fails has its failure, and
        its record ends there.

    Raises:
        ModelError: Arguments have wrong shapes; or a block cannot be traced, with its name and the
            reason.
        InconsistentStateError: A start is not on N*.

    Warns:
        MachineCodeWarning: Machine code was requested, or would pay, and cannot be made.
    """
    found = run_loop(loop, starts, parameters, times, config=config, compiled=compiled, seeds=seeds)
    if not isinstance(loop, ClosedLoop) or sum(r.failure is not None for r in found) > DIAGNOSED:
        return found
    return [diagnosed(loop, one, config) for one in found]


def diagnosed(loop: ClosedLoop, rollout: Rollout, config: SimulatorConfig | None = None) -> Rollout:
    """A rollout whose failure says its cause, as that of a simulation does."""
    if rollout.failure is None or not rollout.record.time.size:
        return rollout
    reference = None if loop.generator is None else loop.generator.reference
    start = float(rollout.record.time[0]), rollout.record["state"][0]
    structure = loop.controller.law.structure
    failure = explained(rollout.failure, loop.plant, structure, reference, start)
    if failure is rollout.failure:
        context = loop.diagram.CreateDefaultContext()
        loop.plant.set_state(loop.plant.GetMyMutableContextFromRoot(context), start[1])
        state = context.get_continuous_state_vector().CopyToVector()
        config = config or SimulatorConfig()
        failure = too_long(failure, loop.diagram, context, config, (start[0], state))
    return replace(rollout, failure=failure)


def run_loop(
    loop: ClosedLoop | Diagram,
    starts: ArrayLike,
    parameters: ArrayLike | None,
    times: ArrayLike,
    *,
    config: SimulatorConfig | None = None,
    compiled: Compiled | None = None,
    seeds: Sequence[Seed] | None = None,
    lasting: float | None = None,
    look: Callable[[RecordAfter], bool] | None = None,
) -> list[Rollout]:
    """Runs as `rollout`; the runs may be some of many, and may be stopped.

    Args:
        lasting: The total duration of all runs in s, if these are some of many. It alone then
            decides on machine code, whatever the cache contains: so the numbers do not depend on
            when they are computed. None if these are all.
        look: Called from time to time with a function: time in s, or None -> the record after it.
            Returns whether to stop the run; its record then ends there.
    """
    config = config or SimulatorConfig()
    check_config(config)
    with MAKING:
        program = program_of(loop)
        choice: Compiled = program.choice if compiled is None else compiled
        check_choice("rollout", choice)
        moments = checked_times(times)
        problems = problems_of(program, starts, parameters, moments, seeds)
        kinds = _kinds(program, problems)

    def stop(rows: Callable[[], FloatArray]) -> bool:
        if look is None:
            return False
        return look(lambda after: _record_of(program, moments, rows(), after))

    settings = Settings.of(config, program.compiled.scale, stop)
    seconds = len(problems) * float(np.ptp(moments)) if lasting is None else lasting
    rollouts: dict[int, Rollout] = {}
    for kind, indices in kinds:
        some = problems.chosen(indices)
        with MAKING:
            calls = seconds * _calls_per_second(kind, settings)
            code = _machine_code(kind, choice, calls, is_all=lasting is None)
            lanes = None
            if code is not None and look is None and len(some) >= SEVERAL:
                lanes = _lanes(kind, choice, FASTER * calls, is_all=lasting is None)
        for index, run in zip(
            indices.tolist(), _runs(kind, some, settings, code, lanes), strict=True
        ):
            rollouts[index] = _rollout(program, problems, index, run)
    return [rollouts[index] for index in range(len(problems))]


def _calls_per_second(program: RolloutProgram, settings: Settings) -> float:
    """The number of evaluations in a simulated second."""
    updates = sum(1.0 / rate.period for rate in program.compiled.rates)
    if settings.tableau is None:
        return STAGES_PER_SECOND + updates
    return len(settings.tableau.b) / settings.longest + updates


def _pays(program: RolloutProgram, choice: Compiled, calls: float) -> bool:
    """Whether machine code pays that saves so many interpreted evaluations."""
    tries = attempts("auto", program.num_operations)
    return choice is True or any(makes and calls >= least for least, makes in tries)


def _machine_code(
    program: RolloutProgram, choice: Compiled, calls: float, is_all: bool
) -> machine.Library | None:
    """Returns a diagram as machine code, or None if compiling takes longer than it saves.

    Code that is already in the cache is used in any case, unless further runs will follow.
    """
    if choice is False:
        return None
    make = _pays(program, choice, calls)
    if program.library is None and (make or is_all):
        program.library = machine.load(program, choice, make)
    return program.library


def _lanes(program: RolloutProgram, choice: Compiled, calls: float, is_all: bool) -> Lanes | None:
    """Returns as `_machine_code`, for runs side by side."""
    can_run = program.kept("can run side by side", lambda: library.can_run(program))
    make = _pays(program, choice, calls)
    if not can_run or not (make or is_all):
        return None
    return program.kept(f"lanes {make}", lambda: library.load(program, choice, make))


def _kinds(program: RolloutProgram, problems: Problems) -> list[tuple[RolloutProgram, np.ndarray]]:
    """Returns the runs in which plant and law have equal numbers, and the others, with programs."""
    has_twins, kinds = problems.with_twins(), []
    if has_twins.any():
        kinds.append((program.twins, np.flatnonzero(has_twins)))
    if not has_twins.all():
        kinds.append((program, np.flatnonzero(~has_twins)))
    return kinds


def _runs(
    program: RolloutProgram,
    problems: Problems,
    settings: Settings,
    code: machine.Library | None,
    lanes: Lanes | None,
) -> list[Run]:
    """Makes runs, by machine code if there is any, and side by side if there are lanes."""
    if code is not None and lanes is not None:
        return run_many(lanes, code, program, problems, settings)
    if code is not None:
        run = partial(machine.run, code, program, settings=settings)
    else:
        run = partial(interpreted.run, functions_of(program), settings)
    if program.compiled.has_stepped:
        run = partial(run_stepped, functions_of(program), code, settings=settings)
    if code is None or len(problems) == 1 or program.compiled.has_stepped:
        return [run(problems[index]) for index in range(len(problems))]
    # Machine code releases Python's lock: threads are enough for all cores.
    with ThreadPoolExecutor(num_cores()) as pool:
        return list(pool.map(lambda index: run(problems[index]), range(len(problems))))


def _rollout(program: RolloutProgram, problems: Problems, index: int, run: Run) -> Rollout:
    failure = None
    if run.ending not in (RunEnding.DONE, RunEnding.PAUSED):
        failure = failure_of(program, problems[index], run)
    return Rollout(run.steps, failure, program, problems.times, run.rows)


def _record_of(
    program: RolloutProgram,
    times: FloatArray,
    rows: FloatArray,
    after: float | None = None,
) -> Record:
    """Returns the record of a run, or of its rows after a time in s."""
    times = times[: len(rows)]
    first = 0 if after is None else int(np.searchsorted(times, after, side="right"))
    columns, stop, signals = by_columns(rows[first:]), 0, {}
    for name, entries in program.signals.items():
        start, stop = stop, stop + len(entries)
        signals[name] = recorded_values(columns[start:stop].T, tuple(entries))
    return program.complete(computed_record(times[first:], signals))
