"""Why a rollout ended early, in the words of the blocks."""

import numpy as np

from drake_dae.arrays import FloatArray, show
from drake_dae.errors import InconsistentStateError, NonFiniteError, SimulationError
from drake_dae.running.rollout.functions import LoopFunctions
from drake_dae.running.rollout.run import Ending, Problem, Run
from drake_dae.systems.blocks.failures import (
    endless_steps,
    no_step_leads_on,
    off_manifold,
    simulation_error,
    spoilt_step,
)
from drake_dae.systems.blocks.trials import STEPS


def failure_of(functions: LoopFunctions, problem: Problem, run: Run) -> SimulationError:
    """The exception that the same run of Drake's raises.

    Args:
        functions: The closed loop.
        problem: What was run.
        run: What it came to.
    """
    name, size = functions.loop.plant.get_name(), functions.loop.plant.dae.num_states
    state = run.state[:size]
    trial = _reason(functions, problem, run.trial_time, run.trial) if run.trial_time else None
    match run.ending:
        case Ending.OFF_MANIFOLD:
            try:
                problem.project(run.time, state)
            except InconsistentStateError as error:
                return off_manifold(run.time, state, error)
        case Ending.SLOW:
            return endless_steps(name, STEPS, run.mark, run.time, state)
        case Ending.SPOILT:
            return spoilt_step(name, run.time, run.next, state, str(trial or ""))
        case Ending.STUCK if trial is not None:
            return no_step_leads_on(name, run.time, state, trial, str(trial))
        case Ending.STUCK:
            return SimulationError(
                f"the simulation cannot go on at t = {run.time:.6g} s, state {show(state)}: no "
                "step, however short, is as accurate as it should be. Where the state grows "
                "without bound or a reference leaves what the robot can reach, change these; "
                "otherwise choose a lower accuracy",
                run.time,
                state,
            )
    reason = _reason(functions, problem, run.time, run.state) or trial
    if reason is not None:
        return reason
    return NonFiniteError(f"{name}: a signal has no value at t = {run.time:.6g} s", run.time, state)


def _reason(
    functions: LoopFunctions, problem: Problem, time: float, state: FloatArray
) -> SimulationError | None:
    """What is wrong at a time and state; None if nothing is."""
    loop, dae = functions.loop, functions.loop.plant.dae
    if not np.isfinite(state).all():
        return None
    x = state[: dae.num_states]
    moment = functions.signals.evaluate(np.array([time]))
    if not functions.signals.is_finite:
        return NonFiniteError(f"the reference is not finite at t = {time:g} s", time, moment[0])
    reference, moving, of_law = (values.copy() for values in moment)
    plant, law = problem.plant.copy(), problem.law.copy()
    if loop.exogenous is not None:
        plant[loop.plant.exogenous_places] = moving
        law[loop.controller.exogenous_places] = of_law
    measured = [functions.measured(state, problem.hold)] if loop.sensor is not None else []
    control = np.zeros(dae.num_controls)
    if functions.is_direct and not loop.controller.law.control_takes_force:
        measured = [np.zeros(dae.num_constraints)]
    elif functions.is_direct:
        measured = [functions.plant(x, control, plant)[1]]
    signals = {
        "state": dae.state_signals,
        "control": dae.control_signals,
        "reference": loop.controller.law.reference_signals,
        "measured_force": dae.constraint_input_signals,
    }
    integral = [functions.integral(state)] if functions.num_integrals else []
    control = functions.law(x, reference, *measured, *integral, law)[0]
    if not functions.law.is_valid:
        return simulation_error(functions.law.failure(), time, x, signals)
    if functions.limits is not None:
        control = np.clip(control, -functions.limits, functions.limits)
    functions.plant(x, control, plant)
    if not functions.plant.is_valid:
        return simulation_error(functions.plant.failure(), time, x, signals)
    return None
