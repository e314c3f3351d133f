"""Runs in which blocks change at times to be located: contacts that open, phases of a task."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from threading import Lock

import numpy as np
from pydrake.systems.framework import Context, EventStatus, System

from drake_dae.arrays import Booleans, FloatArray
from drake_dae.errors import SimulationError
from drake_dae.running.rollout.run import Run, RunEnding, RunProblem, Tableau
from drake_dae.running.rollout.stepping.course import DOP, stage_rates
from drake_dae.running.rollout.stepping.functions import DiagramFunctions, GuardInputs
from drake_dae.systems.blocks.trials import LEAST_PROGRESS

WINDOW = 1e-13
"""The time of a change is located to within this, in s."""

MOST = 1000
"""A run ends where so many changes add hardly any time."""

MOST_REPEATED = 10
"""The number of reactions that may follow each other at one time."""

_LOCK = Lock()
"""Runs locate and make changes one at a time: functions have one buffer for their results."""


@dataclass(eq=False)
class _Changes:
    """A run in pieces, from change to change; see `run_with_changes`."""

    functions: DiagramFunctions
    problem: RunProblem
    tableau: Tableau
    is_controlled: bool
    repeated: int = 0
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
        # Plants that need accurate times of changes read the accuracy.
        self.context.SetAccuracy(WINDOW)
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
        """Makes the change that ended a piece.

        Returns:
            The run after the change, with the rows between its last step and the change; and the
            next piece, None if the run is at its end.
        """
        moment, state, held, count = run.time, run.state, run.held, run.event
        if run.next > run.time:
            moment, state = self.located(run)
            if self.is_missed(moment, state, held):
                moment = min(moment + WINDOW, run.next)
                state = self.reached(run, moment)
        # A row at the time of the change has the state before it.
        times = self.problem.times
        rows = self.rows(run, times[(times > run.time) & (times <= moment)])
        later = times[times > moment]
        is_sample = run.next == run.time and bool((piece.events[count:] <= moment).any())
        try:
            if is_sample:
                state, held, goes_on = self.sample(run, piece)
                count += 1
            else:
                state, held, goes_on = self.react(moment, state, held)
        except SimulationError as error:
            failed = replace(run, rows=rows, ending=RunEnding.STUCK, time=moment, state=state)
            return replace(failed, error=error), None
        if is_sample and not later.size:  # The last row has the state after the updates.
            columns = np.array([moment]), state[None], held[None], self.problem.parameters
            rows = self.functions.rows(*columns)[0]
        ending = RunEnding.DONE if goes_on else RunEnding.STOPPED
        after = replace(run, rows=rows, ending=ending, time=moment, state=state, held=held)
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
            has_reacted=not is_sample and self.has_settled(run, moment, state, held),
        )

    def is_missed(self, time: float, state: FloatArray, held: FloatArray) -> bool:
        """Whether blocks ignore a change, since their guards differ from zero by round-off."""
        before = self.context.Clone()
        try:
            reacted, held_after, goes_on = self.react(time, state, held)
        except SimulationError:  # It is raised again by the reaction itself.
            return False
        finally:  # A trial leaves no trace in what blocks remember.
            self.context.SetTimeStateAndParametersFrom(before)
        return goes_on and _is_same(reacted, held_after, state, held)

    def has_settled(self, run: Run, time: float, state: FloatArray, held: FloatArray) -> bool:
        """Returns whether the next step can begin: the last reaction changed only round-off.

        Otherwise up to `MOST_REPEATED` reactions follow at the same time. There is a limit, since
        the mode of a closed contact with zero force is not unique.
        """
        self.repeated = self.repeated + 1 if time == run.time else 0
        is_same = time == run.time and _is_same(state, held, run.state, run.held)
        return self.repeated >= MOST_REPEATED or is_same

    def sample(self, run: Run, piece: RunProblem) -> tuple[FloatArray, FloatArray, bool]:
        """Makes the updates of an instant, and the reactions of blocks that sample their guards.

        All unrestricted updates of the instant see the state before it. Returns as `react`.
        """
        functions, parameters = self.functions, self.problem.parameters
        noise, due = piece.noise[run.event], int(piece.due[run.event])
        before = run.time, run.state, run.held, parameters
        held, compiled = functions.update(*before, noise, due, True), functions.program.compiled
        margins = functions.sampled_guards(*before).margins
        systems = [system for system, part in compiled.watched if (margins[part] <= 0.0).any()]
        _, reacted, goes_on = self._reacted(run.time, run.state, run.held, systems)
        for system, part in compiled.held:
            if system in systems:
                held[part] = reacted[part]
        state = self.problem.project(run.time, run.state, run.held)
        held = functions.update(run.time, state, held, parameters, noise, due, False)
        return state, held, goes_on

    def ended(self, run: Run) -> Context:
        """Returns a context of the diagram at the end of a run."""
        values = run.time, run.state, run.held, self.problem.parameters
        self.functions.program.compiled.set_context(self.context, *values)
        return self.context

    def react(
        self, time: float, state: FloatArray, held: FloatArray
    ) -> tuple[FloatArray, FloatArray, bool]:
        """Lets blocks react whose guards have triggered.

        Returns:
            State and held values after it, and whether the run continues.
        """
        guards = self.functions.program.compiled.guards
        margins = self.functions.guards(time, state, held, self.problem.parameters).margins
        due = [system for system, part in guards if (margins[part] <= 0.0).any()]
        return self._reacted(time, state, held, due or [system for system, _ in guards])

    def _reacted(
        self, time: float, state: FloatArray, held: FloatArray, systems: Sequence[System]
    ) -> tuple[FloatArray, FloatArray, bool]:
        compiled, goes_on = self.functions.program.compiled, True
        compiled.set_context(self.context, time, state, held, self.problem.parameters)
        after = self.context.Clone()
        for system in systems:
            guard = compiled.blocks[system].guard
            assert guard is not None
            before = system.GetMyContextFromRoot(self.context)
            changed = system.GetMyMutableContextFromRoot(after).get_mutable_state()
            status = guard.react(before, changed)
            goes_on &= status.severity() != EventStatus.Severity.kReachedTermination
        self.context.SetTimeStateAndParametersFrom(after)
        return *compiled.start(self.context), goes_on

    def reached(self, run: Run, end: float) -> FloatArray:
        """Returns the state at a time within the step that was not accepted."""

        def rate(time: float, state: FloatArray) -> FloatArray:
            return self.functions.rate(time, state, run.held, self.problem.parameters)

        step = end - run.time
        rates = stage_rates(rate, self.tableau, run.time, run.state, step)
        state: FloatArray = run.state + step * (self.tableau.b @ rates)
        return state

    def rows(self, run: Run, times: FloatArray) -> FloatArray:
        """Returns rows of the record at times within the step that was not accepted."""
        states = np.zeros((times.size, run.state.size))
        for index, time in enumerate(times.tolist()):
            states[index] = self.reached(run, time)
            if self.is_controlled:
                states[index] = self.problem.project(time, states[index], run.held)
        held = np.tile(run.held, (times.size, 1))
        return self.functions.rows(times, states, held, self.problem.parameters)[0]

    def located(self, run: Run) -> tuple[float, FloatArray]:
        """Locates the change within a step: returns its time, and the state just after it.

        By the secant through the least margins at both ends, where that halves the interval within
        three trials; else by bisection.
        """
        constants = run.held, self.problem.parameters
        before = self.functions.guards(run.time, run.state, *constants)
        first, last, state = run.time, run.next, self.reached(run, run.next)
        after = self.functions.guards(last, state, *constants)
        due = (after.margins <= 0.0) & (before.margins > 0.0)
        above, below = _least(before, due), _least(after, due)
        trials, goal = 0, 0.5 * (last - first)
        while last - first > WINDOW and first < 0.5 * (first + last) < last:
            share = above / (above - below) if above - below > 0.0 else 0.5
            if trials == 3:
                trials, goal, share = 0, 0.5 * (last - first), 0.5
            margin = min(0.25 * WINDOW / (last - first), 0.5)
            middle = first + (last - first) * min(max(share, margin), 1.0 - margin)
            tried = self.reached(run, middle)
            after = self.functions.guards(middle, tried, *constants)
            if after.follows_change(before):
                last, state, below = middle, tried, min(_least(after, due), 0.0)
            else:
                first, above = middle, max(_least(after, due), 0.0)
            trials = 0 if last - first <= goal else trials + 1
            goal = min(goal, 0.5 * (last - first)) if not trials else goal
        return last, state


def _is_same(
    state: FloatArray, held: FloatArray, other_state: FloatArray, other_held: FloatArray
) -> bool:
    return np.allclose(state, other_state, 1e-12, 1e-12) and np.array_equal(held, other_held)


def _least(guards: GuardInputs, due: Booleans) -> float:
    """The least of the margins that change their sign; 0 if none does."""
    return float(np.min(guards.margins[due], initial=np.inf)) if due.any() else 0.0


def run_with_changes(
    functions: DiagramFunctions,
    run_piece: Callable[[RunProblem], Run],
    tableau: Tableau | None,
    problem: RunProblem,
) -> Run:
    """Runs a diagram whose blocks react at times to be located, as Drake's Simulator does.

    Where a step passes a change, its time is located by shorter steps from the same state; then the
    blocks react in a Drake context.

    Args:
        functions: The diagram.
        run_piece: Runs until the next change.
        tableau: The method of fixed steps; None for error control.
        problem: The run.

    Raises:
        InconsistentStateError: No run may start from this state.
    """
    changes = _Changes(functions, problem, tableau or DOP, tableau is None)
    with _LOCK:
        run, piece = changes.begin()
    rows, steps, count, mark = list[FloatArray](), 0, 0, run.time
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
        if count % MOST == 0 and piece is not None:
            if run.time - mark < LEAST_PROGRESS * (run.time - problem.times[0]):
                run = replace(run, ending=RunEnding.SLOW, mark=mark)
                break
            mark = run.time
    with _LOCK:
        context = changes.ended(run)
    return replace(run, rows=np.concatenate(rows or [run.rows]), steps=steps, context=context)
