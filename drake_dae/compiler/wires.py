"""The leaf systems of a diagram and their connections, with nested diagrams flattened."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from pydrake.systems.framework import (
    Diagram,
    InputPortIndex,
    OutputPort,
    OutputPortIndex,
    System,
)

from drake_dae.blocks.computations import Traced

Port = tuple[System, int]
"""A system and the index of one of its ports; a diagram only if it is one block (`Traced`)."""


@dataclass(frozen=True, eq=False)
class Wires:
    """The leaf systems of a diagram and the connections between their ports.

    Attributes:
        diagram: The diagram.
        systems: The leaf systems, in the order of Drake's states and parameters.
        sources: Input port -> the output port that it is connected to. Unconnected input ports are
            not among the keys.
        outputs: Name of an output port of the diagram -> the port of a leaf.
        inputs: Name -> the output port of a leaf where the connection is cut; its value is an
            external input.
    """

    diagram: Diagram
    systems: tuple[System, ...]
    sources: dict[Port, Port]
    outputs: dict[str, Port]
    inputs: Mapping[str, Port] = field(default_factory=dict)

    def part(self, inputs: Mapping[str, Port], outputs: Mapping[str, Port]) -> "Wires":
        """The part of the diagram between some output ports of leaves and others."""
        return replace(self, inputs=dict(inputs), outputs=dict(outputs))

    @classmethod
    def of(cls, diagram: Diagram) -> "Wires":
        """Collects the leaf systems of a diagram and their connections."""
        systems: list[System] = []
        sources: dict[Port, Port] = {}
        _collect(diagram, systems, sources)
        outputs = {
            diagram.get_output_port(index).get_name(): _output(diagram, index)
            for index in range(diagram.num_output_ports())
        }
        return cls(diagram, tuple(systems), sources, outputs)


def _collect(diagram: Diagram, systems: list[System], sources: dict[Port, Port]) -> None:
    for system in diagram.GetSystems():
        if isinstance(system, Diagram) and not isinstance(system, Traced):
            _collect(system, systems, sources)
        else:
            systems.append(system)
    for (reader, read), (writer, written) in diagram.connection_map().items():
        source = _output(writer, int(written))
        for port in leaf_inputs(reader, int(read)):
            sources[port] = source


def leaf_port(port: OutputPort) -> Port:
    """The port of a leaf that an output port exports; a leaf's port is returned as is."""
    return _output(port.get_system(), int(port.get_index()))


def _output(system: System, index: int) -> Port:
    """The port of a leaf that an output port exports, through all nested diagrams."""
    while isinstance(system, Diagram) and not isinstance(system, Traced):
        system, inner = system.get_output_port_locator(OutputPortIndex(index))
        index = int(inner)
    return system, index


def leaf_inputs(system: System, index: int) -> list[Port]:
    """The input ports of leaves that a diagram exports as this input port."""
    if not isinstance(system, Diagram) or isinstance(system, Traced):
        return [(system, index)]
    locators = system.GetInputPortLocators(InputPortIndex(index))
    return [leaf for inner, port in locators for leaf in leaf_inputs(inner, int(port))]
