"""Trial and accepted: what a block answers at a state that an integrator only tries.

An integrator evaluates the blocks of a diagram at states that the motion may never reach: the
stages of a step that it then makes shorter. There a function that has no value is no failure, and
the answer is nan: error control takes a shorter step. At a state that is reached it is one.

Nobody tells a block which of them it is asked about. But Drake publishes at accepted states alone,
and the time of every trial lies after that of the last accepted one. So a block notes the time at
each accepted step, and looks at it where a function has no value, and nowhere else.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Any
from weakref import proxy, ref

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    CacheEntry,
    Context,
    DependencyTicket,
    EventStatus,
    LeafSystem,
    ValueProducer,
)

from drake_dae.arrays import FloatArray
from drake_dae.errors import SimulationError
from drake_dae.systems.blocks.failures import endless_steps, no_step_leads_on, spoilt_step
from drake_dae.systems.blocks.lifetime import weakly

FAILURES = 1000
"""So many trials that fail end the run: ten of them bring a step of 0.1 s to round-off, and each
takes some stages, or a Jacobian by finite differences."""

SHORTEST = 1e-12
"""A trial no further ahead of the accepted state than this, relative to the time, is the last."""

STEPS = 1000
SLOWEST = 1e-8
"""Of the time that is simulated already, which so many steps must add. A kink in a reference takes
a few such steps, a state that grows without bound takes them for ever."""


def state_tickets(system: LeafSystem) -> set[DependencyTicket]:
    """What a function of the continuous state is declared to depend on: also on the time.

    After a step that is given up, Drake's runge_kutta5 and bogacki_shampine3 put the state back
    without telling (Drake 1.51); only the time, which is put back too, makes values that were kept
    for the trial out of date.
    """
    return {system.xc_ticket(), system.time_ticket()}


_DONE = EventStatus.DidNothing()


@dataclass
class RunProgress:
    """What a block knows of a simulation, in one context.

    Attributes:
        time: Of the last accepted state, in s; without a simulation it is infinite, and no state
            is a trial.
        state: The continuous state of the block then; empty if it has none.
        failures: How many trials failed since then.
        reason: What the earliest of them said.
        reason_time: When that was, in s.
        start: When the simulation began, in s.
        steps: How many steps were accepted.
        mark: The time after the last thousand steps, in s.
        parameters: After which time, in s, the block had which numeric parameters.
        laws: Likewise those of the law that is fed back to it, if any is.
        entry: The cache entry that this is the value of: to find it again takes longer.
    """

    time: float = inf
    state: FloatArray = field(default_factory=lambda: np.zeros(0))
    failures: int = 0
    reason: str = ""
    reason_time: float = inf
    start: float = 0.0
    steps: int = 0
    mark: float = 0.0
    parameters: list[tuple[float, FloatArray]] = field(default_factory=list)
    laws: list[tuple[float, FloatArray]] = field(default_factory=list)
    entry: CacheEntry | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> "RunProgress":
        return replace(
            self, state=self.state.copy(), parameters=list(self.parameters), laws=list(self.laws)
        )


class StepWatch:
    """Tells trials from accepted states for one block, and sees that steps come to an end.

    Args:
        system: The block; gets two events and a cache entry.
        sees_steps: Whether it gets the events; without them no state is a trial, and parameters are
            those of the context.
    """

    def __init__(self, system: LeafSystem, sees_steps: bool = True) -> None:
        self._system = proxy(system)
        # It is out of date where parameters have changed, and then they are noted; all else in it
        # is changed by the two events alone.
        self._index = system.DeclareCacheEntry(
            "progress",
            ValueProducer(_no_simulation, _note_parameters),
            {system.all_parameters_ticket()},
        ).cache_index()
        # Whoever holds an entry holds its system: a context may, but not the system itself.
        self._entry: Callable[[], CacheEntry | None] = lambda: None
        if sees_steps:
            system.DeclareInitializationPublishEvent(weakly(self._begin))
            system.DeclarePerStepPublishEvent(weakly(self._accept))

    def tolerate(self, context: Context, error: SimulationError) -> None:
        """Returns if the context holds a trial, at which a failure is an answer.

        Raises:
            SimulationError: The error, at an accepted state and without a simulation; or another
                one of its kind, which says that no step leads on.
        """
        progress = self._progress(context)
        step = error.time - progress.time
        # After other trials, a step of length zero is only rounded: steps are that short by now.
        if not (step > 0.0 or progress.failures):
            raise error from None
        progress.failures += 1
        # A state that is not finite follows from another failure.
        if error.time < progress.reason_time and np.isfinite(error.state).all():
            progress.reason, progress.reason_time = str(error), error.time
        if step > SHORTEST * abs(error.time) and progress.failures < FAILURES:
            return
        raise no_step_leads_on(
            self._system.get_name(), progress.time, progress.state.copy(), error, progress.reason
        ) from None

    def parameters_along(self, context: Context, times: FloatArray) -> FloatArray:
        """The numeric parameters that the block had at accepted times, in s, one row for each."""
        return _along(self._progress(context).parameters or [(0.0, _parameters(context))], times)

    def note_law(self, context: Context, parameters: FloatArray, begins: bool = False) -> None:
        """Notes the parameters of the law that the block has from the last accepted state on.

        Args:
            context: The context.
            parameters: The parameters; not to be changed.
            begins: Whether a simulation begins there; nothing is noted without one.
        """
        progress = self._progress(context)
        if begins:
            before = float(np.nextafter(context.get_time(), -inf))
            progress.laws = [entry for entry in progress.laws if entry[0] < before]
            _add(progress.laws, before, parameters)
        elif progress.laws:
            _add(progress.laws, progress.time, parameters)

    def laws_along(self, context: Context, times: FloatArray) -> FloatArray | None:
        """The parameters of the law at accepted times, in s, one row for each; None if unknown."""
        seen = self._progress(context).laws
        return _along(seen, times) if seen else None

    def _progress(self, context: Context) -> RunProgress:
        # The object stays the same, and is ours to change.
        found: RunProgress = self._system.get_cache_entry(self._index).Eval(context)
        return found

    def _begin(self, context: Context) -> EventStatus:
        time = context.get_time()
        progress = self._progress(context)
        before = float(np.nextafter(time, -inf))
        seen = [entry for entry in progress.parameters if entry[0] < before]
        if context.num_numeric_parameter_groups():
            _add(seen, before, _parameters(context))
        entry = self._system.get_cache_entry(self._index)
        self._entry = ref(entry)
        laws = progress.laws
        begun = RunProgress(time, start=time, mark=time, parameters=seen, laws=laws, entry=entry)
        vars(progress).update(vars(begun))
        if context.num_continuous_states():
            progress.state = context.get_continuous_state_vector().CopyToVector()
        return EventStatus.DidNothing()

    def _accept(self, context: Context) -> EventStatus:
        entry = self._entry() or self._system.get_cache_entry(self._index)
        progress = entry.Eval(context)
        time = context.get_time()
        if progress.state.size:
            state = context.get_continuous_state_vector().value()
            # The sum takes a fifth of the time, and may overflow.
            if not (isfinite(sum(state.tolist())) or np.isfinite(state).all()):
                name = self._system.get_name()
                known = progress.state.copy()
                raise spoilt_step(name, progress.time, time, known, progress.reason)
            progress.state[...] = state
            progress.steps += 1
            if progress.steps % STEPS == 0:
                self._check_pace(progress, time)
        progress.time = time
        if progress.failures:
            progress.failures, progress.reason, progress.reason_time = 0, "", inf
        return _DONE

    def _check_pace(self, progress: RunProgress, time: float) -> None:
        before, progress.mark = progress.mark, time
        if time - before < SLOWEST * (time - progress.start):
            name = self._system.get_name()
            raise endless_steps(name, STEPS, before, time, progress.state.copy())


def _add(seen: list[tuple[float, FloatArray]], time: float, values: FloatArray) -> None:
    """Notes what a block has from a time on, if that is not what it had before."""
    if not (seen and np.array_equal(seen[-1][1], values, equal_nan=True)):
        seen.append((time, values))


def _along(seen: Sequence[tuple[float, FloatArray]], times: FloatArray) -> FloatArray:
    """What was seen from after some times on, at other times, one row for each."""
    last = np.searchsorted([time for time, _ in seen], times) - 1
    return np.array([values for _, values in seen])[np.maximum(last, 0)]


def _no_simulation() -> AbstractValue:
    return AbstractValue.Make(RunProgress())


def _note_parameters(context: Context, value: AbstractValue) -> None:
    """Notes that the parameters of a context are others since the last accepted state."""
    progress: RunProgress = value.get_value()
    if progress.parameters:
        _add(progress.parameters, progress.time, _parameters(context))


def _parameters(context: Context) -> FloatArray:
    return np.array(context.get_numeric_parameter(0).value())
