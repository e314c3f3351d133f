"""The exceptions of a simulation, with time and state."""

from collections.abc import Mapping, Sequence

from drake_dae.arrays import FloatArray, show_state
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
