"""The exceptions of rollouts that ended early, with the messages of the blocks."""

from collections.abc import Sequence

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.blocks.computations import HELD, PARAMETERS, STATE, TIME, Computations
from drake_dae.blocks.failures import (
    cannot_go_on,
    endless_steps,
    no_step_leads_on,
    off_manifold,
    simulation_error,
    spoilt_step,
)
from drake_dae.blocks.trials import PACE_STEPS
from drake_dae.errors import InconsistentStateError, NonFiniteError, SimulationError
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.run import Run, RunEnding, RunProblem
from drake_dae.systems.parameterized import ParameterizedSystem
from drake_dae.systems.plants.contract import Plant

STATES = (STATE, "estimated_state")
"""Arguments of a computation that are a state of the plant."""


def failure_of(program: RolloutProgram, problem: RunProblem, run: Run) -> SimulationError:
    """Returns the exception that the same run raises in Drake's Simulator.

    Args:
        program: The diagram.
        problem: The run.
        run: Its result.
    """
    if run.error is not None:
        return run.error
    name, state = program.name, run.state[program.plant]
    constants = run.held, problem.parameters
    trial = None
    if np.isfinite(run.trial_time):
        trial = _reason(program, run.trial_time, run.trial, *constants)
    match run.ending:
        case RunEnding.OFF_MANIFOLD:
            try:
                problem.project(run.time, run.state, run.held)
            except InconsistentStateError as error:
                return off_manifold(run.time, state, error)
        case RunEnding.SLOW:
            return endless_steps(name, PACE_STEPS, run.mark, run.time, state)
        case RunEnding.SPOILT:
            return spoilt_step(name, run.time, run.next, state, trial)
        case RunEnding.STUCK if trial is not None:
            return no_step_leads_on(name, run.time, state, trial)
        case RunEnding.STUCK:
            reason = "no step, however short, is as accurate as it should be"
            return cannot_go_on(run.time, state, reason, "choose a lower accuracy")
    failure = _reason(program, run.time, run.state, *constants) or trial
    if failure is not None:
        return failure
    return NonFiniteError(f"{name}: a signal has no value at t = {run.time:.6g} s", run.time, state)


def _reason(
    program: RolloutProgram,
    time: float,
    state: FloatArray,
    held: FloatArray,
    parameters: FloatArray,
) -> SimulationError | None:
    """Returns the failure of the first computation without a value; None if all have values."""
    if not np.isfinite(state).all():
        return None
    compiled = program.compiled
    for call in compiled.calls:
        function = call.computation.traced
        if function is None or len(function.input_names) != len(call.arguments):
            continue
        columns = compiled.arguments_of(call).call([time, state, held, parameters])
        arguments = [np.array(column)[:, 0] for column in columns]
        function.evaluate(*arguments)
        if function.is_valid:
            continue
        if TIME in call.computation.sources:
            return NonFiniteError(
                f"the reference is not finite at t = {time:g} s", time, function.outputs[0].copy()
            )
        x = _where(call.computation.sources, arguments, call.block, state)
        error = simulation_error(function.failure(), time, x, call.block.signals)
        given = dict(zip(call.computation.sources, arguments, strict=True))
        if not isinstance(call.block.system, ParameterizedSystem) or PARAMETERS not in given:
            return error
        values = {"parameters": given[PARAMETERS]}
        values |= {f"input {name}": given[name] for name in ("control",) if name in given}
        return call.block.system.explained(error, values)
    return None


def _where(
    sources: Sequence[str], arguments: Sequence[FloatArray], block: Computations, state: FloatArray
) -> FloatArray:
    """Returns the state among the arguments of a computation; without one, all states."""
    for name, values in zip(sources, arguments, strict=True):
        if name in STATES:
            return values
        if name == HELD and isinstance(block.system, Plant):
            return values[: block.system.dae.num_states]
    return state
