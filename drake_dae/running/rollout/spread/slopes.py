"""The slopes of a period of a sampled loop: A, B, C and D, by differences."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.errors import ModelError
from drake_dae.running.rollout.run import Run, RunEnding, RunProblem, Settings
from drake_dae.running.rollout.spread.recursion import Step
from drake_dae.running.rollout.stepping.functions import DiagramFunctions
from drake_dae.running.rollout.stepping.interpreted import run

_CHANGE, _LEAST = 1e-6, 1e-2
"""The change of a value for a difference, relative to its size, of which the least is 0.01."""

_OF_NOISE = 1e-3
"""The change of a random number for a difference, relative to its deviation."""


def undisturbed(functions: DiagramFunctions, settings: Settings, problem: RunProblem) -> Run:
    """A run to its end.

    Raises:
        ModelError: It ends early.
    """
    done = run(functions, settings, problem)
    if done.ending != RunEnding.DONE:
        raise ModelError(
            f"{functions.program.name} has no spread by noise: its run without noise ends at "
            f"{done.time:.6g} s"
        )
    return done


class PeriodSlopes:
    """The slopes of states and held values after a period, and of signals, by these and by noise.

    A period is a chain of updates, each with its random numbers, of flows between them, and of a
    row of signals at its end. Each of them is differentiated for itself, and the slopes multiply.

    Args:
        functions: The diagram.
        settings: How to step.
        problem: A run of one period, from its state, with the mean random numbers.
        deviations: The deviations of the random numbers.
        positions: Those signals whose slopes are wanted before each update, too.

    Attributes:
        read: Their slopes before each update, by states and held values, and by random numbers of
            deviation 1, shape (updates, positions, columns of A and B).
    """

    def __init__(
        self,
        functions: DiagramFunctions,
        settings: Settings,
        problem: RunProblem,
        deviations: FloatArray,
        positions: slice | None = None,
    ) -> None:
        self._functions, self._settings, self._problem = functions, settings, problem
        self._deviations, self._positions = deviations, positions
        self.read: list[FloatArray] = []
        self._time, self._state, self._held = problem.times[0], problem.state, problem.held
        size, count = problem.state.size, problem.state.size + problem.held.size
        columns = count + problem.noise.size
        self._of_state, self._of_held = np.split(np.eye(count, columns), [size])

    def step(self) -> Step:
        """A, B, C and D; B and D by random numbers of deviation 1, from the first update on."""
        problem = self._problem
        width = problem.noise.shape[1] if problem.noise.ndim == 2 else 0
        moments = zip(problem.events.tolist(), problem.due.tolist(), strict=True)
        for index, (moment, due) in enumerate(moments):
            self._flow(moment)
            if self._positions is not None:
                self.read.append(self._shown()[self._positions])
            before, of_before = self._state, self._of_state
            self._project()
            first = self._state.size + self._held.size + index * width
            columns, noise = slice(first, first + width), problem.noise[index]
            self._update(due, before, of_before, columns, noise, is_unrestricted=True)
            self._update(due, self._state, self._of_state, columns, noise, is_unrestricted=False)
        self._flow(float(problem.times[-1]))
        self._project()
        of_inputs = np.vstack([self._of_state, self._of_held])
        (a, b), (c, d) = (
            np.split(each, [len(of_inputs)], axis=1) for each in (of_inputs, self._shown())
        )
        return a, b, c, d

    def _shown(self) -> FloatArray:
        """The slopes of the signals."""
        size, function = self._state.size, self._functions.rows
        inputs = np.concatenate([self._state, self._held])

        def rows(values: FloatArray) -> FloatArray:
            states, held = np.split(values, [size], axis=1)
            times = np.full(len(values), self._time)
            return function(times, states, held, self._problem.parameters)[0]

        slopes = _slopes(rows, inputs, _changes(inputs))[1]
        return slopes @ np.vstack([self._of_state, self._of_held])

    def _update(
        self,
        due: int,
        state: FloatArray,
        of_state: FloatArray,
        columns: slice,
        noise: FloatArray,
        *,
        is_unrestricted: bool,
    ) -> None:
        """Makes the updates of one kind that are due, from a state."""
        if not self._functions.updates_are_due(due, is_unrestricted):
            return
        sizes = [state.size, state.size + self._held.size]
        inputs = np.concatenate([state, self._held, noise])
        changes = np.concatenate([_changes(inputs[: sizes[1]]), _OF_NOISE * self._deviations])
        fixed = self._time, self._problem.parameters, due, is_unrestricted

        def updated(values: FloatArray) -> FloatArray:
            return self._functions.updates(*fixed, *np.split(values, sizes, axis=1))

        # A random number without a deviation is a number that is not drawn.
        changes[changes == 0.0] = 1.0
        self._held, slopes = _slopes(updated, inputs, changes)
        by_values, by_noise = np.split(slopes, [sizes[1]], axis=1)
        self._of_held = by_values @ np.vstack([of_state, self._of_held])
        self._of_held[:, columns] += by_noise * self._deviations

    def _project(self) -> None:
        """Projects the state onto N*."""
        if not self._functions.program.compiled.projects:
            return
        size, inputs = self._state.size, np.concatenate([self._state, self._held])

        def projected(values: FloatArray) -> FloatArray:
            states, held = np.split(values, [size], axis=1)
            times = np.full(len(values), self._time)
            return self._functions.projections(times, states, held, self._problem.parameters)[0]

        self._state, slopes = _slopes(projected, inputs, _changes(inputs))
        self._of_state = slopes @ np.vstack([self._of_state, self._of_held])

    def _flow(self, end: float) -> None:
        """Goes on to a time."""
        start, self._time = self._time, end
        if not self._state.size or not end > start:
            return
        size, inputs = self._state.size, np.concatenate([self._state, self._held])
        moved = np.append(np.arange(size), size + self._functions.moving)
        times = np.array([start, end])

        def flown(values: FloatArray) -> FloatArray:
            problems = (
                replace(
                    self._problem,
                    times=times,
                    state=row[:size],
                    held=row[size:],
                    events=times[:0],
                    due=self._problem.due[:0],
                    noise=self._problem.noise[:0],
                )
                for row in values
            )
            each = [undisturbed(self._functions, self._settings, p).state for p in problems]
            return np.array(each)

        self._state, slopes = _slopes(flown, inputs, _changes(inputs), moved)
        self._of_state = slopes @ np.vstack([self._of_state, self._of_held])


def _changes(values: FloatArray) -> FloatArray:
    changes: FloatArray = _CHANGE * np.maximum(np.abs(values), _LEAST)
    return changes


def _slopes(
    function: Callable[[FloatArray], FloatArray],
    inputs: FloatArray,
    changes: FloatArray,
    moved: np.ndarray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """The value of a function of rows, and its slopes by central differences (results, inputs).

    Args:
        function: Rows of inputs -> rows of results.
        inputs: The inputs, shape (n,).
        changes: Their changes, shape (n,).
        moved: The inputs that change results; None for all.
    """
    chosen = np.arange(inputs.size) if moved is None else moved
    steps = np.diag(changes)[chosen]
    value, *others = function(np.vstack([inputs, inputs + steps, inputs - steps]))
    after, before = np.split(np.array(others).reshape(2 * chosen.size, value.size), 2)
    slopes = np.zeros((value.size, inputs.size))
    slopes[:, chosen] = ((after - before) / (2.0 * changes[chosen, None])).T
    return value, slopes
