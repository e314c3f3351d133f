"""Runs of a plant that Drake steps, where one call computes everything else of a sample."""

import ctypes
from collections.abc import Callable

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.errors import SimulationError
from drake_dae.running.rollout.run import LOOKED, Run, RunEnding, RunProblem, Settings
from drake_dae.running.rollout.stepping.called import BufferedFunction
from drake_dae.running.rollout.stepping.functions import DiagramFunctions
from drake_dae.running.rollout.stepping.machine import Library
from drake_dae.systems.blocks.failures import cannot_go_on


def run_beside(
    functions: DiagramFunctions, code: Library | None, problem: RunProblem, settings: Settings
) -> Run:
    """Runs a diagram in which Drake steps one block, and no block has a continuous state.

    At each sample, the input of that block and the unrestricted updates are computed from the
    values before the sample. Then Drake steps the block, and then come the discrete updates. The
    rows of the record are computed at the end, from the values that were held.

    Args:
        functions: The diagram.
        code: Its machine code; None if there is none.
        problem: What to run.
        settings: Its `look` says whether to stop.
    """
    plant = _DrakeSteps(functions, problem)
    held, times, none = problem.held.copy(), problem.times, np.zeros(0)
    kept = np.empty((times.size, held.size))
    rows = count = 0
    ending, error, moment = RunEnding.DONE, None, float(times[0])
    take = _sampler(functions, code, problem, held)

    def written() -> FloatArray:
        states = np.zeros((rows, 0))
        return functions.rows(times[:rows], states, kept[:rows], problem.parameters)[0]

    while rows < times.size:
        at = problem.events[count] if count < problem.events.size else np.inf
        # A row has what was before the updates of its time.
        stop = int(np.searchsorted(times, at, side="right"))
        kept[rows:stop], rows = held, stop
        if rows == times.size:
            break
        if count % LOOKED == 0 and settings.look(written, problem.context):
            ending = RunEnding.PAUSED
            break
        moment, due = float(at), int(problem.due[count])
        try:
            good = take(moment, count, due, True, plant.input)
            if good and due & plant.bit:
                held[plant.places] = plant.after(moment)
            good = good and take(moment, count, due, False, plant.input)
        except SimulationError as found:
            ending, error = RunEnding.STUCK, found
            break
        except RuntimeError as found:  # Of Drake, as where its contact solver finds no step.
            state = held[plant.places]
            ending, error = RunEnding.STUCK, cannot_go_on(moment, state, str(found))
            break
        if not good:
            ending = RunEnding.INVALID
            break
        count += 1
    given = moment, none, held, count, count, moment, np.inf, 0.0, none
    return Run(written(), ending, *given, error=error)


class _DrakeSteps:
    """The block that Drake steps, in a context of its own."""

    def __init__(self, functions: DiagramFunctions, problem: RunProblem) -> None:
        compiled = functions.program.compiled
        rate, block = compiled.stepped
        assert block.stepped is not None
        stepped, system = block.stepped, block.stepped.system
        self.bit, self.places = 1 << compiled.rates.index(rate), list(rate.places)
        self._period = rate.period
        context: Context = system.CreateDefaultContext()
        context.SetTime(float(problem.times[0]))
        stepped.put(context, problem.held[dict(compiled.held)[block.system]])
        self._ports = [system.GetOutputPort(name) for name in stepped.ports]
        port = system.GetInputPort(stepped.into)
        self.input = np.zeros(port.size())
        self._port, self._context = port, context
        port.FixValue(context, self.input)
        self._simulator = Simulator(system, context)
        self._simulator.Initialize()

    def after(self, time: float) -> FloatArray:
        """What its ports show after the step at a time in s, with `input`."""
        self._port.FixValue(self._context, self.input)
        # Up to the next step, which Drake then makes first.
        self._simulator.AdvanceTo((round(time / self._period) + 1) * self._period)
        return np.concatenate([port.Eval(self._context) for port in self._ports])


def _sampler(
    functions: DiagramFunctions, code: Library | None, problem: RunProblem, held: FloatArray
) -> Callable[[float, int, int, bool, FloatArray], bool]:
    """A function that makes the updates in `held` and returns whether all values are valid.

    It takes the time, the number of the event, which rates are due, whether the updates are the
    unrestricted ones or the discrete ones, and an array for what Drake's block reads, which comes
    with the unrestricted ones.
    """
    compiled, parameters = functions.program.compiled, problem.parameters
    kinds = sum(
        1 << i
        for i, rate in enumerate(compiled.rates)
        if not rate.is_unrestricted and rate.stepped is None
    )
    if code is not None:
        call = code.sample
        array, number = ctypes.c_void_p, ctypes.c_longlong
        call.argtypes = (ctypes.c_double, *3 * (array,), number, ctypes.c_int, array)
        own, of_diagram = held.ctypes.data, parameters.ctypes.data
        first_noise, size = problem.noise.ctypes.data, problem.noise.strides[0]

        def sample(time: float, index: int, due: int, first: bool, into: FloatArray) -> bool:
            if not first and not due & kinds:
                return True
            drawn = first_noise + index * size
            return not call(time, own, of_diagram, drawn, due, first, into.ctypes.data)

        return sample
    read = BufferedFunction(compiled.stepped[0].function)

    def sample_slowly(time: float, index: int, due: int, first: bool, into: FloatArray) -> bool:
        valid, noise = np.zeros(1), problem.noise[index]
        if first:
            into[:], valid = read(time, np.zeros(0), held, parameters, noise)
        held[:] = functions.update(time, np.zeros(0), held, parameters, noise, due, first)
        return bool(np.isfinite(valid[0]) and np.isfinite(held).all())

    return sample_slowly
