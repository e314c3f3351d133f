"""Compiles a Drake diagram to CasADi functions: derivative, updates, outputs."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import casadi as ca
from pydrake.systems.framework import Context, Diagram, OutputPort, PortDataType, System

from drake_dae.arguments import checked
from drake_dae.arrays import unknown_name
from drake_dae.blocks.computations import (
    DERIVATIVE,
    HELD,
    NOISE,
    PARAMETERS,
    STATE,
    Computation,
    Computations,
)
from drake_dae.compiler.compiled import ARGUMENTS, CompiledDiagram
from drake_dae.compiler.rates import ColumnPlace, UpdateRate, appended, dense_function
from drake_dae.compiler.trace import Expressions
from drake_dae.compiler.wires import Port, Wires, leaf_port
from drake_dae.errors import ModelError


@checked(ModelError)
def compile_diagram(
    diagram: Diagram,
    outputs: Sequence[str] | Mapping[str, OutputPort] | None = None,
    *,
    context: Context | None = None,
) -> CompiledDiagram:
    """Compiles a diagram to CasADi functions: its state derivative, updates and outputs.

    The diagram may contain this library's blocks that implement `Traced`, and every system that
    Drake converts to symbolic expressions: Drake's primitives, and LeafSystems templated on the
    scalar type. Nested diagrams are flattened. Systems on which no output depends, such as loggers,
    are left out.

    Args:
        diagram: The diagram.
        outputs: The names of output ports of the diagram, or name -> output port of a system in it;
            all vector-valued output ports of the diagram if None.
        context: A context of the diagram, in which unconnected input ports have fixed values; these
            values become parameters. The default context if None.

    Raises:
        ModelError: An output does not exist, an input port has neither a connection nor a value,
            the diagram has an algebraic loop, or a block cannot be traced.
    """
    wires = Wires.of(diagram)
    if isinstance(outputs, Mapping):
        wires = replace(wires, outputs={name: leaf_port(port) for name, port in outputs.items()})
    return _compiled(wires, None if outputs is None else list(outputs), context)


def compile_part(
    diagram: Diagram,
    inputs: Mapping[str, OutputPort],
    outputs: Mapping[str, OutputPort],
    context: Context | None = None,
) -> CompiledDiagram:
    """Compiles the part of a diagram between some output ports and others.

    Systems upstream of the inputs are ignored, so they need not be traceable (for example a
    MultibodyPlant with Drake's contact). The inputs are the last entries of the parameters; see
    `CompiledDiagram.inputs`. Raises as `compile_diagram` does.

    Args:
        diagram: The diagram.
        inputs: Name -> the output port, of a system in the diagram, that is an input of the part.
        outputs: Name -> the output port, of a system in the diagram, that is computed.
        context: As in `compile_diagram`.
    """
    wires = Wires.of(diagram).part(
        {name: leaf_port(port) for name, port in inputs.items()},
        {name: leaf_port(port) for name, port in outputs.items()},
    )
    return _compiled(wires, list(outputs), context)


def with_twins(compiled: CompiledDiagram) -> CompiledDiagram:
    """Recompiles a diagram for runs in which plants and their laws have equal parameters.

    The functions keep their arguments and ignore the parameters of the plants, see
    `CompiledDiagram.twins`. They need fewer operations: expressions that plant and law share are
    computed once, and the plant's derivative follows from the law's intermediate results where
    `Computations.under` gives it. Returns the diagram itself if it has no such plants.
    """
    if not compiled.twins:
        return compiled
    arguments = compiled.wires, compiled.outputs, compiled.context, compiled.twins
    plain, short = (_compiled(*arguments, is_short=is_short) for is_short in (False, True))
    is_shorter = short.rate.n_instructions() < 0.9 * plain.rate.n_instructions()
    return short if is_shorter else plain


def _compiled(
    wires: Wires,
    outputs: Sequence[str] | None,
    context: Context | None,
    twins: Mapping[System, System] | None = None,
    is_short: bool = False,
) -> CompiledDiagram:
    if outputs is None:
        outputs = [
            name
            for name, (system, index) in wires.outputs.items()
            if system.get_output_port(index).get_data_type() == PortDataType.kVectorValued
        ]
    for name in outputs:
        if name not in wires.outputs:
            raise ModelError(unknown_name("output port of the diagram", name, wires.outputs))
    context = context or wires.diagram.CreateDefaultContext()
    expressions = Expressions(wires, context, twins or {}, is_short)
    ports = [wires.outputs[name] for name in outputs]
    _trace_dependencies(expressions, ports)
    blocks = {
        system: expressions.used[system] for system in wires.systems if system in expressions.used
    }
    columns, places = {"time": expressions.time}, {}
    sources = {"state": STATE, "held": HELD, "parameters": PARAMETERS, "noise": NOISE}
    for name, source in sources.items():
        columns[name], places[name] = _stacked(expressions, blocks, source)
    fixed, inputs = [], []
    for (system, name), symbol in expressions.symbols.items():
        if name not in sources.values():
            columns["parameters"], part = appended(columns["parameters"], symbol)
            fixed.append((system, name, part))
    for name, symbol in expressions.inputs.items():
        columns["parameters"], part = appended(columns["parameters"], symbol)
        inputs.append((name, part))
    values: dict[str, Sequence[ca.SX]] = {
        "rate": expressions.checked(
            lambda: [expressions.output(system, DERIVATIVE) for system, _ in places["state"]]
        ),
        "row": expressions.checked(lambda: [expressions.port(port) for port in ports]),
    }
    arguments = [columns[name] for name in (*ARGUMENTS, "noise")]
    rates = _rates(expressions, blocks, places["held"], arguments)
    values |= {f"update_{i}": updated for i, (_, updated) in enumerate(rates)}
    _check_stepped(blocks, places["state"])
    return CompiledDiagram(
        wires,
        context,
        tuple(outputs),
        tuple(places["state"]),
        tuple(places["held"]),
        tuple(places["parameters"]),
        tuple(fixed),
        tuple(inputs),
        tuple(places["noise"]),
        tuple(rate for rate, _ in rates),
        blocks,
        expressions,
        columns,
        values,
    )


def _trace_dependencies(expressions: Expressions, outputs: Sequence[Port]) -> None:
    """Traces all systems on which output ports depend, directly or through states.

    Raises:
        ModelError: A system cannot be traced.
    """
    for port in outputs:
        expressions.port(port)
    done: list[System] = []
    while len(done) < len(expressions.used):
        for system, block in list(expressions.used.items()):
            if system in done:
                continue
            done.append(system)
            if any(DERIVATIVE in computation.outputs for computation in block.computations):
                expressions.output(system, DERIVATIVE)
            for update in block.updates:
                expressions.call(block, update.computation)
            if block.stepped is not None:
                expressions.source(block, HELD)
                expressions.source(block, block.stepped.into)
            if block.initial is not None:
                expressions.call(block, block.initial)


def _check_stepped(blocks: Mapping[System, Computations], states: Sequence[ColumnPlace]) -> None:
    """Raises if a block that Drake steps is combined with a block that is not sampled."""
    stepped = [block.system.get_name() for block in blocks.values() if block.stepped is not None]
    if not stepped:
        return
    others = [system for system, _ in states]
    if others or len(stepped) > 1:
        other = others[0].get_name() if others else stepped[1]
        raise ModelError(
            f"a rollout cannot combine '{stepped[0]}', which has Drake's own contact, with "
            f"'{other}', which has a continuous state. Sample the "
            "law, with a force sensor without a time constant, or run the loop by simulate"
        )


def _stacked(
    expressions: Expressions, blocks: Mapping[System, Computations], name: str
) -> tuple[ca.SX, list[ColumnPlace]]:
    """The symbols of all blocks stacked in one column, and the slice of each block."""
    column, places = ca.SX(0, 1), []
    for system in blocks:
        symbol = expressions.symbols.get((system, name))
        if symbol is not None and symbol.numel():
            column, part = appended(column, symbol)
            places.append(ColumnPlace(system, part))
    return column, places


def _rates(
    expressions: Expressions,
    blocks: Mapping[System, Computations],
    held: Sequence[ColumnPlace],
    arguments: Sequence[ca.SX],
) -> list[tuple[UpdateRate, tuple[ca.SX, ca.SX]]]:
    """The updates of all blocks, grouped by period, offset and kind, with their expressions.

    The update of a block that Drake steps is the last one.
    """
    parts = {system: range(part.start, part.stop) for system, part in held}
    groups: dict[tuple[float, float, bool], list[tuple[Computations, Computation]]] = {}
    for block in blocks.values():
        for update in block.updates:
            key = update.period, update.offset, update.is_unrestricted
            groups.setdefault(key, []).append((block, update.computation))

    def next_held(updates: Sequence[tuple[Computations, Computation]]) -> list[ca.SX]:
        calls = [expressions.call(*update) for update in updates]
        return [call.results[call.computation.outputs.index(HELD)] for call in calls]

    def stepped_input(block: Computations, port: str) -> list[ca.SX]:
        return [expressions.source(block, port)]

    rates = []
    for key, updates in groups.items():
        places = tuple(i for block, _ in updates for i in parts[block.system])
        values = expressions.checked(partial(next_held, updates))
        expanded = expressions.expanded(values)
        # A block of several rates changes only a part of what it holds at each.
        kept = [
            j
            for j, (new, i) in enumerate(zip(expanded[0].elements(), places, strict=True))
            if not ca.is_equal(new, arguments[2][i])
        ]
        values, expanded = (values[0][kept], values[1]), [expanded[0][kept], *expanded[1:]]
        function = dense_function("update", arguments, expanded)
        rates.append((UpdateRate(*key, function, tuple(places[j] for j in kept)), values))
    for block in blocks.values():
        if (stepped := block.stepped) is not None:
            values = expressions.checked(partial(stepped_input, block, stepped.into))
            function = dense_function("update", arguments, expressions.expanded(values))
            count = sum(stepped.system.GetOutputPort(name).size() for name in stepped.ports)
            places = tuple(parts[block.system][:count])
            rates.append((UpdateRate(stepped.period, 0.0, True, function, places, block), values))
    return rates
