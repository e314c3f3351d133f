"""Rollouts of a plant that Drake steps; one block computes everything else at a sample."""

from collections.abc import Callable
from copy import copy
from dataclasses import replace

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import stacked
from drake_dae.blocks.interpreted import run_interpreted
from drake_dae.blocks.stepping import Run, RunProblem, StepSettings
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


Call = Callable[..., list[FloatArray]]


def run_stepped(program: RolloutProgram, problem: RunProblem, settings: StepSettings) -> Run:
    """Makes a run of a diagram in which Drake steps one plant, and nothing has a continuous state.

    Drake's step is one more of the unrestricted updates of its instant: it takes the control that
    is computed, as these are, from the values before the sample.
    """
    plant, functions = program.drake, copy(program.functions)
    assert plant is not None
    context = plant.CreateDefaultContext()
    context.SetTime(float(problem.times[0]))
    plant.set_state(context, problem.held[program.drake_state])
    plant.ExecuteInitializationEvents(context)
    drake, reads = DrakeSteps(plant, context), []
    for name, (system, i) in program.stepped.items():
        local = plant.GetSubsystemContext(system, context)
        reads.append((program.held_places[name], system.get_output_port(i), local))
    first = reads[0][0].start
    number, rate = next((i, r) for i, r in enumerate(functions.rates) if first in r.places)
    calls: dict[str, Call] = program.kept("stepped", lambda: _calls_of(program))

    def update(
        time: float, state: FloatArray, held: FloatArray, *given: FloatArray
    ) -> list[FloatArray]:
        (control,) = calls["control"](time, state, held, *given)
        if not np.isfinite(control).all():
            return [np.full(len(rate.places), np.nan)]
        after = held.copy()
        (after[rate.places],) = calls[f"update_{number}"](time, state, held, *given)
        drake.step(time, control)
        for part, port, local in reads:
            after[part] = port.Eval(local)
        return [after[rate.places]]

    functions.buffered = {**functions.buffered, **calls, f"update_{number}": update}
    return run_interpreted(functions, problem, replace(settings, longest=np.inf))


def _calls_of(program: RolloutProgram) -> dict[str, Call]:
    """The functions of a program without a state as `StepFunctions.buffered`, in machine code."""
    block, held = program.block, program.block.held
    inputs = {
        "time": program.functions.columns[0],
        "held": stacked([each.symbol for each in held.values()]),
        "parameters": block.parameters,
        "noise": block.inputs["noise"],
    }
    none = np.zeros(block.inputs["noise"].numel())

    def call(name: str, values: list[ca.SX]) -> Call:
        function = TracedFunction(name, inputs, {"value": stacked(values)}, compiled=program.choice)
        assert function.function is not None  # Made here: several threads may share expressions.

        def called(
            time: float,
            state: FloatArray,
            held: FloatArray,
            parameters: FloatArray,
            noise: FloatArray = none,
        ) -> list[FloatArray]:
            return list(function.evaluate(time, held, parameters, noise))

        return called

    groups = block.rates().values()
    updates = [call("update", [held[name].next for name in names]) for names in groups]
    return {
        "row": call("row", [block.outputs[name] for name in program.signals]),
        "control": call("control", [block.outputs[CONTROL]]),
        **{f"update_{i}": update for i, update in enumerate(updates)},
    }
