"""The numbers of a diagram that a person can change while the diagram runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.systems.framework import (
    Context,
    Diagram,
    InputPort,
    PortDataType,
    System,
)

from drake_dae.arrays import FloatArray
from drake_dae.compiler.wires import Wires, leaf_inputs
from drake_dae.dae import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.running.export.steps.words import block_name, distinct, parameters_of_block
from drake_dae.systems.control.contract import SIGNAL

PUSH = "push."
"""The prefix of the names of the wrenches that push links."""


@dataclass(frozen=True, eq=False)
class Inputs:
    """The numeric parameters of the blocks of a diagram, and its free inputs, as one vector.

    Attributes:
        blocks: A block with numeric parameter 0 -> the index of its first entry.
        ports: An input port without connection -> the index of its first entry.
        names, units: The name and the unit of each entry.
    """

    blocks: Mapping[System, int]
    ports: Mapping[InputPort, int]
    names: Sequence[str]
    units: Sequence[str]

    @classmethod
    def of(cls, loop: ClosedLoop | Diagram, context: Context | None = None) -> "Inputs":
        """Returns the inputs of a loop or diagram.

        The blocks of a loop are its generators, plant and controller; of a diagram, all blocks.

        Args:
            loop: The loop, or any diagram.
            context: A context of the diagram, with the values of its inputs; the default context if
                None.
        """
        diagram = loop if isinstance(loop, Diagram) else loop.diagram
        if context is None:
            context = diagram.CreateDefaultContext()
        if isinstance(loop, Diagram):
            systems, free = _parts_of_diagram(loop, context)
        else:
            sources = loop.generator, loop.exogenous, loop.plant_exogenous
            systems = [*sources, loop.plant, loop.controller]
            inputs = [(port.get_name(), port) for port in _vector_inputs(diagram)]
            free = [(name, p) for name, p in inputs if name.startswith(SIGNAL)]
        blocks, signals = dict[System, int](), list[Signal]()
        for block in systems:
            if block is None:
                continue
            block_context = block.GetMyContextFromRoot(context)
            if block_context.num_numeric_parameter_groups():
                blocks[block] = len(signals)
                size = block_context.get_numeric_parameter(0).size()
                signals += parameters_of_block(block, size)
        ports = dict[InputPort, int]()
        for name, port in free:
            ports[port] = len(signals)
            names = [f"{name}[{i}]" for i in range(port.size())] if port.size() > 1 else [name]
            signals += map(Signal, names)
        signals = distinct(signals)
        return cls(blocks, ports, [s.name for s in signals], [s.unit for s in signals])

    def values(self, context: Context) -> FloatArray:
        """Returns their values in a context of the diagram; zero for ports without a value."""
        contexts = (block.GetMyContextFromRoot(context) for block in self.blocks)
        parts = [c.get_numeric_parameter(0).CopyToVector() for c in contexts]
        parts += [_port_value(port, context) for port in self.ports]
        return np.concatenate([np.zeros(0), *parts])


def _port_value(port: InputPort, context: Context) -> FloatArray:
    """Returns a copy of the value of an input port; zero without a value."""
    system_context = port.get_system().GetMyContextFromRoot(context)
    has_value = port.HasValue(system_context)
    return np.array(port.Eval(system_context)) if has_value else np.zeros(port.size())


def with_input_values(diagram: Diagram, context: Context) -> Context:
    """Returns a copy of a context of a diagram, with zero for vector inputs without a value."""
    copy = context.Clone()
    for port in _vector_inputs(diagram):
        if not port.HasValue(copy):
            port.FixValue(copy, np.zeros(port.size()))
    return copy


def _vector_inputs(system: System) -> list[InputPort]:
    ports = (system.get_input_port(index) for index in range(system.num_input_ports()))
    return [port for port in ports if port.get_data_type() == PortDataType.kVectorValued]


def _parts_of_diagram(
    diagram: Diagram, context: Context
) -> tuple[Sequence[System], list[tuple[str, InputPort]]]:
    """Returns the blocks of a diagram and its free inputs.

    Free are the inputs of the diagram, and unconnected inputs of blocks that have a fixed value.
    """
    wires, count = Wires.of(diagram), diagram.num_input_ports()
    exported = list(chain.from_iterable(leaf_inputs(diagram, index) for index in range(count)))
    free = [(port.get_name(), port) for port in _vector_inputs(diagram) if port.size()]
    for system in wires.systems:
        connected = {port for target, port in chain(wires.sources, exported) if target is system}
        system_context = system.GetMyContextFromRoot(context)
        free += [
            (f"{block_name(system)}.{port.get_name()}", port)
            for port in _vector_inputs(system)
            if int(port.get_index()) not in connected and port.HasValue(system_context)
        ]
    # The parameters of geometry have no names.
    return [system for system in wires.systems if not isinstance(system, SceneGraph)], free
