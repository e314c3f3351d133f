"""Why a rollout ended early, in the words of the blocks."""

from collections.abc import Sequence

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.errors import InconsistentStateError, NonFiniteError, SimulationError
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.run import Run, RunEnding, RunProblem
from drake_dae.systems.blocks.failures import (
    cannot_go_on,
    endless_steps,
    no_step_leads_on,
    off_manifold,
    simulation_error,
    spoilt_step,
)
from drake_dae.systems.blocks.traced import HELD, STATE, TIME, Block
from drake_dae.systems.blocks.trials import PACE_STEPS
from drake_dae.systems.plants.contract import Plant

STATES = (STATE, "estimated_state")
"""Where the argument of a computation comes from that says where the system is."""


def failure_of(program: RolloutProgram, problem: RunProblem, run: Run) -> SimulationError:
    """The exception that the same run of Drake's raises.

    Args:
        program: The diagram.
        problem: What was run.
        run: What it came to.
    """
    if run.error is not None:
        return run.error
    name, state = program.name, run.state[program.plant]
    given = run.held, problem.parameters
    trial = _reason(program, run.trial_time, run.trial, *given) if run.trial_time else None
    match run.ending:
        case RunEnding.OFF_MANIFOLD:
            try:
                problem.project(run.time, run.state, run.held)
            except InconsistentStateError as error:
                return off_manifold(run.time, state, error)
        case RunEnding.SLOW:
            return endless_steps(name, PACE_STEPS, run.mark, run.time, state)
        case RunEnding.SPOILT:
            return spoilt_step(name, run.time, run.next, state, str(trial or ""))
        case RunEnding.STUCK if trial is not None:
            return no_step_leads_on(name, run.time, state, trial, str(trial))
        case RunEnding.STUCK:
            reason = "no step, however short, is as accurate as it should be"
            return cannot_go_on(run.time, state, reason, "choose a lower accuracy")
    found = _reason(program, run.time, run.state, *given) or trial
    if found is not None:
        return found
    return NonFiniteError(f"{name}: a signal has no value at t = {run.time:.6g} s", run.time, state)


def _reason(
    program: RolloutProgram,
    time: float,
    state: FloatArray,
    held: FloatArray,
    parameters: FloatArray,
) -> SimulationError | None:
    """What is wrong at a time and state; None if nothing is."""
    if not np.isfinite(state).all():
        return None
    compiled = program.compiled
    for call in compiled.calls:
        function = call.computation.traced
        if function is None or len(function.input_names) != len(call.arguments):
            continue
        given = compiled.arguments_of(call)(time, state, held, parameters)
        arguments = [
            np.array(each)[:, 0] for each in (given if len(call.arguments) > 1 else [given])
        ]
        function.evaluate(*arguments)
        if function.is_valid:
            continue
        if call.block.failure is not None:
            return call.block.failure(time, arguments)
        if TIME in call.computation.sources:
            return NonFiniteError(
                f"the reference is not finite at t = {time:g} s", time, function.outputs[0].copy()
            )
        x = _where(call.computation.sources, arguments, call.block, state)
        return simulation_error(function.failure(), time, x, call.block.signals)
    return None


def _where(
    sources: Sequence[str], arguments: Sequence[FloatArray], block: Block, state: FloatArray
) -> FloatArray:
    """The state that a computation was given, or that of all if it was given none."""
    for name, given in zip(sources, arguments, strict=True):
        if name in STATES:
            return given
        if name == HELD and isinstance(block.system, Plant):
            return given[: block.system.dae.num_states]
    return state
