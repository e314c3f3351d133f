"""The wires of a diagram, those of the diagrams inside it included."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from pydrake.systems.framework import (
    Diagram,
    InputPortIndex,
    OutputPort,
    OutputPortIndex,
    System,
)

from drake_dae.systems.blocks.traced import Traced

Port = tuple[System, int]
"""A leaf system, or a diagram that is one block, and the index of one of its ports."""


@dataclass(frozen=True, eq=False)
class Wires:
    """The leaf systems of a diagram and what connects them.

    Attributes:
        diagram: The diagram.
        systems: The leaf systems, in the order of Drake's states and parameters.
        sources: Input port -> the output port that feeds it; an input without a wire is not there.
        outputs: Name of an output port of the diagram -> the leaf's port.
        inputs: Name -> an output port of a leaf at which wires are cut: what it shows is an input.
    """

    diagram: Diagram
    systems: tuple[System, ...]
    sources: dict[Port, Port]
    outputs: dict[str, Port]
    inputs: Mapping[str, Port] = field(default_factory=dict)

    def part(self, inputs: Mapping[str, Port], outputs: Mapping[str, Port]) -> "Wires":
        """The part of the diagram from some output ports of leaves to others."""
        return replace(self, inputs=dict(inputs), outputs=dict(outputs))

    @classmethod
    def of(cls, diagram: Diagram) -> "Wires":
        """The wires of a diagram."""
        systems: list[System] = []
        sources: dict[Port, Port] = {}
        _collect(diagram, systems, sources)
        outputs = {}
        for index in range(diagram.num_output_ports()):
            name = diagram.get_output_port(index).get_name()
            outputs[name] = _output(diagram, index)
        return cls(diagram, tuple(systems), sources, outputs)


def _collect(diagram: Diagram, systems: list[System], sources: dict[Port, Port]) -> None:
    for system in diagram.GetSystems():
        if isinstance(system, Diagram) and not isinstance(system, Traced):
            _collect(system, systems, sources)
        else:
            systems.append(system)
    for (taker, taken), (giver, given) in diagram.connection_map().items():
        source = _output(giver, int(given))
        for port in leaf_inputs(taker, int(taken)):
            sources[port] = source


def leaf_port(port: OutputPort) -> Port:
    """The leaf's port that an output port of any system shows."""
    return _output(port.get_system(), int(port.get_index()))


def _output(system: System, index: int) -> Port:
    """The leaf's port behind an output port."""
    while isinstance(system, Diagram) and not isinstance(system, Traced):
        system, inner = system.get_output_port_locator(OutputPortIndex(index))
        index = int(inner)
    return system, index


def leaf_inputs(system: System, index: int) -> list[Port]:
    """The leaves' ports behind an input port."""
    if not isinstance(system, Diagram) or isinstance(system, Traced):
        return [(system, index)]
    found = []
    for inner, port in system.GetInputPortLocators(InputPortIndex(index)):
        found += leaf_inputs(inner, int(port))
    return found
