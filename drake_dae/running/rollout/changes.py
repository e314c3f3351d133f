"""Runs in which blocks change at some of their samples, such as phases of a task."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from threading import Lock

import numpy as np
from pydrake.systems.framework import Context, EventStatus

from drake_dae.arrays import FloatArray
from drake_dae.errors import SimulationError
from drake_dae.running.rollout.run import Run, RunEnding, RunProblem
from drake_dae.running.rollout.stepping.functions import DiagramFunctions

_LOCK = Lock()
"""Runs make changes one at a time: functions have one buffer for their results."""


@dataclass(eq=False)
class _Changes:
    """A run in pieces, from change to change; see `run_with_changes`."""

    functions: DiagramFunctions
    problem: RunProblem
    context: Context = field(init=False)

    def begin(self) -> tuple[Run, RunProblem | None]:
        """Makes the initialization events of the blocks.

        Returns:
            A run without steps, and its first piece; None in place of it if an event fails.

        Raises:
            InconsistentStateError: No run may start from this state.
        """
        compiled, problem = self.functions.program.compiled, self.problem
        self.context = compiled.diagram.CreateDefaultContext()
        start = float(problem.times[0])
        compiled.set_context(self.context, start, problem.state, problem.held, problem.parameters)
        no_rows = np.zeros((0, self.functions.program.width))
        no_trial = np.inf, np.full_like(problem.state, np.nan)
        counts = 0, 0, start, start
        run = Run(no_rows, RunEnding.DONE, start, problem.state, problem.held, *counts, *no_trial)
        try:
            compiled.diagram.ExecuteInitializationEvents(self.context)
        except SimulationError as error:
            return replace(run, ending=RunEnding.STUCK, error=error), None
        state, held = compiled.start(self.context)
        return run, replace(problem, state=state, held=held, context=self.context)

    def make(self, run: Run, piece: RunProblem) -> tuple[Run, RunProblem | None]:
        """Makes the updates of the sample that ended a piece, and the change.

        Returns:
            The run after the change; and the next piece, None if the run is at its end.
        """
        moment, later = run.time, self.problem.times[self.problem.times > run.time]
        rows, count = run.rows[:0], run.event + 1
        try:
            state, held, goes_on = self.sample(run, piece)
        except SimulationError as error:
            return replace(run, rows=rows, ending=RunEnding.STUCK, error=error), None
        if not later.size:  # The last row has the state after the updates.
            columns = np.array([moment]), state[None], held[None], self.problem.parameters
            rows = self.functions.rows(*columns)[0]
        ending = RunEnding.DONE if goes_on else RunEnding.STOPPED
        after = replace(run, rows=rows, ending=ending, state=state, held=held)
        if not (goes_on and later.size):
            return after, None
        return after, replace(
            piece,
            times=np.concatenate([[moment], later]),
            state=state,
            held=held,
            events=piece.events[count:],
            due=piece.due[count:],
            noise=piece.noise[count:],
        )

    def sample(self, run: Run, piece: RunProblem) -> tuple[FloatArray, FloatArray, bool]:
        """Makes the updates of an instant, and the changes of blocks that are due.

        All unrestricted updates of the instant see the state before it.

        Returns:
            State and held values after it, and whether the run continues.
        """
        functions, parameters = self.functions, self.problem.parameters
        noise, due = piece.noise[run.event], int(piece.due[run.event])
        before = run.time, run.state, run.held, parameters
        held, compiled = functions.update(*before, noise, due, True), functions.program.compiled
        margins, goes_on = functions.margins(*before), True
        compiled.set_context(self.context, *before)
        after = self.context.Clone()
        places = dict(compiled.held)
        reacted = list[slice]()
        for system, part in compiled.watched:
            if not (margins[part] <= 0.0).any():
                continue
            guard = compiled.blocks[system].guard
            assert guard is not None
            changed = system.GetMyMutableContextFromRoot(after).get_mutable_state()
            status = guard.react(system.GetMyContextFromRoot(self.context), changed)
            goes_on &= status.severity() != EventStatus.Severity.kReachedTermination
            reacted.append(places[system])
        self.context.SetTimeStateAndParametersFrom(after)
        _, changed_held = compiled.start(self.context)
        for part in reacted:
            held[part] = changed_held[part]
        state = self.problem.project(run.time, run.state, run.held)
        held = functions.update(run.time, state, held, parameters, noise, due, False)
        return state, held, goes_on

    def ended(self, run: Run) -> Context:
        """Returns a context of the diagram at the end of a run."""
        values = run.time, run.state, run.held, self.problem.parameters
        self.functions.program.compiled.set_context(self.context, *values)
        return self.context


def run_with_changes(
    functions: DiagramFunctions, run_piece: Callable[[RunProblem], Run], problem: RunProblem
) -> Run:
    """Runs a diagram whose blocks change at some of their samples, as Drake's Simulator does.

    They do so in a Drake context.

    Args:
        functions: The diagram.
        run_piece: Runs until the next change.
        problem: The run.

    Raises:
        InconsistentStateError: No run may start from this state.
    """
    changes = _Changes(functions, problem)
    with _LOCK:
        run, piece = changes.begin()
    rows, steps, count = list[FloatArray](), 0, 0
    while piece is not None:
        run = run_piece(replace(piece, earlier=tuple(rows)))
        steps += run.steps
        # The first row of a piece after a change is no row of the record.
        rows.append(run.rows[min(count, 1) :])
        if run.ending is not RunEnding.CHANGE:
            break
        with _LOCK:
            run, piece = changes.make(run, piece)
        rows.append(run.rows)
        count += 1
    with _LOCK:
        context = changes.ended(run)
    return replace(run, rows=np.concatenate(rows or [run.rows]), steps=steps, context=context)
