"""Runs in which blocks change at moments that are found: contacts that open, phases of a task."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from threading import Lock

import numpy as np
from pydrake.systems.framework import Context, EventStatus, System
from scipy.integrate import DOP853

from drake_dae.arrays import Booleans, FloatArray
from drake_dae.errors import SimulationError
from drake_dae.running.rollout.run import Run, RunEnding, RunProblem, Tableau
from drake_dae.running.rollout.stepping.fused import DiagramFunctions, GuardInputs
from drake_dae.systems.blocks.trials import LEAST_PROGRESS

WINDOW = 1e-13
"""A moment is found to within this time, in s."""

MOST = 1000
"""So many changes that hardly lead on end a run."""

MOST_REPEATED = 10
"""So many reactions may follow each other at one moment."""

_LOCK = Lock()
"""Runs find and make changes one at a time: functions have one place for what they compute."""

_CONTROLLED = Tableau(DOP853.A[:12, :12], DOP853.B, DOP853.C[:12])


@dataclass(eq=False)
class _Changes:
    """A run in pieces, from change to change; see `run_with_changes`."""

    fused: DiagramFunctions
    problem: RunProblem
    tableau: Tableau
    is_controlled: bool
    repeated: int = 0
    context: Context = field(init=False)

    def begin(self) -> tuple[Run, RunProblem | None]:
        """A run without steps, and how it goes on after what blocks do when it begins, if it does.

        Raises:
            InconsistentStateError: No run may start there.
        """
        compiled, problem = self.fused.program.compiled, self.problem
        self.context = compiled.diagram.CreateDefaultContext()
        # Plants that need the moments of changes ask whether they are sought.
        self.context.SetAccuracy(WINDOW)
        given = problem.state, problem.held, problem.parameters
        compiled.set_context(self.context, problem.times[0], *given)
        start, nowhere = float(problem.times[0]), np.full_like(problem.state, np.nan)
        counts, none = (
            (0, 0, start, start, np.inf, nowhere),
            np.zeros((0, self.fused.program.width)),
        )
        begun = Run(none, RunEnding.DONE, start, problem.state, problem.held, *counts)
        try:
            compiled.diagram.ExecuteInitializationEvents(self.context)
        except SimulationError as error:
            return replace(begun, ending=RunEnding.STUCK, error=error), None
        state, held = compiled.start(self.context)
        return begun, replace(problem, state=state, held=held, context=self.context)

    def make(self, run: Run, piece: RunProblem) -> tuple[Run, RunProblem | None]:
        """What a run comes to with the change that ended it, and how it goes on, if it does.

        The rows are those between the last step and the change.
        """
        moment, state, held, count = run.time, run.state, run.held, run.event
        if run.next > run.time:
            moment, state = self.located(run)
        # At the moment of the change a record has what was before.
        times = self.problem.times
        rows = self.rows(run, times[(times > run.time) & (times <= moment)])
        left = times[times > moment]
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
        ending = RunEnding.DONE if goes_on else RunEnding.STOPPED
        after = replace(run, rows=rows, ending=ending, time=moment, state=state, held=held)
        if is_sample and not left.size:  # The last row comes after what happens then.
            given = np.array([moment]), state[None], held[None], self.problem.parameters
            after = replace(after, rows=self.fused.rows(*given)[0])
        if not (goes_on and left.size):
            return after, None
        return after, replace(
            piece,
            times=np.concatenate([[moment], left]),
            state=state,
            held=held,
            events=piece.events[count:],
            due=piece.due[count:],
            noise=piece.noise[count:],
            has_reacted=not is_sample and self.has_settled(run, moment, state, held),
        )

    def has_settled(self, run: Run, time: float, state: FloatArray, held: FloatArray) -> bool:
        """Whether a step is to be made now, since a reaction changed nothing but round-off.

        Others may follow it at the same moment, but no more than some: of contacts that touch
        without a force any mode fits.
        """
        self.repeated = self.repeated + 1 if time == run.time else 0
        is_same = np.allclose(state, run.state, 1e-12, 1e-12) and np.array_equal(held, run.held)
        return self.repeated >= MOST_REPEATED or (time == run.time and is_same)

    def sample(self, run: Run, piece: RunProblem) -> tuple[FloatArray, FloatArray, bool]:
        """What `react` returns, where blocks react that look at their guards in samples.

        All unrestricted updates of the instant see what was before it.
        """
        fused, parameters = self.fused, self.problem.parameters
        noise, due = piece.noise[run.event], int(piece.due[run.event])
        given = run.time, run.state, run.held, parameters, noise, due
        held, compiled = fused.update(*given, True), fused.program.compiled
        margins = fused.watched(run.time, run.state, run.held, parameters).margins
        systems = [system for system, part in compiled.watched if (margins[part] <= 0.0).any()]
        _, reacted, goes_on = self._reacted(run.time, run.state, run.held, systems)
        for system, part in compiled.held:
            if system in systems:
                held[part] = reacted[part]
        state = self.problem.project(run.time, run.state, run.held)
        return state, fused.update(run.time, state, held, parameters, noise, due, False), goes_on

    def ended(self, run: Run) -> Context:
        """A context of the diagram at the end of a run."""
        given = run.time, run.state, run.held, self.problem.parameters
        self.fused.program.compiled.set_context(self.context, *given)
        return self.context

    def react(
        self, time: float, state: FloatArray, held: FloatArray
    ) -> tuple[FloatArray, FloatArray, bool]:
        """State and what is held after blocks reacted, and whether the run goes on."""
        compiled, parameters = self.fused.program.compiled, self.problem.parameters
        margins = self.fused.seen(time, state, held, parameters).margins
        due = [system for system, part in compiled.guards if (margins[part] <= 0.0).any()]
        return self._reacted(time, state, held, due or [system for system, _ in compiled.guards])

    def _reacted(
        self, time: float, state: FloatArray, held: FloatArray, systems: Sequence[System]
    ) -> tuple[FloatArray, FloatArray, bool]:
        compiled, goes_on = self.fused.program.compiled, True
        compiled.set_context(self.context, time, state, held, self.problem.parameters)
        after = self.context.Clone()
        for system in systems:
            guard = compiled.blocks[system].guard
            assert guard is not None
            own = system.GetMyContextFromRoot(self.context)
            changed = system.GetMyMutableContextFromRoot(after).get_mutable_state()
            status = guard.react(own, changed)
            goes_on &= status.severity() != EventStatus.Severity.kReachedTermination
        self.context.SetTimeStateAndParametersFrom(after)
        return *compiled.start(self.context), goes_on

    def reached(self, run: Run, end: float) -> FloatArray:
        """The state at a time within the step that a run did not take."""
        a, b, c = self.tableau
        step, rates = end - run.time, list[FloatArray]()
        given = run.held, self.problem.parameters
        for row, part in zip(a, c, strict=True):
            change = sum((w * rate for w, rate in zip(row, rates, strict=False) if w), 0.0)
            rates.append(self.fused.rate(run.time + part * step, run.state + step * change, *given))
        found: FloatArray = run.state + step * (b @ np.array(rates))
        return found

    def rows(self, run: Run, times: FloatArray) -> FloatArray:
        """Rows of the record at times within the step that a run did not take."""
        if not times.size:
            return np.zeros((0, self.fused.program.width))
        states = np.array([self.reached(run, time) for time in times.tolist()])
        if self.is_controlled:
            for time, state in zip(times.tolist(), states, strict=True):
                state[:] = self.problem.project(time, state, run.held)
        held = np.tile(run.held, (times.size, 1))
        return self.fused.rows(times, states, held, self.problem.parameters)[0]

    def located(self, run: Run) -> tuple[float, FloatArray]:
        """When the change is that lies within a step, and the state just after it.

        By the secant through the least margins at both ends, where that halves what is left within
        three trials; else by bisection.
        """
        given = run.held, self.problem.parameters
        before = self.fused.seen(run.time, run.state, *given)
        first, last, state = run.time, run.next, self.reached(run, run.next)
        found = self.fused.seen(last, state, *given)
        due = (found.margins <= 0.0) & (before.margins > 0.0)
        above, below = _least(before, due), _least(found, due)
        trials, goal = 0, 0.5 * (last - first)
        while last - first > WINDOW and first < 0.5 * (first + last) < last:
            share = above / (above - below) if above - below > 0.0 else 0.5
            if trials == 3:
                trials, goal, share = 0, 0.5 * (last - first), 0.5
            margin = min(0.25 * WINDOW / (last - first), 0.5)
            middle = first + (last - first) * min(max(share, margin), 1.0 - margin)
            tried = self.reached(run, middle)
            found = self.fused.seen(middle, tried, *given)
            if found.follows_change(before):
                last, state, below = middle, tried, min(_least(found, due), 0.0)
            else:
                first, above = middle, max(_least(found, due), 0.0)
            trials = 0 if last - first <= goal else trials + 1
            goal = min(goal, 0.5 * (last - first)) if not trials else goal
        return last, state


def _least(seen: GuardInputs, due: Booleans) -> float:
    """The least of the margins that fall through zero; 0 where none does at both ends."""
    return float(np.min(seen.margins[due], initial=np.inf)) if due.any() else 0.0


def run_with_changes(
    fused: DiagramFunctions,
    take: Callable[[RunProblem], Run],
    tableau: Tableau | None,
    problem: RunProblem,
) -> Run:
    """A run in which blocks react, as Drake's Simulator lets them.

    Between changes it is one of those without. Where a step passes a change, the moment is found by
    steps that end earlier, and the blocks do in a context of Drake's what they do there.

    Args:
        fused: The diagram.
        take: What runs up to a change.
        tableau: The method of fixed steps; None for error control.
        problem: The run.

    Raises:
        InconsistentStateError: No run may start there.
    """
    changes = _Changes(fused, problem, tableau or _CONTROLLED, tableau is None)
    with _LOCK:
        run, piece = changes.begin()
    rows, steps, count, mark = list[FloatArray](), 0, 0, run.time
    while piece is not None:
        run = take(replace(piece, earlier=tuple(rows)))
        steps += run.steps
        # A piece begins with a row; after a change that is none of the record's.
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
