"""Runs of a loop with some values of its variables, and their exact derivatives."""

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
    """Runs of a loop over the same times.

    A start that is off N*, as where a variable moves it or the wall, is brought to N* as each step
    of a run is; the derivatives are those of that, too.

    Attributes:
        loop: The loop.
        start, parameters: As of `start_values`, before.
        variables: What changes.
        times: When rows are written, in s.
        config: Drake's settings.
        seed: The seed of the noise.
        made: How many runs were made.
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
        """The run with some values of the variables.

        Raises:
            InconsistentStateError: There is no start on N*.
        """
        self.made += 1
        start, parameters, _ = self._begun(values)
        (found,) = run_loop(
            self.loop, start, parameters, self.times, config=self.config, seeds=self._seeds
        )
        return found

    def changes(self, values: FloatArray, names: Sequence[str]) -> dict[str, FloatArray]:
        """How signals of the run change with each variable.

        Args:
            values: The values of the variables.
            names: The names of the signals.

        Returns:
            Name -> changes, shape (n, j, k).

        Raises:
            ModelError: The run has no derivatives.
            InconsistentStateError: There is no start on N*.
            SimulationError: The run fails.
        """
        start, parameters, before = self._begun(values)
        given = start, parameters, self.times, self.config, self.seed
        chain = FunctionChain.of(self.loop, *given)
        chain = replace(chain, links=[*before, *chain.links])
        count = len(self.variables)
        of_start, of_parameters = np.zeros((count, start.size)), np.zeros((count, parameters.size))
        for i, one in enumerate(self.variables):
            if one.state >= 0:
                of_start[i, one.state] = 1.0
            of_parameters[i, list(one.places)] = 1.0
        rows = chain.forward(of_start, of_parameters)
        return {name: rows[:, :, chain.part(name)] for name in names}

    def shown(self, values: FloatArray) -> FloatArray:
        """The values of the variables at the start on N*, shape (n,)."""
        start, _, _ = self._begun(values)
        places = [one.state for one in self.variables]
        return np.where(np.array(places) >= 0, start[places], values)

    def put(self, values: FloatArray, context: Context) -> Context:
        """A context of the loop with some values of the variables."""
        program = program_of(self.loop)
        start, parameters, _ = self._begun(values)
        found, size = context.Clone(), program.size
        _, held = program.compiled.start(found)
        held[program.kept_places] = start[size:]
        program.compiled.set_context(found, context.get_time(), start[:size], held, parameters)
        return found

    @property
    def _seeds(self) -> list[Seed] | None:
        return None if self.seed is None else [self.seed]

    def _begun(self, values: FloatArray) -> tuple[FloatArray, FloatArray, list[ComputedFunction]]:
        """Start and parameters, and the functions that brought the start onto N*."""
        program = program_of(self.loop)
        start, parameters = self.start.copy(), self.parameters.copy()
        for one, value in zip(self.variables, values.tolist(), strict=True):
            if one.state >= 0:
                start[one.state] = value
            parameters[list(one.places)] = value
        held = np.zeros(program.compiled.sizes["held"])
        held[program.kept_places] = start[program.size :]
        state = start[: program.size]
        state, links = projected(program, float(self.times[0]), state, held, parameters)
        return np.concatenate([state, start[program.size :]]), parameters, links
