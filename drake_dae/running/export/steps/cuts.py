"""Where a loop is cut for an export: its plant, measured ports, and blocks upstream of control."""

from collections.abc import Iterator, Mapping
from typing import Any

from pydrake.systems.framework import (
    Diagram,
    InputPortIndex,
    OutputPort,
    OutputPortIndex,
    System,
)

from drake_dae.compiler.wires import Port, Wires, leaf_port
from drake_dae.errors import ModelError
from drake_dae.systems.plants.contract import Plant

CONTROL = "control"
"""The name of a controller's output port and a plant's input port."""


def plant_of(diagram: Diagram) -> Plant:
    """Returns the plant of a diagram.

    Raises:
        ModelError: The diagram does not have exactly one plant.
    """
    plants = [system for system in _systems(diagram) if isinstance(system, Plant)]
    if len(plants) != 1:
        raise ModelError(
            f"an export cuts a diagram at its plant, and this one has {len(plants)}: a Plant, as "
            "RobotPlant, DaePlant or ContactPlant"
        )
    return plants[0]


def _systems(system: System) -> Iterator[System]:
    """The plants, the sensors and all other leaves in a diagram."""
    if isinstance(system, Diagram) and not (isinstance(system, Plant) or _measures(system)):
        for inner in system.GetSystems():
            yield from _systems(inner)
    else:
        yield system


def _measures(system: System) -> bool:
    return bool(getattr(system, "measures", False))


def measured_ports(diagram: Diagram, plant: Plant) -> dict[Port, str]:
    """The output ports of the plant and of sensors: port of a leaf -> name."""
    names = dict[Port, str]()
    for system in _systems(diagram):
        if not (system is plant or _measures(system)):
            continue
        for index in range(system.num_output_ports()):
            port = system.get_output_port(index)
            name = port.get_name()
            taken = name in names.values()
            names[leaf_port(port)] = f"{system.get_name()}_{name}" if taken else name
    return names


def control_port(wires: Wires, plant: Plant) -> Port:
    """The port that feeds the plant's control."""
    system: Any = plant
    index = int(plant.GetInputPort(CONTROL).get_index())
    while isinstance(system, Diagram) and (system, index) not in wires.sources:
        locators = system.GetInputPortLocators(InputPortIndex(index))
        if not locators:
            break
        system, index = locators[0][0], int(locators[0][1])
    source = wires.sources.get((system, index))
    if source is None:
        raise ModelError(
            f"nothing leads to the control of '{plant.get_name()}', so that there is no law"
        )
    return source


def upstream(
    wires: Wires, port: Port, measured: Mapping[Port, str]
) -> tuple[set[System], dict[Port, str]]:
    """The systems between measured ports and a port, and the measured ports that they read."""
    systems, inputs = set[System](), dict[Port, str]()

    def walk(system: System) -> None:
        if system in systems:
            return
        systems.add(system)
        for index in range(system.num_input_ports()):
            source = wires.sources.get((system, index))
            if source is not None and source in measured:
                inputs[source] = measured[source]
            elif source is not None:
                walk(source[0])

    walk(port[0])
    return systems, inputs


def reaches(wires: Wires, port: Port, measured: Mapping[Port, str]) -> bool:
    """Whether a port has direct feedthrough from a measured port."""
    visited = set[Port]()

    def walk(port: Port) -> bool:
        if port in measured:
            return True
        if port in visited:
            return False
        visited.add(port)
        system, index = port
        for i in range(system.num_input_ports()):
            source = wires.sources.get((system, i))
            if source is None or not system.HasDirectFeedthrough(i, index):
                continue
            if walk(source):
                return True
        return False

    return walk(port)


def port_of(port: Port) -> OutputPort:
    """The Drake port of (leaf system, index)."""
    return port[0].get_output_port(OutputPortIndex(port[1]))
