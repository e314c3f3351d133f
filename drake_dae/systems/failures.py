"""How a simulation tells that a function has no value."""

from collections.abc import Mapping, Sequence

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.signals import Signal
from drake_dae.errors import NonFiniteError, SimulationError, SingularityError
from drake_dae.trace.functions import Failure, Fault


def simulation_error(
    failure: Failure,
    time: float,
    state: FloatArray,
    signals: Mapping[str, Sequence[Signal]],
) -> SimulationError:
    """The exception for a function that has no value in a simulation.

    Args:
        failure: What was wrong with the values.
        time: The time, in s.
        state: The state, shape (n,).
        signals: Name of an input -> names of its entries; the name of the input serves otherwise.
    """
    where = f"at t = {time:.6g} s, state {show(state)}"
    bad = ", ".join(
        signals[name][i].name if name in signals else name
        for name, entries in failure.inputs.items()
        for i in (entries if name in signals else entries[:1])
    )
    match failure.fault:
        case Fault.INPUT:
            return NonFiniteError(
                f"{failure.function}: its input {bad} is not finite {where}", time, state
            )
        case Fault.OVERFLOW:
            return NonFiniteError(
                f"{failure.function}: its input {bad} is beyond all measure {where}: it grows "
                "without bound. Look at the gains, and at what the model has wrong",
                time,
                state,
            )
        case Fault.VALUE:
            return NonFiniteError(
                f"{failure.function} is not finite {where}: a function left its domain or is not "
                "differentiable there, or a matrix that is inverted is singular",
                time,
                state,
            )
        case Fault.SINGULAR:
            return SingularityError(
                f"{failure.singular} is singular {where}, so {failure.function} is not determined "
                "there: a singular configuration, through which smaller steps do not lead. A plant "
                "passes one only where its velocity leads across, along one branch. Keep away from "
                "this state, or choose other constraints or outputs",
                time,
                state,
            )
