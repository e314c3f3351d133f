"""The whole closed loop as one function of start and parameters, without Drake in between."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.analysis import SimulatorConfig

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError, SimulationError
from drake_dae.running.rollout import interpreted, machine
from drake_dae.running.rollout.failures import failure_of
from drake_dae.running.rollout.functions import LoopFunctions, loop_functions
from drake_dae.running.rollout.fused import Fused
from drake_dae.running.rollout.problems import checked_times, problems_of
from drake_dae.running.rollout.run import Ending, Problem, Run, Settings, num_cores
from drake_dae.simulation.records.record import Record, Recorded
from drake_dae.simulation.simulate import check_config
from drake_dae.trace.compiled import Compiled, attempts, check_choice

T = TypeVar("T")

STAGES_PER_SECOND = 500
"""About so many evaluations takes a simulated second under error control."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """A run of a closed loop.

    Attributes:
        steps: How many steps it took.
        failure: Why it could not go on, with time and state; None if it came to its end.
    """

    steps: int
    failure: SimulationError | None
    _functions: LoopFunctions = field(repr=False)
    _times: FloatArray = field(repr=False)
    _rows: FloatArray = field(repr=False)

    @cached_property
    def record(self) -> Record:
        """Its signals at the given times, up to where it came."""
        columns, loop = self._functions.columns, self._functions.loop
        stops = np.cumsum([len(signals) for signals in columns.values()])
        parts = dict(zip(columns, np.split(self._rows, stops[:-1], axis=1), strict=True))
        signals = {name: Recorded(parts[name], tuple(columns[name])) for name in loop.signals}
        return loop.with_errors(Record(self._times[: len(self._rows)], signals))


@checked(ModelError)
def rollout(
    loop: ClosedLoop,
    starts: ArrayLike,
    parameters: ArrayLike | None,
    times: ArrayLike,
    *,
    config: SimulatorConfig | None = None,
    compiled: Compiled | None = None,
    seeds: Sequence[int] | None = None,
) -> list[Rollout]:
    """Runs a closed loop from one start or from thousands, without Drake, on all cores.

    It computes what `simulate` does: plant, law with its integrals, limits of drives, references,
    exogenous signals and sensor, and the projection onto N* at the start of each step. With fixed
    steps the record is Drake's, of states before their projection; under error control steps are
    those of DOP853 (Hairer, Norsett and Wanner, 1993), a thousandth of the accuracy each, and rows
    between them are on N*. Where a C compiler is found the whole loop is machine code; otherwise a
    step is one call of CasADi. Where plant and law have the same numbers, the motion follows from
    what the law wants.

    Args:
        loop: The closed loop, as `make_closed_loop` or `build_scenario` returns it; what is drawn
            or logged in its diagram plays no part.
        starts: Where runs start, as `start_values` has it: the state, and what a sensor keeps;
            shape (n,), or (k, n) for k runs.
        parameters: All parameters as `start_values` has them: those of the plant and those of the
            law; shape (m,) for all runs or (k, m); the defaults of the loop if None.
        times: When the record has rows, in s, from the start of the runs to their end, shape (j,).
        config: Drake's settings: with `use_error_control` the accuracy and the longest step,
            without it steps of max_step_size by the scheme. Drake's default if None.
        compiled: Whether to make machine code; the choice of the plant's system if None. "auto"
            makes it if that pays for the runs at hand.
        seeds: The seed of the sensor's noise in each run; the same noise for all if None.

    Returns:
        A run for each start. One that fails has its failure, and its record up to there.

    Raises:
        ModelError: Arguments have wrong shapes, or a reference is no expression of time.
        InconsistentStateError: A start is not on N*.

    Warns:
        MachineCodeWarning: Machine code should be made and cannot be.
    """
    return run_loop(loop, starts, parameters, times, config=config, compiled=compiled, seeds=seeds)


def run_loop(
    loop: ClosedLoop,
    starts: ArrayLike,
    parameters: ArrayLike | None,
    times: ArrayLike,
    *,
    config: SimulatorConfig | None = None,
    compiled: Compiled | None = None,
    seeds: Sequence[int] | None = None,
    lasting: float | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> list[Rollout]:
    """`rollout`, where these runs may be some of many, and may be stopped.

    Args:
        lasting: How long all of them last together, in s. Then this alone decides on machine code,
            not what the cache has: the numbers are the same whenever they are computed. None if
            these are all.
        stop: Whether to stop where a run is, looked at now and then; its record goes up to there.
    """
    config = config or SimulatorConfig()
    check_config(config)
    choice: Compiled = loop.plant.dae.compiled if compiled is None else compiled
    check_choice("rollout", choice)
    moments = checked_times(times)
    functions = functions_of(loop)
    scale = np.ones(functions.size)
    scale[: loop.plant.dae.num_states] = loop.plant.dae.scale
    settings = Settings.of(config, scale, stop)
    problems = problems_of(functions, starts, parameters, moments, seeds)
    seconds = len(problems) * float(np.ptp(moments)) if lasting is None else lasting
    kinds = [_is_model(loop, problem) for problem in problems]
    found: dict[int, Rollout] = {}
    for kind in set(kinds):
        chosen = [index for index, each in enumerate(kinds) if each is kind]
        functions = functions_of(loop, kind)
        code = _machine_code(functions, choice, settings, seconds, look=lasting is None)
        runs = _runs(functions, [problems[index] for index in chosen], settings, code)
        for index, run in zip(chosen, runs, strict=True):
            found[index] = _result(functions, problems[index], run)
    return [found[index] for index in range(len(problems))]


def _runs(
    functions: LoopFunctions,
    problems: Sequence[Problem],
    settings: Settings,
    code: machine.Library | None,
) -> list[Run]:
    """What runs come to, by machine code if there is any."""
    if code is None:
        fused = _kept(functions, "fused", lambda: Fused(functions))
        run = interpreted.runner(fused, settings)
        return [run(problem) for problem in problems]
    if len(problems) == 1:
        return [machine.run(code, functions, problems[0], settings)]
    # Machine code lets go of Python's lock: threads are enough for all cores.
    with ThreadPoolExecutor(num_cores()) as pool:
        return list(
            pool.map(lambda problem: machine.run(code, functions, problem, settings), problems)
        )


def functions_of(loop: ClosedLoop, is_model: bool = False) -> LoopFunctions:
    """The functions of a closed loop, traced once.

    Args:
        loop: The closed loop.
        is_model: Whether plant and law have the same numbers; see `LoopFunctions`.

    Raises:
        ModelError: The loop has what no rollout has.
    """
    memory, name = loop.memory, f"functions {is_model}"
    if name not in memory:
        memory[name] = (
            replace(functions_of(loop), is_model=True) if is_model else loop_functions(loop)
        )
    found: LoopFunctions = memory[name]
    return found


def _is_model(loop: ClosedLoop, problem: Problem) -> bool:
    """Whether the plant of a run is the law's own model, with the same numbers."""
    if loop.plant.dae is not loop.controller.law.system:
        return False
    same = problem.plant == problem.law[: problem.plant.size]
    same[loop.plant.exogenous_places] = True
    return bool(same.all())


def _kept(functions: LoopFunctions, name: str, make: Callable[[], T]) -> T:
    """What is made once for the functions of a loop."""
    memory, key = functions.loop.memory, f"{name} {functions.is_model}"
    if key not in memory:
        memory[key] = make()
    found: T = memory[key]
    return found


def _machine_code(
    functions: LoopFunctions,
    compiled: Compiled,
    settings: Settings,
    seconds: float,
    look: bool = True,
) -> machine.Library | None:
    """The closed loop as machine code, by the choice and by what its runs take without.

    Where it does not pay to make it, the cache is looked into if `look` says so.
    """
    if compiled is False:
        return None
    name = f"library {functions.is_model}"
    kept: machine.Library | None = functions.loop.memory.get(name)
    if kept is not None:
        return kept
    make = True
    if compiled == "auto":
        stages = STAGES_PER_SECOND
        if settings.tableau is not None:
            stages = int(len(settings.tableau.b) / settings.longest)
        pays = attempts("auto", functions.num_operations)
        make = any(each.make and stages * seconds >= each.calls for each in pays)
        if not (make or look):
            return None
    found = machine.load(functions, compiled, make)
    if found is not None:
        functions.loop.memory[name] = found
    return found


def _result(functions: LoopFunctions, problem: Problem, run: Run) -> Rollout:
    failure = None
    if run.ending not in (Ending.DONE, Ending.PAUSED):
        failure = failure_of(functions, problem, run)
    return Rollout(run.steps, failure, functions, problem.times, run.rows)
