"""A whole diagram as C functions: its derivatives, its outputs and its discrete updates."""

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.compiler.rates import ColumnPlace
from drake_dae.dae import Signal
from drake_dae.running.export.text import CFunction, Vector
from drake_dae.trace.functions import TracedFunction

ARGUMENTS = ("time", "loop_state", "loop_held", "loop_parameters")
"""The C names of the arguments of all these functions."""


def whole_vectors(compiled: CompiledDiagram, parameters: FloatArray) -> dict[str, Vector]:
    """The arguments and results of the diagram's functions, by their C names.

    Args:
        compiled: The diagram.
        parameters: The default parameters, from `CompiledDiagram.values`.
    """
    sizes = compiled.sizes
    state = signals_of(compiled, compiled.states, sizes["state"], "state")
    held = signals_of(compiled, compiled.held, sizes["held"], "held")
    vectors = {
        "time": Vector("t", [Signal("time", "s")]),
        "loop_state": Vector("the states of all blocks, in the order of the diagram", state),
        "loop_held": Vector("what blocks hold between their samples", held),
        "loop_parameters": Vector(
            "of all blocks, in the order of the diagram",
            signals_of(compiled, compiled.parameters, sizes["parameters"], "parameter"),
            parameters,
        ),
        "loop_rate": Vector("the derivative of loop_state", [s.derivative(1) for s in state]),
    }
    if sizes["noise"]:
        noise = signals_of(compiled, compiled.noise, sizes["noise"], "noise")
        vectors["loop_noise"] = Vector("new random numbers of deviation 1", noise)
    outputs = [signal for signals in compiled.signals.values() for signal in signals]
    vectors["loop_outputs"] = Vector(
        f"the outputs {', '.join(compiled.outputs)} below each other", outputs
    )
    for number, rate in enumerate(compiled.rates):
        vectors[f"loop_update_{number}"] = Vector(
            f"loop_held from t = {rate.offset:g} s + k {rate.period:g} s on, for its entries "
            f"{', '.join(map(str, rate.places))}",
            [held[place] for place in rate.places],
        )
    return vectors


def whole_calls(compiled: CompiledDiagram) -> dict[str, CFunction]:
    """The functions of the diagram, by their C names."""
    calls = {
        "loop_rate": _call("loop_rate", compiled.rate, ARGUMENTS),
        "loop_outputs": _call("loop_outputs", compiled.row, ARGUMENTS),
    }
    noise = ("loop_noise",) if compiled.sizes["noise"] else ()
    for number, rate in enumerate(compiled.rates):
        name = f"loop_update_{number}"
        calls[name] = _call(name, rate.function, (*ARGUMENTS, *noise))
    return {name: call for name, call in calls.items() if call.function.outputs[0].size}


def whole_values(
    compiled: CompiledDiagram, start: tuple[FloatArray, FloatArray], state: FloatArray
) -> Mapping[str, FloatArray]:
    """Sample arguments of the diagram's functions, except time and parameters.

    Args:
        compiled: The diagram.
        start: The continuous and the discrete state of the diagram at the start.
        state: The state of the plant; other blocks keep their state at the start.
    """
    states, held = start[0].copy(), start[1].copy()
    for system, part in compiled.states:
        if compiled.blocks[system].check_start is not None:
            states[part] = state
    noise = np.linspace(-1.0, 1.0, compiled.sizes["noise"])
    return {"loop_state": states, "loop_held": held, "loop_noise": noise}


def _call(name: str, function: ca.Function, inputs: Sequence[str]) -> CFunction:
    """A function of the diagram, with a pivot that is 0 if its values are not valid."""
    symbols = {key: ca.SX.sym(key, function.numel_in(i)) for i, key in enumerate(inputs)}
    arguments = list(symbols.values())
    if len(arguments) < function.n_in():
        arguments.append(ca.SX(0, 1))
    value, valid = function.call(arguments)
    regular = ca.if_else(ca.fabs(valid) < np.inf, 1.0, 0.0)
    traced = TracedFunction(name, symbols, {name: value}, regular, often=False)
    return CFunction(traced, list(inputs), [name])


def signals_of(
    compiled: CompiledDiagram, places: Sequence[ColumnPlace], size: int, what: str
) -> list[Signal]:
    """Names and units of the entries of a column of a diagram.

    The names come from the signals of each block, or from its name and a number.

    Args:
        compiled: The diagram.
        places: The entries of each block in the column.
        size: The number of all entries.
        what: The key of these signals in a block's `ports`, and their name if they have none.
    """
    signals = [Signal("")] * size
    for system, part in places:
        own = compiled.blocks[system].ports.get(what, ())
        count = part.stop - part.start
        if len(own) != count:
            own = tuple(Signal(f"{system.get_name()}.{what}[{i}]") for i in range(count))
        signals[part] = own
    for system, name, part in compiled.fixed if what == "parameter" else ():
        count = part.stop - part.start
        signals[part] = [Signal(f"{system.get_name()}.{name}[{i}]") for i in range(count)]
    return signals
