"""Runs of a plant that Drake steps; one call computes all other blocks at a sample."""

import ctypes
from collections.abc import Callable

import numpy as np
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.blocks.failures import cannot_go_on
from drake_dae.compiler.called import BufferedFunction
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.compiler.drake_steps import DrakeSteps
from drake_dae.errors import SimulationError
from drake_dae.running.rollout.run import LOOKED, Run, RunEnding, RunProblem, Settings
from drake_dae.running.rollout.stepping.functions import DiagramFunctions
from drake_dae.running.rollout.stepping.machine import Library


def run_stepped(
    functions: DiagramFunctions, code: Library | None, problem: RunProblem, settings: Settings
) -> Run:
    """Runs a diagram in which Drake steps one block, and no block has a continuous state.

    At each sample, the input of that block and the unrestricted updates are computed from the
    values before the sample. Then Drake steps the block, and the discrete updates follow. The rows
    of the record are computed at the end, from the held values.

    Args:
        functions: The diagram.
        code: Its machine code; None if there is none.
        problem: The run.
        settings: Its `look` decides whether to stop.
    """
    compiled = functions.program.compiled
    rate, _ = compiled.stepped
    bit, (steps, given) = 1 << compiled.rates.index(rate), _steps(compiled, problem)
    held, times, none = problem.held.copy(), problem.times, np.zeros(0)
    stepped = held[rate.places[0] : rate.places[-1] + 1]
    held_of_rows = np.empty((times.size, held.size))
    rows = count = 0
    ending, error, moment = RunEnding.DONE, None, float(times[0])
    update = _updates(functions, code, problem, held)

    def record() -> FloatArray:
        states, values = np.zeros((rows, 0)), held_of_rows[:rows]
        return functions.rows(times[:rows], states, values, problem.parameters)[0]

    while rows < times.size:
        at = problem.events[count] if count < problem.events.size else np.inf
        # A row has the values before the updates of its time.
        stop = int(np.searchsorted(times, at, side="right"))
        held_of_rows[rows:stop], rows = held, stop
        if rows == times.size:
            break
        if count % LOOKED == 0 and settings.look(record):
            ending = RunEnding.PAUSED
            break
        moment, due = float(at), int(problem.due[count])
        try:
            is_valid = update(moment, count, due, True, given)
            if is_valid and due & bit:
                steps.step(moment, given, stepped)
            is_valid = is_valid and update(moment, count, due, False, given)
        except SimulationError as failure:
            ending, error = RunEnding.STUCK, failure
            break
        except RuntimeError as failure:  # Of Drake, as where its contact solver finds no step.
            state = stepped
            ending, error = RunEnding.STUCK, cannot_go_on(moment, state, str(failure))
            break
        if not is_valid:
            ending = RunEnding.INVALID
            break
        count += 1
    counts = count, count, moment, np.inf
    return Run(record(), ending, moment, none, held, *counts, 0.0, none, error=error)


def _steps(compiled: CompiledDiagram, problem: RunProblem) -> tuple[DrakeSteps, FloatArray]:
    """Returns the steps of what Drake steps, and an array for its input."""
    _, block = compiled.stepped
    assert block.stepped is not None
    stepped, system = block.stepped, block.stepped.system
    context: Context = system.CreateDefaultContext()
    context.SetTime(float(problem.times[0]))
    stepped.put(context, problem.held[dict(compiled.held)[block.system]])
    system.ExecuteInitializationEvents(context)
    return DrakeSteps(stepped, context), np.zeros(system.GetInputPort(stepped.into).size())


def _updates(
    functions: DiagramFunctions, code: Library | None, problem: RunProblem, held: FloatArray
) -> Callable[[float, int, int, bool, FloatArray], bool]:
    """Returns a function that makes updates in `held` and returns whether all values are valid.

    Its arguments are the time, the number of the event, the due rates, whether the updates are the
    unrestricted ones or the discrete ones, and an array for the input of Drake's block, which is
    written with the unrestricted ones.
    """
    compiled, parameters = functions.program.compiled, problem.parameters
    discrete = sum(1 << i for i, rate in enumerate(compiled.rates) if not rate.is_unrestricted)
    if code is not None:
        call = code.sample
        array, number = ctypes.c_void_p, ctypes.c_longlong
        call.argtypes = (ctypes.c_double, *3 * (array,), number, ctypes.c_int, array)
        addresses = held.ctypes.data, parameters.ctypes.data
        first_noise, size = problem.noise.ctypes.data, problem.noise.strides[0]

        def update(time: float, index: int, due: int, first: bool, into: FloatArray) -> bool:
            if not first and not due & discrete:
                return True
            noise = first_noise + index * size
            return not call(time, *addresses, noise, due, first, into.ctypes.data)

        return update
    read = BufferedFunction(compiled.stepped[0].function)

    def update_slowly(time: float, index: int, due: int, first: bool, into: FloatArray) -> bool:
        valid, noise = np.zeros(1), problem.noise[index]
        if first:
            into[:], valid = read(time, np.zeros(0), held, parameters, noise)
        held[:] = functions.update(time, np.zeros(0), held, parameters, noise, due, first)
        return bool(np.isfinite(valid[0]) and np.isfinite(held).all())

    return update_slowly
