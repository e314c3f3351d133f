"""A whole diagram as functions of C: its derivative, its outputs, and what its blocks hold."""

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.compiler.rates import ColumnPlace
from drake_dae.dae.system.signals import Signal
from drake_dae.running.export.text import CFunction, Vector
from drake_dae.trace.functions import TracedFunction

ARGUMENTS = ("time", "loop_state", "loop_held", "loop_parameters")
"""What all these functions take."""


def whole_vectors(compiled: CompiledDiagram, parameters: FloatArray) -> dict[str, Vector]:
    """The vectors that functions of the diagram take and give, by their names in C.

    Args:
        compiled: The diagram.
        parameters: Their default, as `CompiledDiagram.values` has them.
    """
    sizes = compiled.sizes
    state = signals_of(compiled, compiled.states, sizes["state"], "state")
    held = signals_of(compiled, compiled.held, sizes["held"], "held")
    found = {
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
        found["loop_noise"] = Vector("new random numbers of deviation 1", noise)
    outputs = [signal for signals in compiled.signals.values() for signal in signals]
    found["loop_outputs"] = Vector(
        f"the outputs {', '.join(compiled.outputs)} below each other", outputs
    )
    for number, rate in enumerate(compiled.rates):
        found[f"loop_update_{number}"] = Vector(
            f"loop_held from t = {rate.offset:g} s + k {rate.period:g} s on, for its entries "
            f"{', '.join(map(str, rate.places))}",
            [held[place] for place in rate.places],
        )
    return found


def whole_calls(compiled: CompiledDiagram) -> dict[str, CFunction]:
    """The functions of the diagram, by their names in C."""
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
    """A sample of what these functions take, besides time and parameters.

    Args:
        compiled: The diagram.
        start: The state and what is held at the start.
        state: The plant's state; that of all else is as at the start.
    """
    found, held = start[0].copy(), start[1].copy()
    for system, part in compiled.states:
        if compiled.blocks[system].check_start is not None:
            found[part] = state
    noise = np.linspace(-1.0, 1.0, compiled.sizes["noise"])
    return {"loop_state": found, "loop_held": held, "loop_noise": noise}


def _call(name: str, function: ca.Function, inputs: Sequence[str]) -> CFunction:
    """A function of the diagram, whose pivot is 0 where its values are of no use."""
    symbols = {key: ca.SX.sym(key, function.numel_in(i)) for i, key in enumerate(inputs)}
    given = list(symbols.values())
    if len(given) < function.n_in():
        given.append(ca.SX(0, 1))
    value, valid = function.call(given)
    regular = ca.if_else(ca.fabs(valid) < np.inf, 1.0, 0.0)
    traced = TracedFunction(name, symbols, {name: value}, regular, often=False)
    return CFunction(traced, list(inputs), [name])


def signals_of(
    compiled: CompiledDiagram, places: Sequence[ColumnPlace], size: int, what: str
) -> list[Signal]:
    """Names and units of the entries of a column of a diagram.

    They are what a block calls them, or its name and a number.

    Args:
        compiled: The diagram.
        places: Where those of each block stand in the column.
        size: How many there are.
        what: What messages call one, and the port of a block that has such signals.
    """
    found = [Signal("")] * size
    for system, part in places:
        own = compiled.blocks[system].ports.get(what, ())
        count = part.stop - part.start
        if len(own) != count:
            own = tuple(Signal(f"{system.get_name()}.{what}[{i}]") for i in range(count))
        found[part] = own
    for system, name, part in compiled.fixed if what == "parameter" else ():
        count = part.stop - part.start
        found[part] = [Signal(f"{system.get_name()}.{name}[{i}]") for i in range(count)]
    return found
