"""Trial states of an integrator, and accepted states.

An integrator evaluates the blocks of a diagram at trial states that the motion may never reach: the
stages of a step that it then makes shorter. There a function without a value is no failure: it
returns nan, and error control takes a shorter step. At an accepted state it is a failure.

Drake does not pass this distinction to a block. But it publishes only at accepted states, and each
trial is later than the last accepted state. So a block stores the time of each accepted step, and
compares with it if a function has no value.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Any
from weakref import proxy, ref

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import CacheEntry, Context, EventStatus, LeafSystem, ValueProducer

from drake_dae.arrays import FloatArray
from drake_dae.blocks.failures import endless_steps, no_step_leads_on, spoilt_step
from drake_dae.blocks.lifetime import weakly
from drake_dae.errors import SimulationError

FAILURES = 1000
"""The number of failed trials in a row that ends a run. Ten shorter steps reduce a step of 0.1 s to
round-off; each takes several stages, or a Jacobian by finite differences."""

SHORTEST = 1e-12
"""The least distance of a trial from the accepted state, relative to the time; then the run ends.
"""

PACE_STEPS, LEAST_PROGRESS = 1000, 1e-8
"""The least increase of the time by so many steps, relative to the simulated time. A kink in a
reference needs a few shorter steps, a state that grows without bound any number of them."""


_DONE = EventStatus.DidNothing()


@dataclass
class RunProgress:
    """The progress of a simulation in one context, for one block."""

    time: float = inf  # of the last accepted state; without a simulation no state is a trial
    state: FloatArray = field(default_factory=lambda: np.zeros(0))  # then
    failures: int = 0  # trials since then
    reason: SimulationError | None = None  # the error of the earliest
    start: float = 0.0
    steps: int = 0
    mark: float = 0.0  # after the last PACE_STEPS steps
    entry: CacheEntry | None = None  # of this value: looking it up takes longer

    def __deepcopy__(self, memo: dict[int, Any]) -> "RunProgress":
        return replace(self, state=self.state.copy())


class StepWatch:
    """Distinguishes trials from accepted states for one block, and ends runs without progress."""

    def __init__(self, system: LeafSystem, sees_steps: bool = True) -> None:
        self._system = proxy(system)
        # Only the two events change it.
        self._index = system.DeclareCacheEntry(
            "progress",
            ValueProducer(lambda: AbstractValue.Make(RunProgress()), ValueProducer.NoopCalc),
            {system.nothing_ticket()},
        ).cache_index()
        # An entry keeps its system alive: a context may hold one, but not the system itself.
        self._entry: Callable[[], CacheEntry | None] = lambda: None
        if sees_steps:
            system.DeclareInitializationPublishEvent(weakly(self.begin))
            system.DeclarePerStepPublishEvent(weakly(self._accept))

    def tolerate(self, context: Context, error: SimulationError) -> None:
        """Raises the error, except at a trial state, from which shorter steps may lead on."""
        progress = self._progress(context)
        step = error.time - progress.time
        # After other trials, a step of length zero is a rounded one: steps are very short by now.
        if not (step > 0.0 or progress.failures):
            raise error from None
        progress.failures += 1
        # A state that is not finite is the consequence of another failure.
        earliest = inf if progress.reason is None else progress.reason.time
        if error.time < earliest and np.isfinite(error.state).all():
            progress.reason = error
        if step > SHORTEST * abs(error.time) and progress.failures < FAILURES:
            return
        raise no_step_leads_on(
            self._system.get_name(), progress.time, progress.state.copy(), progress.reason or error
        ) from None

    def _progress(self, context: Context) -> RunProgress:
        # The object is not replaced, and is changed in place.
        progress: RunProgress = self._system.get_cache_entry(self._index).Eval(context)
        return progress

    def begin(self, context: Context) -> EventStatus:
        """Takes the state of a context as accepted, as an initialization event does."""
        time = context.get_time()
        progress = self._progress(context)
        entry = self._system.get_cache_entry(self._index)
        self._entry = ref(entry)
        begun = RunProgress(time, start=time, mark=time, entry=entry)
        vars(progress).update(vars(begun))
        if context.num_continuous_states():
            progress.state = context.get_continuous_state_vector().CopyToVector()
        return _DONE

    def _accept(self, context: Context) -> EventStatus:
        entry = self._entry() or self._system.get_cache_entry(self._index)
        progress = entry.Eval(context)
        time = context.get_time()
        if progress.state.size:
            state = context.get_continuous_state_vector().value()
            # The sum is five times as fast as isfinite, and may overflow.
            if not (isfinite(sum(state.tolist())) or np.isfinite(state).all()):
                name, last = self._system.get_name(), progress.state.copy()
                raise spoilt_step(name, progress.time, time, last, progress.reason)
            progress.state[...] = state
            progress.steps += 1
            if progress.steps % PACE_STEPS == 0:
                self._check_pace(progress, time)
        progress.time = time
        if progress.failures:
            progress.failures, progress.reason = 0, None
        return _DONE

    def _check_pace(self, progress: RunProgress, time: float) -> None:
        before, progress.mark = progress.mark, time
        if time - before < LEAST_PROGRESS * (time - progress.start):
            name = self._system.get_name()
            raise endless_steps(name, PACE_STEPS, before, time, progress.state.copy())
