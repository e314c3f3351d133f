"""A whole diagram as one function of start and parameters, without Drake in between."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError, SimulationError
from drake_dae.running.rollout.asked import RolloutRequest, record_of
from drake_dae.running.rollout.beside import run_beside
from drake_dae.running.rollout.changes import run_with_changes
from drake_dae.running.rollout.events import Seed
from drake_dae.running.rollout.failures import failure_of
from drake_dae.running.rollout.lanes.batch import run_briefly, run_many
from drake_dae.running.rollout.lanes.device import find_device, run_on_device
from drake_dae.running.rollout.problems import Problems, problems_of
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.run import Run, RunEnding, Settings, num_cores
from drake_dae.running.rollout.stepping import interpreted, machine
from drake_dae.running.rollout.stepping.functions import DiagramFunctions
from drake_dae.simulation.records.record import Record, RecordAfter
from drake_dae.trace.compiled import Compiled

SEVERAL = 8
"""So many runs go side by side; fewer go one after the other, with the bits of a single one."""

USUAL = 20_000
"""More steps than a run of a study takes, unless it diverges."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """A run of a closed loop, or of any diagram.

    Attributes:
        steps: How many steps it took.
        failure: Why it could not go on, with time and state; None if it came to its end.
        context: The diagram's context after the run, where blocks changed at moments that were
            found: contacts, and the phases of a task. None where there are no such blocks.
    """

    steps: int
    failure: SimulationError | None
    _program: RolloutProgram = field(repr=False)
    _times: FloatArray = field(repr=False)
    _rows: FloatArray = field(repr=False)
    context: Context | None = field(default=None, repr=False)

    @cached_property
    def record(self) -> Record:
        """Its signals at the given times, up to where it came."""
        return record_of(self._program, self._times, self._rows, context=self.context)

    def ended(self, failure: SimulationError) -> Self:
        """The same where it ended with a failure; its record goes up to the failure's time."""
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
    device: Literal["cpu", "cuda"] = "cpu",
) -> list[Rollout]:
    """Runs a diagram from one start or from thousands, without Drake, on all cores.

    It computes what `simulate` does: all blocks of the diagram that `compile_diagram` traces, and
    the projection onto N* at the start of each step. With fixed steps the record is Drake's, of
    states before their projection; under error control steps are those of DOP853 (Hairer, Norsett
    and Wanner, 1993), a thousandth of the accuracy each, and rows between them are on N*. Where a C
    compiler is found the whole diagram is machine code; otherwise a step is one call of CasADi.
    Where plant and law have the same numbers, the motion follows from what the law wants. A
    `ContactPlant` is stepped by Drake, and all else of a sample is one call; the record is that of
    `simulate`.

    Args:
        loop: The closed loop, as `make_closed_loop` or `build_scenario` returns it, or any diagram
            of blocks that can be traced: the record then has its vector-valued output ports. What
            is drawn or logged in it plays no part.
        starts: Where runs start, as `start_values` has it: the state, and what blocks hold; shape
            (n,) for all runs or (k, n).
        parameters: All parameters as `start_values` has them; shape (m,) for all runs or (k, m);
            the defaults of the diagram if None.
        times: When the record has rows, in s, from the start of the runs to their end, shape (j,).
        config: Drake's settings: with `use_error_control` the accuracy and the longest step,
            without it steps of max_step_size by the scheme. Drake's default if None.
        compiled: Whether to make machine code; the choice of the plant's system if None, and "auto"
            for a diagram. "auto" makes it if that pays for the runs at hand.
        seeds: The seed of the noise in each run, or name of a RandomSource -> its seed, for several
            of them; the same noise for all if None.
        device: "cuda" runs them on an NVIDIA GPU, by CuPy, one in each thread; those that fail, or
            that need more than the usual Newton steps, go on here.

    Returns:
        k runs: one for each start, row of parameters or seed. One that fails has its failure, and
        its record up to there.

    Raises:
        ModelError: Arguments have wrong shapes, or a block cannot be traced: its name and why; or
            there is no GPU, or the diagram does not run on it.
        InconsistentStateError: A start is not on N*.

    Warns:
        MachineCodeWarning: Machine code should be made and cannot be.
    """
    settings: dict[str, Any] = {"config": config, "compiled": compiled, "seeds": seeds}
    return run_loop(loop, starts, parameters, times, **settings, on_device=device == "cuda")


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
    on_device: bool = False,
) -> list[Rollout]:
    """`rollout`, where these runs may be some of many, and may be stopped.

    Args:
        lasting: How long all of them last together, in s. Then this alone decides on machine code,
            not what the cache has: the numbers are the same whenever they are computed. None if
            these are all.
        look: Called now and then with a function from a time in s, or None, to what a run has
            recorded later; whether to stop where it is. Its record goes up to there.
        on_device: Whether they run on a GPU.
    """
    if on_device:
        find_device()
    asked = RolloutRequest.of(loop, times, config, compiled, lasting, look)
    program = asked.program
    problems = problems_of(program, starts, parameters, asked.times, seeds)
    found: dict[int, Rollout] = {}
    for own, chosen in _kinds(program, problems):
        some = problems.chosen(chosen)
        code = asked.machine_code(own, len(problems))
        side_by_side = None
        if on_device:
            many = run_on_device(own, some, asked.settings)
            go_on = partial(machine.go_on, code) if code else _interpreted(own, asked.settings)
            for index, run in zip(chosen.tolist(), many.ended(go_on, 1), strict=True):
                found[index] = _result(program, problems, index, run)
            continue
        if code is not None and look is None and len(some) >= SEVERAL:
            side_by_side = asked.lanes(own, len(problems))
        runs = _runs(own, some, asked.settings, code, side_by_side)
        for index, run in zip(chosen.tolist(), runs, strict=True):
            found[index] = _result(program, problems, index, run)
    return [found[index] for index in range(len(problems))]


def run_together(
    loop: ClosedLoop,
    starts: ArrayLike,
    parameters: ArrayLike,
    times: ArrayLike,
    *,
    config: SimulatorConfig,
    seeds: Sequence[Seed],
    lasting: float,
) -> list[Rollout | None]:
    """What `run_loop` returns, of runs that come to their end side by side in a usual time.

    Returns:
        A run for each start; None for one that fails, that takes more than `USUAL` steps, or whose
        loop has no such machine code. These are left to `run_loop`.

    Raises:
        InconsistentStateError: A start is not on N*.
    """
    asked = RolloutRequest.of(loop, times, config, None, lasting)
    program = asked.program
    problems = problems_of(program, starts, parameters, asked.times, seeds)
    found: list[Rollout | None] = [None] * len(problems)
    for own, chosen in _kinds(program, problems):
        side_by_side = asked.lanes(own, len(problems)) if asked.machine_code(own, 1) else None
        if side_by_side is None:
            continue
        runs = run_briefly(side_by_side, own, problems.chosen(chosen), asked.settings, USUAL)
        for index, run in zip(chosen.tolist(), runs, strict=True):
            found[index] = _result(program, problems, index, run) if run is not None else None
    return found


def _kinds(program: RolloutProgram, problems: Problems) -> list[tuple[RolloutProgram, np.ndarray]]:
    """The runs in which plant and law have the same numbers, and the others; each its program."""
    has_twins = problems.with_twins()
    found = []
    if has_twins.any():
        found.append((program.twins, np.flatnonzero(has_twins)))
    if not has_twins.all():
        found.append((program, np.flatnonzero(~has_twins)))
    return found


def _interpreted(program: RolloutProgram, settings: Settings) -> Callable[..., Run]:
    """What runs a problem from its start, whatever it came to elsewhere."""
    functions = program.kept("functions", lambda: DiagramFunctions(program))
    return lambda problem, *state: interpreted.run(functions, settings, problem)


def _runs(
    program: RolloutProgram,
    problems: Problems,
    settings: Settings,
    code: machine.Library | None,
    side_by_side: machine.Library | None,
) -> list[Run]:
    """What runs come to, by machine code if there is any, and side by side if they can."""
    if code is not None and side_by_side is not None:
        return run_many(side_by_side, code, program, problems, settings)
    if code is None or program.compiled.changes or program.compiled.has_stepped:
        functions = program.kept("functions", lambda: DiagramFunctions(program))
        run = partial(interpreted.run, functions, settings)
    if code is not None:
        run = partial(machine.run, code, program, settings=settings)
    if program.compiled.changes:
        run = partial(run_with_changes, functions, run, settings.tableau)
    if program.compiled.has_stepped:
        run = partial(run_beside, functions, code, settings=settings)
    if code is None or len(problems) == 1 or program.compiled.has_stepped:
        return [run(problems[index]) for index in range(len(problems))]
    # Machine code lets go of Python's lock: threads are enough for all cores.
    with ThreadPoolExecutor(num_cores()) as pool:
        return list(pool.map(lambda index: run(problems[index]), range(len(problems))))


def _result(program: RolloutProgram, problems: Problems, index: int, run: Run) -> Rollout:
    failure = None
    if run.ending not in (RunEnding.DONE, RunEnding.PAUSED, RunEnding.STOPPED):
        failure = failure_of(program, problems[index], run)
    return Rollout(run.steps, failure, program, problems.times, run.rows, run.context)
