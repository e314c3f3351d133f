"""The exceptions of rollouts that ended early: the diagram as wired says what failed."""

import numpy as np
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.blocks.failures import (
    cannot_go_on,
    endless_steps,
    no_step_leads_on,
    off_manifold,
    spoilt_step,
)
from drake_dae.blocks.interpreted import PACE_STEPS
from drake_dae.blocks.stepping import Run, RunEnding, RunProblem
from drake_dae.errors import (
    DrakeDaeError,
    InconsistentStateError,
    NonFiniteError,
    SimulationError,
)
from drake_dae.running.rollout_program import RolloutProgram
from drake_dae.systems.plants.contract import Plant


def failure_of(program: RolloutProgram, problem: RunProblem, run: Run) -> SimulationError:
    """The exception that the same run raises in Drake's Simulator."""
    if isinstance(run.error, SimulationError):
        return run.error
    plants = [s for s in program.composed.states if isinstance(s, Plant)]
    state = run.state[program.composed.states[plants[0]] if plants else slice(program.num_states)]
    trial = None
    if np.isfinite(run.trial_time) and run.trial is not None:
        trial = _reason(program, run.trial_time, run.trial, run.held, problem.parameters)
    match run.ending:
        case RunEnding.OFF_MANIFOLD:
            try:
                program.functions.projected(run.time, run.state, run.held, problem.parameters)
            except InconsistentStateError as error:
                return off_manifold(run.time, state, error)
        case RunEnding.SLOW:
            return endless_steps(program.name, PACE_STEPS, run.mark, run.time, state)
        case RunEnding.SPOILT:
            return spoilt_step(program.name, run.time, run.next, state, trial)
        case RunEnding.STUCK if trial is not None:
            return no_step_leads_on(program.name, run.time, state, trial)
        case RunEnding.STUCK:
            reason = "no step, however short, is as accurate as it should be"
            return cannot_go_on(run.time, state, reason, "choose a lower accuracy")
    found = _reason(program, run.time, run.state, run.held, problem.parameters) or trial
    return found or NonFiniteError(
        f"{program.name}: a signal has no value at t = {run.time:.6g} s", run.time, state
    )


def _reason(
    program: RolloutProgram,
    time: float,
    state: FloatArray,
    held: FloatArray,
    parameters: FloatArray,
) -> SimulationError | None:
    """What the diagram as wired raises at these values, or within its next samples; or None."""
    if not np.isfinite(state).all():
        return None
    context, diagram = program.context.Clone(), program.diagram
    program.put(context, time, state, held, parameters)
    try:
        diagram.EvalTimeDerivatives(context)
        _evaluate_ports(program, context)
        if program.functions.rates:
            simulator = Simulator(diagram, context)
            simulator.Initialize(InitializeParams(suppress_initialization_events=True))
            simulator.AdvanceTo(time + 1e-6 * min(r.period for r in program.functions.rates))
            simulator.AdvancePendingEvents()
    except SimulationError as error:
        return error
    except (DrakeDaeError, RuntimeError):
        return None
    return None


def _evaluate_ports(program: RolloutProgram, context: Context) -> None:
    for port in program.ports.values():
        system = port.get_system()
        port.Eval(context if system is program.diagram else system.GetMyContextFromRoot(context))
