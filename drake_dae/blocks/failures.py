"""What ends a simulation: its exceptions, and which trial states are no failures yet."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Any
from weakref import proxy, ref

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import CacheEntry, Context, EventStatus, LeafSystem, ValueProducer

from drake_dae.arrays import FloatArray, show_state
from drake_dae.blocks.lifetime import weakly
from drake_dae.dae import Signal
from drake_dae.errors import (
    InconsistentStateError,
    NonFiniteError,
    SimulationError,
    SingularityError,
)
from drake_dae.trace.functions import Failure, FailureKind


def cannot_go_on(
    time: float, state: FloatArray, reason: str, remedy: str = "choose other integrator settings"
) -> SimulationError:
    """The exception of a run that ends for a reason of the integrator, or of Drake."""
    where = f"at t = {time:.6g} s, state {show_state(state)}"
    text = f"the simulation cannot go on {where}: {reason.rstrip('.')}"
    return SimulationError(f"{text}. If nothing else is wrong, {remedy}", time, state)


def simulation_error(
    failure: Failure, time: float, state: FloatArray, signals: Mapping[str, Sequence[Signal]]
) -> SimulationError:
    """The exception for a function without a valid value."""
    where, function = f"at t = {time:.6g} s, state {show_state(state)}", failure.function
    bad = ", ".join(
        signals[name][i].name if name in signals else name
        for name, entries in failure.inputs.items()
        for i in (entries if name in signals else entries[:1])
    )
    kind: type[SimulationError] = NonFiniteError
    match failure.fault:
        case FailureKind.INPUT:
            text = f"{function}: its input {bad} is not finite {where}"
        case FailureKind.OVERFLOW:
            size = f"beyond all measure {where}: it grows without bound"
            text = f"{function}: its input {bad} is {size}"
        case FailureKind.VALUE:
            text = (
                f"{function} is not finite {where}: a function left its domain or is not "
                "differentiable there, or a matrix that is inverted is singular"
            )
        case FailureKind.OUTSIDE:
            kind, text = SimulationError, f"{function} has no value {where}: {failure.singular}"
        case FailureKind.SINGULAR:
            kind = SingularityError
            text = (
                f"{failure.singular} is singular {where}, so {function} is not determined there: "
                "a singular configuration, through which smaller steps do not lead. Keep away "
                "from this state, or choose other constraints or outputs"
            )
    return kind(text, time, state)


def no_step_leads_on(
    name: str, time: float, state: FloatArray, reason: SimulationError
) -> SimulationError:
    """The exception if each trial step failed; it has the class of the reason."""
    return reason.retold(
        f"{name}: no step leads on from t = {time:.6g} s{_at(state)} since each that was tried "
        f"failed, however short: {reason}",
        time,
        state if state.size else reason.state,
    )


def spoilt_step(
    name: str, start: float, end: float, state: FloatArray, reason: SimulationError | None
) -> SimulationError:
    """The exception if an integrator without error control accepted a trial that failed."""
    text = (
        f"{name}: the step from t = {start:.6g} s{_at(state)} to t = {end:.6g} s led to a state "
        f"that is not finite{'' if reason is None else f': {reason}'}. Take smaller steps, or an "
        "integrator with error control"
    )
    if reason is None:
        return NonFiniteError(text, start, state)
    return reason.retold(text, start, state)


def endless_steps(
    name: str, steps: int, start: float, end: float, state: FloatArray
) -> SimulationError:
    """The exception if many steps together advance the time very little."""
    return SimulationError(
        f"{name}: the last {steps} steps led from t = {start:.12g} s only to {end:.12g} s"
        f"{_at(state)} where it grows without bound, or jumps. A fixed step passes a jump",
        end,
        state,
    )


def off_manifold(time: float, state: FloatArray, reason: InconsistentStateError) -> SimulationError:
    """The exception if a state cannot be projected onto N*."""
    return SimulationError(
        f"the state left the constraint too far at t = {time:.6g} s, state {show_state(state)}: "
        f"{reason}. Take smaller steps or a better accuracy",
        time,
        state,
    )


def _at(state: FloatArray) -> str:
    return f", state {show_state(state)}," if state.size else ""


def singular_configuration(
    name: str, time: float, state: FloatArray, constraints: tuple[str, ...]
) -> SingularityError:
    """The exception of a run that comes to a singular configuration of its constraints."""
    error = SingularityError(
        f"{name}: the gradients of {', '.join(constraints)} become dependent at t = {time:.6g} s, "
        f"state {show_state(state)}: A(x) of Assumption (2) is singular in this configuration. "
        "Keep away from it, or choose other constraints",
        time,
        state,
    )
    error.constraints = constraints
    return error


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
    """Distinguishes trials from accepted states for one block, and ends runs without progress.

    An integrator evaluates the blocks of a diagram at trial states that the motion may never reach:
    the stages of a step that it then makes shorter. There a function without a value is no failure:
    it returns nan, and error control takes a shorter step. At an accepted state it is a failure.

    Drake does not pass this distinction to a block. But it publishes only at accepted states, and
    each trial is later than the last accepted state. So a block stores the time of each accepted
    step, and compares with it if a function has no value.
    """

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
