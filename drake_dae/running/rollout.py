"""Rollouts: runs of a whole diagram without Drake's Simulator."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers
from drake_dae.blocks.failures import cannot_go_on
from drake_dae.blocks.interpreted import run_interpreted
from drake_dae.blocks.machine import run_alone, run_several
from drake_dae.blocks.stepping import Look, Run, RunEnding, RunProblem, StepSettings
from drake_dae.blocks.traced_system import TracedSystem, context_in
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.diagrams.record import Record, RecordAfter
from drake_dae.errors import DrakeDaeError, ModelError, SimulationError
from drake_dae.running.diagnosis import with_cause
from drake_dae.running.merged_run import NO_EVENTS, MergedRun
from drake_dae.running.rollout_program import MAKING, RolloutProgram, Seed, program_of
from drake_dae.running.simulate import check_config
from drake_dae.systems.plant import Plant
from drake_dae.trace.compiled import Compiled, check_choice

SEVERAL = 8  # The least number of runs that go side by side; fewer give the bits of single runs.
STAGES_PER_SECOND = 500  # An estimate of the evaluations in a simulated second under error control.
# The time that runs side by side save per evaluation, over that of an interpreted one.
FASTER = 0.05
LOOKED = 64  # The rows after which a run by Drake looks whether it diverges, or is to stop.
# The most failed runs of one call that Drake's Simulator continues to tell why they failed, and for
# how long under error control, in s.
DIAGNOSED, FARTHEST = 8, 0.1


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
        return self._program.record(self._times, self._rows)

    def ended(self, failure: SimulationError) -> Self:
        """The run as one that ended with a failure; its record ends at the failure."""
        stop = int(np.searchsorted(self._times[: len(self._rows)], failure.time, side="right"))
        return replace(self, failure=failure, _rows=self._rows[:stop])


@checked(ModelError)
def start_values(loop: ClosedLoop | Diagram, context: Context) -> tuple[FloatArray, FloatArray]:
    """Returns start and parameters of a closed loop, or of any diagram, for `rollout`.

    The start, shape (n,): the continuous states of all blocks in Drake's order, and then their
    discrete states, such as the last value of a sensor that samples. The numeric parameters,
    shape (m,): in a closed loop those of the plant, then of the law's model, and its gains.
    """
    program = program_of(loop)
    state, held, values = program.values_in(context)
    held = program.functions.begun(context.get_time(), state, held, values)
    return np.concatenate([state[: program.num_states], held[program.kept_places]]), values


@checked(ModelError, lasts=True)
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

    The results are those of `simulate`: the diagram becomes one block, as by `compile_diagram`, and
    the state is projected onto N* at the start of each step. With fixed steps, the record is
    Drake's, with states before their projection. Under error control, steps are those of DOP853
    (Hairer, Norsett and Wanner, 1993) with a thousandth of the accuracy as their error, and rows
    between them are on N*. If a C compiler is found, the whole diagram becomes machine code;
    otherwise CasADi interprets its functions. Drake steps a `ContactPlant`.

    Args:
        loop: The closed loop, or any diagram of blocks that can be traced; its record has the
            vector-valued output ports. Loggers and visualizers in it are ignored.
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
        k runs, in the order of starts. A run that fails has its failure, and its record ends there.

    Raises:
        ModelError: Shapes are wrong; or a block cannot be traced, with its name and the reason.
        InconsistentStateError: A start is not on N*.

    Warns:
        MachineCodeWarning: Machine code was requested, or would pay, and cannot be made.
    """
    more: dict[str, Any] = {"config": config, "compiled": compiled, "seeds": seeds}
    return run_loop(loop, starts, parameters, times, **more)


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

    `lasting` is the duration of all runs in s, if these are some of many: it alone then decides on
    machine code, whatever the cache contains, so that numbers do not depend on when they are
    computed. `look` is called from time to time with a function: time in s, or None -> the record
    after it; it returns whether to stop the run.
    """
    config = config or SimulatorConfig()
    check_config(config)

    def stop(rows: Callable[[], FloatArray]) -> bool:
        return look is not None and look(lambda after: program.record(moments, rows(), after))

    code, lanes = None, None
    with MAKING:
        program = program_of(loop)
        choice: Compiled = program.choice if compiled is None else compiled
        check_choice("rollout", choice)
        moments = numbers("times", times)
        if moments.ndim != 1 or moments.size < 2 or not np.isfinite(moments).all():
            raise ModelError(f"times must be two or more finite numbers, shape (j,), got {times!r}")
        if not (moments[1:] > moments[:-1]).all():
            raise ModelError("times must be strictly increasing")
        problems = program.problems(starts, parameters, moments, seeds)
        count, own = len(problems.state), problems
        kind, problems = program.for_numbers(problems)
        functions, settings = kind.functions, StepSettings.of(config, kind.functions, stop)
        calls: float = STAGES_PER_SECOND
        if settings.tableau is not None:
            calls = len(settings.tableau.b) / settings.longest
        calls += sum(1.0 / rate.period for rate in functions.rates)
        calls *= count * float(np.ptp(moments)) if lasting is None else lasting
        code = kind.machine_code(choice, calls, lasting is None)
        if code is not None and look is None and count >= SEVERAL:
            lanes = kind.machine_code(choice, FASTER * calls, lasting is None, several=True)
    each = [problems.run(i) for i in range(count)]
    if code is not None and lanes is not None:
        runs = run_several(lanes, code, problems, settings)
    elif code is not None:
        runs = run_alone(code, problems, settings)
    elif kind.drake is None:
        runs = [run_interpreted(functions, one, settings) for one in each]
    else:
        given = [{}] * count if seeds is None else [kind.seeds(seed) for seed in seeds]
        more = config, choice, settings.look
        runs = [_run_by_drake(kind, one, s, *more) for one, s in zip(each, given, strict=True)]
    failures = [
        i for i, run in enumerate(runs) if run.ending not in (RunEnding.DONE, RunEnding.PAUSED)
    ]
    with MAKING:
        reasons = {
            i: _failure(program, runs[i], own.run(i).parameters, config, n < DIAGNOSED)
            for n, i in enumerate(failures)
        }
    return [
        Rollout(run.steps, reasons.get(i), program, moments, run.rows) for i, run in enumerate(runs)
    ]


def _run_by_drake(
    program: RolloutProgram,
    problem: RunProblem,
    seeds: Mapping[str, int],
    config: SimulatorConfig,
    compiled: Compiled,
    look: Look,
) -> Run:
    """A run of a diagram with a plant that only Drake steps, by its Simulator."""
    context, rows = program.context.Clone(), list[FloatArray]()
    program.put(context, float(problem.times[0]), problem.state, problem.held, problem.parameters)
    for name, seed in seeds.items():
        source = program.sources[name]
        source.SetRandomContext(context_in(source, context), RandomGenerator(seed))
    assert program.drake is not None
    program.drake.ExecuteInitializationEvents(program.drake.GetMyMutableContextFromRoot(context))
    ending, error = RunEnding.DONE, None
    with MAKING:  # Its functions are made when they are called first.
        given = program.diagram, context, {n: program.ports[n] for n in program.signals}, compiled
        run: MergedRun = program.kept(f"merged {compiled}", lambda: MergedRun(*given))
        run.begin(context, config)
        try:
            for time in problem.times.tolist():
                rows.append(run.row(time))
                if len(rows) % LOOKED == 0 and look(lambda: np.array(rows)):
                    ending = RunEnding.PAUSED
                    break
        except DrakeDaeError:  # Whose reason the blocks as wired know.
            ending = RunEnding.INVALID
        except RuntimeError as raised:  # Of Drake's solver.
            ending, error = RunEnding.STUCK, raised
        run.write_back(0)
    table = np.array(rows).reshape(-1, program.functions.row.numel_out(0))
    state, held, _ = program.values_in(context)
    return Run(table, ending, context.get_time(), state, held, run.steps, error=error)


def _failure(
    program: RolloutProgram,
    run: Run,
    parameters: FloatArray,
    config: SimulatorConfig,
    is_diagnosed: bool,
) -> SimulationError:
    """What Drake's Simulator says where a run ended, from its last accepted state on."""
    plants = [s for s in program.composed.states if isinstance(s, Plant)]
    state = run.state[program.composed.states[plants[0]] if plants else slice(program.num_states)]
    if run.error is not None:
        return cannot_go_on(run.time, run.held[program.drake_state], str(run.error))
    reason = f"{program.name} has no value, or no step is as accurate as it should be"
    error = cannot_go_on(run.time, state, reason, "choose other steps")
    if not is_diagnosed:
        return error
    context, diagram, loop = program.context.Clone(), program.diagram, program.loop
    simulator = Simulator(diagram, context)
    ApplySimulatorConfig(config, simulator)  # It sets the time, too.
    program.put(context, run.time, run.state, run.held, parameters)
    seconds = FARTHEST if config.use_error_control else 2.0 * config.max_step_size
    try:
        simulator.Initialize(NO_EVENTS)
        for system in program.composed.systems:
            if isinstance(system, TracedSystem):
                system.begin_run(context_in(system, context))
        for port in program.ports.values():
            port.Eval(context)
        simulator.AdvanceTo(run.time + seconds)
    except SimulationError as raised:
        error = raised
    except RuntimeError as raised:
        error = cannot_go_on(run.time, state, str(raised))
    return with_cause(error, loop.plant, loop.controller) if isinstance(loop, ClosedLoop) else error
