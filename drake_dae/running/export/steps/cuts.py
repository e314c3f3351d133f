"""Where wires of a loop are cut: its plant, what is measured, and what leads to its control."""

from collections.abc import Mapping
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
"""What a controller gives, and a plant takes."""


def plant_of(diagram: Diagram) -> Plant:
    """The one plant of a diagram.

    Raises:
        ModelError: There are none or several.
    """
    found = list[Plant]()

    def look(system: System) -> None:
        if isinstance(system, Plant):
            found.append(system)
        elif isinstance(system, Diagram):
            for each in system.GetSystems():
                look(each)

    look(diagram)
    if len(found) != 1:
        raise ModelError(
            f"an export cuts a diagram at its plant, and this one has {len(found)}: a Plant, as "
            "RobotPlant, DaePlant or ContactPlant"
        )
    return found[0]


def measured_ports(diagram: Diagram, plant: Plant) -> dict[Port, str]:
    """What the plant and the sensors show: port of a leaf -> name."""
    names = dict[Port, str]()

    def add(system: System) -> None:
        for index in range(system.num_output_ports()):
            port = system.get_output_port(index)
            name = port.get_name()
            taken = name in names.values()
            names[leaf_port(port)] = f"{system.get_name()}_{name}" if taken else name

    def look(system: System) -> None:
        if system is plant or getattr(system, "measures", False):
            add(system)
        elif isinstance(system, Diagram):
            for each in system.GetSystems():
                look(each)

    look(diagram)
    return names


def control_port(wires: Wires, plant: Plant) -> Port:
    """What feeds the plant's control, also where the plant takes the law itself."""
    system: Any = plant
    for name in (CONTROL, "feedback"):
        if not plant.HasInputPort(name):
            continue
        index = int(plant.GetInputPort(name).get_index())
        while isinstance(system, Diagram) and (system, index) not in wires.sources:
            locators = system.GetInputPortLocators(InputPortIndex(index))
            if not locators:
                break
            system, index = locators[0][0], int(locators[0][1])
        source = wires.sources.get((system, index))
        if source is not None and name == CONTROL:
            return source
        if source is not None:
            return leaf_port(source[0].GetOutputPort(CONTROL))
        system = plant
    raise ModelError(
        f"nothing leads to the control of '{plant.get_name()}', so that there is no law"
    )


def upstream(
    wires: Wires, port: Port, measured: Mapping[Port, str]
) -> tuple[set[System], dict[Port, str]]:
    """The systems that lead to a port, and what they read that is measured."""
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
    """Whether a port depends on what is measured in the same instant."""
    done = set[Port]()

    def walk(found: Port) -> bool:
        if found in measured:
            return True
        if found in done:
            return False
        done.add(found)
        system, index = found
        for i in range(system.num_input_ports()):
            source = wires.sources.get((system, i))
            if source is None or not system.HasDirectFeedthrough(i, index):
                continue
            if walk(source):
                return True
        return False

    return walk(port)


def port_of(port: Port) -> OutputPort:
    """The output port of a leaf."""
    return port[0].get_output_port(OutputPortIndex(port[1]))
