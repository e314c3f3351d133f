"""Runs of a loop for given values of its variables, and their exact derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.running.rollout.events import Seed
from drake_dae.running.rollout.gradient.chain import ComputedFunction, projected
from drake_dae.running.rollout.gradient.gradient import FunctionChain
from drake_dae.running.rollout.program import program_of
from drake_dae.running.rollout.rollout import Rollout, run_loop
from drake_dae.studies.optimization.variables import Variable


@dataclass(eq=False)
class LoopRuns:
    """Runs of a loop over the same times, for given values of its variables.

    If the variables move the initial state or a surface, the initial state is projected onto N*,
    like the state after each step. The derivatives include this projection.

    Attributes:
        loop: The loop.
        start, parameters: The initial state and the parameters before, from `start_values`.
        variables: The variables.
        times: The times of the recorded rows, in s.
        config: Drake's settings.
        seed: The seed of the noise.
        made: The number of runs so far.
    """

    loop: ClosedLoop | Diagram
    start: FloatArray
    parameters: FloatArray
    variables: Sequence[Variable]
    times: FloatArray
    config: SimulatorConfig
    seed: Seed | None
    made: int = field(default=0, init=False)

    def run(self, values: FloatArray) -> Rollout:
        """Simulates the loop.

        Args:
            values: The values of the variables, shape (n,).

        Raises:
            InconsistentStateError: The initial state cannot be projected onto N*.
        """
        self.made += 1
        start, parameters, _ = self._initial(values)
        seeds = None if self.seed is None else [self.seed]
        (rollout,) = run_loop(
            self.loop, start, parameters, self.times, config=self.config, seeds=seeds
        )
        return rollout

    def changes(self, values: FloatArray, names: Sequence[str]) -> dict[str, FloatArray]:
        """The derivatives of signals of the run by each variable.

        Args:
            values: The values of the variables, shape (n,).
            names: The names of the signals.

        Returns:
            Name -> derivatives, shape (n, j, k).

        Raises:
            ModelError: The run has no derivatives.
            InconsistentStateError: The initial state cannot be projected onto N*.
            SimulationError: The run fails.
        """
        start, parameters, links = self._initial(values)
        chain = FunctionChain.of(self.loop, start, parameters, self.times, self.config, self.seed)
        chain = replace(chain, links=[*links, *chain.links])
        count = len(self.variables)
        of_start, of_parameters = np.zeros((count, start.size)), np.zeros((count, parameters.size))
        for i, variable in enumerate(self.variables):
            if variable.state >= 0:
                of_start[i, variable.state] = 1.0
            of_parameters[i, list(variable.places)] = 1.0
        rows = chain.forward(of_start, of_parameters)
        return {name: rows[:, :, chain.part(name)] for name in names}

    def projected_values(self, values: FloatArray) -> FloatArray:
        """The values of the variables after the projection of the initial state, shape (n,)."""
        start, _, _ = self._initial(values)
        states = np.array([variable.state for variable in self.variables])
        return np.where(states >= 0, start[states], values)

    def context_with(self, values: FloatArray, context: Context) -> Context:
        """A copy of a context of the loop, with the given values of the variables."""
        program = program_of(self.loop)
        start, parameters, _ = self._initial(values)
        changed, size = context.Clone(), program.size
        _, held = program.compiled.start(changed)
        held[program.kept_places] = start[size:]
        program.compiled.set_context(changed, context.get_time(), start[:size], held, parameters)
        return changed

    def _initial(self, values: FloatArray) -> tuple[FloatArray, FloatArray, list[ComputedFunction]]:
        """The projected initial state, the parameters, and the functions of the projection."""
        program = program_of(self.loop)
        start, parameters = self.start.copy(), self.parameters.copy()
        for variable, value in zip(self.variables, values.tolist(), strict=True):
            if variable.state >= 0:
                start[variable.state] = value
            parameters[list(variable.places)] = value
        held = np.zeros(program.compiled.sizes["held"])
        held[program.kept_places] = start[program.size :]
        state = start[: program.size]
        state, links = projected(program, float(self.times[0]), state, held, parameters)
        return np.concatenate([state, start[program.size :]]), parameters, links
