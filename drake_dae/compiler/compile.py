"""A Drake diagram as functions, one for each of its rates."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, Diagram, InputPort, OutputPort, System

from drake_dae.arguments import checked
from drake_dae.arrays import unknown_name
from drake_dae.compiler.compiled import ARGUMENTS, CompiledDiagram
from drake_dae.compiler.rates import ColumnPlace, UpdateRate, dense_function
from drake_dae.compiler.trace import Expressions
from drake_dae.compiler.wires import Port, Wires, leaf_port
from drake_dae.errors import ModelError
from drake_dae.systems.blocks.traced import (
    DERIVATIVE,
    GAPS,
    HELD,
    MARGINS,
    NOISE,
    PARAMETERS,
    RATES,
    STATE,
    Block,
    Computation,
)


@checked(ModelError)
def compile_diagram(
    diagram: Diagram,
    outputs: Sequence[str] | None = None,
    *,
    context: Context | None = None,
) -> CompiledDiagram:
    """A diagram as functions of CasADi: one for its derivative, one for each of its rates.

    What stands in it may be any block of this library that tells what it computes (`Traced`), and
    any system that converts to symbolic expressions: Drake's primitives, and a user's LeafSystem
    that is a template on its scalar. Diagrams inside it are taken apart. The wires are followed
    back from the outputs; what does not lead to them, as a logger, is left out.

    Args:
        diagram: The diagram.
        outputs: The names of output ports of the diagram; all that have vectors if None.
        context: A context of the diagram in which inputs without a wire have values; these become
            parameters. The default context if None.

    Raises:
        ModelError: There is no such output, an input has neither a wire nor a value, blocks close
            an algebraic loop, or a block cannot be traced: its name and why.
    """
    return _compiled(Wires.of(diagram), outputs, context)


def compile_part(
    diagram: Diagram,
    inputs: Mapping[str, OutputPort],
    outputs: Mapping[str, OutputPort],
    context: Context | None = None,
) -> CompiledDiagram:
    """A part of a diagram as functions: what leads from some output ports to others.

    What stands behind the inputs is not looked at, and may be what no function knows, such as
    Drake's own contact. Inputs are the last entries of the parameters, see
    `CompiledDiagram.inputs`.

    Args:
        diagram: The diagram.
        inputs: Name -> the output port of a system in it whose value is an input of the part.
        outputs: Name -> the output port of a system in it that is computed.
        context: As of `compile_diagram`.

    Raises:
        ModelError: As of `compile_diagram`.
    """
    wires = Wires.of(diagram).part(
        {name: leaf_port(port) for name, port in inputs.items()},
        {name: leaf_port(port) for name, port in outputs.items()},
    )
    return _compiled(wires, None, context)


def compile_open(
    diagram: Diagram, inputs: Sequence[InputPort], outputs: Mapping[str, OutputPort]
) -> CompiledDiagram:
    """A part of a diagram as functions, with some input ports of its systems as parameters.

    The wires to these ports are cut, and what comes to others is computed. So a plant with its
    exogenous signals stands alone, whose control is given.

    Args:
        diagram: The diagram.
        inputs: Input ports of systems in it; see `CompiledDiagram.fixed` for their places.
        outputs: Name -> the output port of a system in it that is computed.

    Raises:
        ModelError: As of `compile_diagram`.
    """
    wires, context = Wires.of(diagram), diagram.CreateDefaultContext()
    cut = {(port.get_system(), int(port.get_index())) for port in inputs}
    for port in inputs:
        port.FixValue(port.get_system().GetMyMutableContextFromRoot(context), np.zeros(port.size()))
    sources = {taken: source for taken, source in wires.sources.items() if taken not in cut}
    systems = tuple(one for one in wires.systems if not getattr(one, "ends_runs", False))
    ports = {name: leaf_port(port) for name, port in outputs.items()}
    return _compiled(replace(wires, systems=systems, sources=sources, outputs=ports), None, context)


def with_twins(compiled: CompiledDiagram) -> CompiledDiagram:
    """A compiled diagram whose plants have the parameters of their laws; itself without such.

    It has the same arguments, of which it ignores the plants' parameters, and fewer operations:
    what plant and law both compute is computed once, and where the law says how, the plant's
    derivative follows from what the law wants. See `CompiledDiagram.has_twins`.
    """
    twins = compiled.twins
    if not twins:
        return compiled
    given = compiled.wires, compiled.outputs, compiled.context, twins
    plain, short = (_compiled(*given, is_short=is_short) for is_short in (False, True))
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
        outputs = [name for name, port in wires.outputs.items() if _is_vector(port)]
    for name in outputs:
        if name not in wires.outputs:
            raise ModelError(unknown_name("output port of the diagram", name, wires.outputs))
    context = context or wires.diagram.CreateDefaultContext()
    expressions = Expressions(wires, context, twins or {}, is_short)
    chosen = [wires.outputs[name] for name in outputs]
    for system in wires.systems:
        # It counts, though it leads to no output; a part of a diagram does not end its run.
        if getattr(system, "ends_runs", False) and not wires.inputs:
            expressions.block(system)
    _needed_systems(expressions, chosen)
    blocks = {each: expressions.used[each] for each in wires.systems if each in expressions.used}
    columns, places = {"time": expressions.time}, {}
    own = {"state": STATE, "held": HELD, "parameters": PARAMETERS, "noise": NOISE}
    for name, source in own.items():
        columns[name], places[name] = _stacked(expressions, blocks, source)
    fixed = []
    for (system, name), symbol in expressions.symbols.items():
        if name not in own.values():
            first = columns["parameters"].numel()
            fixed.append((system, name, slice(first, first + symbol.numel())))
            columns["parameters"] = ca.vertcat(columns["parameters"], symbol)
    inputs = []
    for name, symbol in expressions.inputs.items():
        first = columns["parameters"].numel()
        inputs.append((name, slice(first, first + symbol.numel())))
        columns["parameters"] = ca.vertcat(columns["parameters"], symbol)
    given = [columns[name] for name in (*ARGUMENTS, "noise")]
    asked: dict[str, Sequence[ca.SX]] = {
        "rate": expressions.checked(
            lambda: [expressions.output(system, DERIVATIVE) for system, _ in places["state"]]
        ),
        "row": expressions.checked(lambda: [expressions.port(port) for port in chosen]),
    }
    rates = _rates(expressions, blocks, places["held"], given)
    asked |= {f"update_{i}": values for i, (_, values) in enumerate(rates)}
    guards = dict[str, list[ColumnPlace]]()
    for name, in_samples in (("guard", False), ("watch", True)):
        own_blocks = [
            block
            for block in blocks.values()
            if block.guard is not None and block.guard.in_samples is in_samples
        ]
        guards[name] = []
        if own_blocks:
            asked[name], guards[name] = _guards(expressions, own_blocks)
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
        tuple(guards["guard"]),
        tuple(guards["watch"]),
        expressions,
        columns,
        asked,
    )


def _needed_systems(expressions: Expressions, outputs: Sequence[Port]) -> list[System]:
    """The systems that some output ports depend on, by way of states too, all of them traced.

    Raises:
        ModelError: One cannot be traced.
    """
    for port in outputs:
        expressions.port(port)
    done: list[System] = []
    while len(done) < len(expressions.used):
        for system, block in list(expressions.used.items()):
            if system in done:
                continue
            done.append(system)
            if _has_state(block):
                expressions.output(system, DERIVATIVE)
            for update in block.updates:
                expressions.call(block, update.computation)
            if block.guard is not None:
                expressions.call(block, block.guard.computation)
            if block.stepped is not None:
                expressions.source(block, HELD)
                expressions.source(block, block.stepped.reads)
            if block.initial is not None:
                expressions.call(block, block.initial)
    return done


def _has_state(block: Block) -> bool:
    return any(DERIVATIVE in one.outputs for one in block.computations)


def _check_stepped(blocks: Mapping[System, Block], states: Sequence[ColumnPlace]) -> None:
    """Refuses what cannot be sampled beside a block that Drake steps."""
    stepped = [block.system.get_name() for block in blocks.values() if block.stepped is not None]
    if not stepped:
        return
    changing = [block.system for block in blocks.values() if block.guard is not None]
    others = [*(system for system, _ in states), *changing]
    if others or len(stepped) > 1:
        other = others[0].get_name() if others else stepped[1]
        raise ModelError(
            f"'{stepped[0]}' has Drake's own contact, beside which a rollout knows samplers alone, "
            f"and not '{other}', which has a continuous state, phases or contact of its own: "
            "sample the law, with a force sensor without a time constant, or run the loop by "
            "simulate"
        )


def _is_vector(port: tuple[System, int]) -> bool:
    system, index = port
    try:
        return bool(system.get_output_port(index).size() >= 0)
    except RuntimeError:
        return False


def _stacked(
    expressions: Expressions, blocks: Mapping[System, Block], name: str
) -> tuple[ca.SX, list[ColumnPlace]]:
    """The symbols of all blocks below each other, and where those of each stand."""
    column, places = ca.SX(0, 1), []
    for system in blocks:
        symbol = expressions.symbols.get((system, name))
        if symbol is None or not symbol.numel():
            continue
        first = column.numel()
        places.append(ColumnPlace(system, slice(first, first + symbol.numel())))
        column = ca.vertcat(column, symbol)
    return column, places


def _rates(
    expressions: Expressions,
    blocks: Mapping[System, Block],
    held: Sequence[ColumnPlace],
    given: Sequence[ca.SX],
) -> list[tuple[UpdateRate, tuple[ca.SX, ca.SX]]]:
    """The updates of all blocks, those of one instant together, and what they compute.

    Those come last that Drake makes.
    """
    parts = dict(held)
    groups: dict[tuple[float, float, bool], list[tuple[Block, Computation]]] = {}
    for block in blocks.values():
        for update in block.updates:
            key = update.period, update.offset, update.is_unrestricted
            groups.setdefault(key, []).append((block, update.computation))

    def asked(members: Sequence[tuple[Block, Computation]]) -> list[ca.SX]:
        calls = [expressions.call(*member) for member in members]
        return [call.results[call.computation.outputs.index(HELD)] for call in calls]

    found = []
    for key, members in groups.items():
        places = [i for block, _ in members for i in _entries(parts[block.system])]
        values = expressions.checked(partial(asked, members))
        function = dense_function("update", given, expressions.expanded(values))
        found.append((UpdateRate(*key, function, tuple(places)), values))
    for block in blocks.values():
        if (stepped := block.stepped) is not None:
            values = expressions.checked(partial(_read, expressions, block, stepped.reads))
            function = dense_function("update", given, expressions.expanded(values))
            count = sum(stepped.system.GetOutputPort(name).size() for name in stepped.ports)
            own = tuple(_entries(parts[block.system])[:count])
            found.append((UpdateRate(stepped.period, 0.0, True, function, own, block), values))
    return found


def _read(expressions: Expressions, block: Block, port: str) -> list[ca.SX]:
    return [expressions.source(block, port)]


def _guards(
    expressions: Expressions, blocks: Sequence[Block]
) -> tuple[list[ca.SX], list[ColumnPlace]]:
    """What the guards of blocks compute, validity last, and where the margins of each stand."""
    columns, places = [ca.SX(0, 1)] * 3, list[ColumnPlace]()

    def asked() -> list[ca.SX]:
        for block in blocks:
            assert block.guard is not None
            call = expressions.call(block, block.guard.computation)
            for i, name in enumerate((MARGINS, GAPS, RATES)):
                value = call.results[call.computation.outputs.index(name)]
                first = columns[i].numel()
                columns[i] = ca.vertcat(columns[i], value)
                if name == MARGINS:
                    places.append(ColumnPlace(block.system, slice(first, columns[i].numel())))
        return []

    _, valid = expressions.checked(asked)
    return [*columns, valid], places


def _entries(part: slice) -> range:
    return range(part.start, part.stop)
