"""Rollouts of a plant that Drake steps; one block computes everything else at a sample."""

from collections.abc import Sequence

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import stacked
from drake_dae.blocks.failures import cannot_go_on
from drake_dae.blocks.interpreted import LOOKED
from drake_dae.blocks.stepping import Run, RunEnding, RunProblem, StepSettings
from drake_dae.errors import SimulationError
from drake_dae.running.rollout_program import CONTROL, RolloutProgram
from drake_dae.trace.functions import TracedFunction


class DrakeSteps:
    """The steps of a plant, each as a forced update of the system that has a state.

    The states are those of a Simulator, bit by bit. A Simulator takes longer: at each step it
    collects the events of all systems, and copies all their states.
    """

    def __init__(self, plant: System, context: Context) -> None:
        port = plant.GetInputPort("control")
        self._context = context
        self._input = port.FixValue(context, np.zeros(port.size()))
        stated = [(plant, context)]
        if isinstance(plant, Diagram):
            parts = [(s, plant.GetMutableSubsystemContext(s, context)) for s in plant.GetSystems()]
            stated = [
                (part, local)
                for part, local in parts
                if local.num_discrete_state_groups() or local.num_abstract_states()
            ]
        self._part, self._local = stated[0] if len(stated) == 1 else (plant, context)

    def step(self, time: float, control: FloatArray) -> None:
        """Makes the step at a time in s; a RuntimeError of Drake where it finds none."""
        self._input.GetMutableData().get_mutable_value().SetFromVector(control)
        self._context.SetTime(time)
        self._part.ExecuteForcedEvents(self._local, False)


def _function(program: RolloutProgram, what: str, values: Sequence[ca.SX]) -> TracedFunction:
    functions = program.functions
    held = stacked([each.symbol for each in program.block.held.values()])
    inputs = {
        "time": functions.columns[0],
        "held": held,
        "parameters": program.block.parameters,
        "noise": program.block.inputs["noise"],
    }
    function = TracedFunction(what, inputs, {"value": stacked(values)}, compiled=program.choice)
    assert function.function is not None  # Made here: several threads may share expressions.
    return function


def run_stepped(program: RolloutProgram, problem: RunProblem, settings: StepSettings) -> Run:
    """Makes a run of a diagram in which Drake steps one plant, and nothing has a continuous state.

    At each sample, the control and the unrestricted updates are computed from the values before the
    sample. Then Drake steps the plant, and the discrete updates follow.
    """
    plant, rates, parameters = program.drake, program.functions.rates, problem.parameters
    assert plant is not None
    context = plant.CreateDefaultContext()
    context.SetTime(float(problem.times[0]))
    plant.set_state(context, problem.held[program.drake_state])
    plant.ExecuteInitializationEvents(context)
    drake = DrakeSteps(plant, context)
    reads = []
    for name, (system, i) in program.stepped.items():
        local = plant.GetSubsystemContext(system, context)
        reads.append((program.held_places[name], system.get_output_port(i), local))
    own = {place for part, *_ in reads for place in range(part.start, part.stop)}
    bit = next(1 << i for i, rate in enumerate(rates) if own & {*rate.places})
    groups = list(program.block.rates().values())

    def make() -> tuple[TracedFunction, TracedFunction, list[TracedFunction]]:
        held = program.block.held
        updates = [
            _function(program, "update", [held[name].next for name in names]) for names in groups
        ]
        row = _function(program, "row", [program.block.outputs[name] for name in program.signals])
        return row, _function(program, "control", [program.block.outputs[CONTROL]]), updates

    row, control, updates = program.kept("stepped", make)
    kept = [[p for p in rate.places if p not in own] for rate in rates]
    chosen = [[i for i, p in enumerate(rate.places) if p not in own] for rate in rates]
    held, times, noise = problem.held.copy(), problem.times, problem.noise
    rows, count, none = list[FloatArray](), 0, np.zeros(problem.noise.shape[1])
    moment = float(times[0])

    def ended(ending: RunEnding, error: Exception | None = None) -> Run:
        record = np.array(rows).reshape(-1, program.functions.row.numel_out(0))
        state = np.zeros(program.functions.size)
        return Run(record, ending, moment, state, held, count, error=error)

    def update(is_unrestricted: bool) -> bool:
        after, due = held.copy(), int(problem.due[count])
        for i, rate in enumerate(rates):
            if due >> i & 1 and rate.is_unrestricted == is_unrestricted and kept[i]:
                (values,) = updates[i].evaluate(moment, held, parameters, noise[count])
                if not updates[i].is_valid:
                    return False
                after[kept[i]] = values[chosen[i]]
        held[:] = after
        return True

    while True:
        at = float(problem.events[count]) if count < problem.events.size else np.inf
        # A row has the values before the updates of its time.
        while len(rows) < times.size and times[len(rows)] <= at:
            moment = float(times[len(rows)])
            (values,) = row.evaluate(moment, held, parameters, none)
            if not row.is_valid:
                return ended(RunEnding.INVALID)
            rows.append(values.copy())
        if len(rows) == times.size:
            return ended(RunEnding.DONE)
        if count % LOOKED == 0 and settings.look(lambda: np.array(rows)):
            return ended(RunEnding.PAUSED)
        moment = at
        try:
            (given,) = control.evaluate(moment, held, parameters, none)
            is_valid = control.is_valid and update(True)
            if is_valid and int(problem.due[count]) & bit:
                drake.step(moment, given)
                for part, port, local in reads:
                    held[part] = port.Eval(local)
            if not (is_valid and update(False)):
                return ended(RunEnding.INVALID)
        except SimulationError as failure:
            return ended(RunEnding.STUCK, failure)
        except RuntimeError as failure:  # Of Drake, as where its contact solver finds no step.
            error = cannot_go_on(moment, held[program.drake_state], str(failure))
            return ended(RunEnding.STUCK, error)
        count += 1
