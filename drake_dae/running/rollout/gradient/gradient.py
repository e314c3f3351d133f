"""Exact derivatives of rollouts with fixed steps, in backward and in forward mode."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Diagram

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, numbers, unknown_name
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.rollout.asked import RolloutRequest
from drake_dae.running.rollout.events import Seed
from drake_dae.running.rollout.gradient.chain import ComputedFunction, ComputedFunctions
from drake_dae.running.rollout.problems import problems_of
from drake_dae.running.rollout.program import RolloutProgram
from drake_dae.running.rollout.rollout import Rollout, run_loop
from drake_dae.running.rollout.run import RunProblem


class RolloutGradient(NamedTuple):
    """The gradient of a cost J.

    Attributes:
        run: The run.
        start: dJ/dstart, in the form of the start, shape (n,).
        parameters: dJ/dparameters, gains of a law among them, shape (m,).
    """

    run: Rollout
    start: FloatArray
    parameters: FloatArray


@checked(ModelError)
def rollout_gradient(
    loop: ClosedLoop | Diagram,
    start: ArrayLike,
    parameters: ArrayLike | None,
    times: ArrayLike,
    weights: Mapping[str, ArrayLike],
    *,
    config: SimulatorConfig,
    seed: Seed | None = None,
) -> RolloutGradient:
    """The gradient of a cost by the start and all parameters, by one backward sweep (adjoint).

    The cost is J = sum of weights[signal] * record[signal] over all rows and entries; of another
    function of the record, the weights are its derivatives by the signals. The derivative is that
    of the steps that `rollout` takes, to round-off; projections onto N* and samples included.

    Args:
        loop, start, parameters, times: As of `rollout`, of one run.
        weights: Name of a signal -> numbers of the shape that the signal has in the record.
        config: Drake's settings, with fixed steps.
        seed: The seed of the noise, as of `rollout`.

    Raises:
        ModelError: The arguments do not fit; or steps are under error control, or blocks change at
            times to be located, as at impacts, where the state has no such derivative.
        InconsistentStateError: The start is not on N*.
        SimulationError: The run fails.
    """
    chain = FunctionChain.of(loop, start, parameters, times, config, seed)
    seeds = np.zeros((chain.problem.times.size, chain.program.width))
    for name, signal_weights in weights.items():
        part = chain.part(name)
        values = numbers(f"weights of '{name}'", signal_weights)
        if values.shape != seeds[:, part].shape:
            raise ModelError(
                f"weights of '{name}' must have the shape {seeds[:, part].shape} of this signal in "
                f"the record, got {values.shape}"
            )
        seeds[:, part] += values
    return RolloutGradient(chain.run, *chain.backward(seeds))


@checked(ModelError)
def rollout_tangent(
    loop: ClosedLoop | Diagram,
    start: ArrayLike,
    parameters: ArrayLike | None,
    times: ArrayLike,
    start_change: ArrayLike | None = None,
    parameter_change: ArrayLike | None = None,
    *,
    config: SimulatorConfig,
    seed: Seed | None = None,
) -> dict[str, FloatArray]:
    """The derivative of all signals along a change of start and parameters, forward.

    Args:
        loop, start, parameters, times: As of `rollout`, of one run.
        start_change: The change of the start, shape (n,); none if left out.
        parameter_change: The change of the parameters, shape (m,); none if left out.
        config, seed: As of `rollout_gradient`, also errors.

    Returns:
        Name of a signal -> its derivative, of the shape that the signal has in the record.
    """
    chain = FunctionChain.of(loop, start, parameters, times, config, seed)
    changes = []
    for what, given, size in (
        ("start_change", start_change, chain.size),
        ("parameter_change", parameter_change, chain.problem.parameters.size),
    ):
        change = np.zeros(size) if given is None else numbers(what, given)
        if change.shape != (size,):
            raise ModelError(f"{what} must have shape ({size},), got {change.shape}")
        changes.append(change[None])
    (rows,) = chain.forward(*changes)
    return {name: rows[:, chain.part(name)] for name in chain.program.signals}


@dataclass(frozen=True, eq=False)
class FunctionChain:
    """A run as a chain of differentiable functions.

    Attributes:
        program: The program.
        run: The run.
        problem: Its start, parameters and times.
        links: The functions in their order.
    """

    program: RolloutProgram
    run: Rollout
    problem: RunProblem
    links: Sequence[ComputedFunction]

    @classmethod
    def of(
        cls,
        loop: ClosedLoop | Diagram,
        start: ArrayLike,
        parameters: ArrayLike | None,
        times: ArrayLike,
        config: SimulatorConfig,
        seed: Seed | None,
    ) -> "FunctionChain":
        request = RolloutRequest.of(loop, times, config, None, None)
        program, settings = request.program, request.settings
        if settings.tableau is None:
            raise ModelError(
                "a gradient is that of fixed steps: choose use_error_control=False, a "
                "max_step_size and an explicit integration_scheme"
            )
        compiled = program.compiled
        if compiled.changes or compiled.has_stepped:
            raise ModelError(
                f"{program.name} has no gradient: a block changes at times that a run locates, as "
                "at impacts and openings, or Drake steps it"
            )
        seeds = None if seed is None else [seed]
        problems = problems_of(program, start, parameters, request.times, seeds)
        if len(problems) != 1:
            raise ModelError(f"a gradient is that of one run, got {len(problems)} starts")
        (run,) = run_loop(loop, start, parameters, times, config=config, seeds=seeds)
        if run.failure is not None:
            raise run.failure
        problem = problems[0]
        links = ComputedFunctions(program, problem, settings.tableau)
        links.run(settings.longest)
        return cls(program, run, problem, links.links)

    @property
    def size(self) -> int:
        """The number of entries of a start."""
        return self.program.size + int(self.program.kept_places.size)

    def part(self, name: str) -> slice:
        """Returns the columns of a signal in a row."""
        names = list(self.program.signals)
        if name not in names:
            raise ModelError(unknown_name("signal", name, names))
        stops = np.cumsum([0, *map(len, self.program.signals.values())]).tolist()
        index = names.index(name)
        return slice(stops[index], stops[index + 1])

    def forward(self, start: FloatArray, parameters: FloatArray) -> FloatArray:
        """Returns the changes of all rows, shape (k, j, width).

        Args:
            start, parameters: k changes of start and parameters, shapes (k, n) and (k, m).
        """
        count, size = len(start), self.program.size
        state, held = start[:, :size], np.zeros((count, self.problem.held.size))
        held[:, self.program.kept_places] = start[:, size:]
        rows = np.zeros((count, self.problem.times.size, self.program.width))
        for link in self.links:
            function = link.function.forward(count)
            change = function(*link.arguments, state, held, parameters)[1].copy()
            if link.kind == "row":
                rows[:, link.row] = change
            elif link.kind == "state":
                state = change
            else:
                held = change
        return rows

    def backward(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the gradient of the weighted rows with respect to start and parameters."""
        state, held = np.zeros(self.program.size), np.zeros(self.problem.held.size)
        parameters = np.zeros(self.problem.parameters.size)
        for link in reversed(self.links):
            if link.kind == "row":
                weights = rows[link.row]
            elif link.kind == "state":
                weights, state = state, np.zeros_like(state)
            else:
                weights, held = held, np.zeros_like(held)
            of_state, of_held, of_parameters = link.function.backward()(*link.arguments, weights)
            state, held = state + of_state, held + of_held
            parameters += of_parameters
        return np.concatenate([state, held[self.program.kept_places]]), parameters
