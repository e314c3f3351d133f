"""Where a loop is cut, so that its controller, or its plant, stands alone."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydrake.systems.framework import (
    Context,
    Diagram,
    InputPortIndex,
    OutputPort,
    OutputPortIndex,
    System,
)

from drake_dae.compiler.compile import compile_part
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.compiler.wires import Port, Wires, leaf_port
from drake_dae.dae.system.signals import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.export.steps.ticks import Ticks
from drake_dae.systems.plants.contract import Plant

CONTROL = "control"
"""What a controller gives, and a plant takes."""


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a loop that is exported by itself.

    Attributes:
        compiled: Its functions; its inputs are the last of the parameters.
        inputs, outputs: Names and units of what it reads and shows.
        ticks: When it steps.
        acts_at_once: Whether its control depends on what is measured in the same instant; else it
            is held, and changes by the updates of an instant.
    """

    compiled: CompiledDiagram
    inputs: Mapping[str, tuple[Signal, ...]]
    outputs: Mapping[str, tuple[Signal, ...]]
    ticks: Ticks
    acts_at_once: bool


def controller_part(loop: ClosedLoop | Diagram, context: Context) -> Part:
    """All that leads from what a plant and its sensors show to the plant's control.

    That is the law, the references, observers, integrals, samples, delays, limits, and any block of
    a user between. Sensors are parts of the machine: what they show are inputs.

    Args:
        loop: The loop, or any diagram with one `Plant`.
        context: Its context at the start.

    Raises:
        ModelError: There is not one plant, or the controller has no steps: why.
    """
    diagram, plant = (
        (loop, _plant(loop)) if isinstance(loop, Diagram) else (loop.diagram, loop.plant)
    )
    wires, measured = Wires.of(diagram), _measured(diagram, plant)
    control = _control(wires, plant)
    systems, inputs = _upstream(wires, control, measured)
    acts_at_once = _reaches(wires, control, measured)
    outputs = {CONTROL: control}
    for name, port in wires.outputs.items():
        is_own = port != control and port not in measured and port[0] in systems
        if is_own and name != CONTROL and not _reaches(wires, port, measured):
            outputs[name] = port
    compiled = compile_part(
        diagram, {name: _port(p) for p, name in inputs.items()}, _ports(outputs), context
    )
    _check_steps(compiled)
    if acts_at_once and not plant.time_step:
        raise ModelError(
            "the controller acts continuously, and as one step it needs samples: give the loop a "
            "sampling, in a scenario `sampling: {period: 0.001}`"
        )
    known = _known_signals(loop, plant)
    return Part(
        compiled,
        {name: _signals(known, name, part.stop - part.start) for name, part in compiled.inputs},
        {
            name: _signals({**compiled.signals, **known}, name, _port(port).size())
            for name, port in outputs.items()
        },
        Ticks.of(compiled.rates, plant.time_step),
        acts_at_once,
    )


def plant_part(loop: ClosedLoop | Diagram, context: Context) -> Part:
    """The plant of a loop alone, whose input is its control.

    Args:
        loop, context: As of `controller_part`.

    Raises:
        ModelError: There is not one plant, or it cannot be traced: why.
    """
    diagram, plant = (
        (loop, _plant(loop)) if isinstance(loop, Diagram) else (loop.diagram, loop.plant)
    )
    wires, inputs = Wires.of(diagram), dict[str, OutputPort]()
    if plant.dae.num_controls:
        inputs[CONTROL] = _port(_control(wires, plant))
    known = _known_signals(loop, plant)
    names = ["state", "constraint_force", "constraint_residual", "controlled_output"]
    outputs = {
        name: plant.GetOutputPort(name) for name in names if plant.GetOutputPort(name).size()
    }
    compiled = compile_part(diagram, inputs, outputs, context)
    return Part(
        compiled,
        {name: _signals(known, name, port.size()) for name, port in inputs.items()},
        {name: _signals(known, name, port.size()) for name, port in outputs.items()},
        Ticks.of(compiled.rates),
        False,
    )


def _plant(diagram: Diagram) -> Plant:
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


def _measured(diagram: Diagram, plant: Plant) -> dict[Port, str]:
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


def _control(wires: Wires, plant: Plant) -> Port:
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


def _upstream(
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


def _reaches(wires: Wires, port: Port, measured: Mapping[Port, str]) -> bool:
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


def _check_steps(compiled: CompiledDiagram) -> None:
    """Refuses what a step does not know.

    Raises:
        ModelError: A block of the controller has a continuous state, phases or random numbers.
    """
    reasons: dict[str, tuple[Sequence[Any], Callable[[str], str]]] = {
        "state": (
            compiled.states,
            lambda name: (
                f"'{name}' has a continuous state, as integrals of a law without samples: "
                "give the loop a sampling, in a scenario `sampling: {period: 0.001}`"
            ),
        ),
        "phases": (
            (*compiled.guards, *compiled.watched),
            lambda name: f"'{name}' leads through phases in Python, which no C has; a rollout does",
        ),
        "noise": (
            compiled.noise,
            lambda name: (
                f"'{name}' draws random numbers, which are none of a controller's: leave "
                "it out, or put it behind a sensor"
            ),
        ),
    }
    for places, text in reasons.values():
        if places:
            raise ModelError(text(places[0].system.get_name()))


def _known_signals(loop: ClosedLoop | Diagram, plant: Plant) -> dict[str, tuple[Signal, ...]]:
    dae = plant.dae
    found: dict[str, Sequence[Signal]] = {
        "state": dae.state_signals,
        "estimated_state": dae.state_signals,
        "constraint_force": dae.force_signals,
        "measured_force": dae.constraint_input_signals,
        "constraint_residual": plant.structure.manifold.residual_signals,
        "controlled_output": dae.output_signals,
        CONTROL: dae.control_signals,
        **plant.further_signals,
        **({} if isinstance(loop, Diagram) else loop.signals),
    }
    return {name: tuple(signals) for name, signals in found.items()}


def _signals(known: Mapping[str, tuple[Signal, ...]], name: str, size: int) -> tuple[Signal, ...]:
    found = known.get(name, ())
    if len(found) == size:
        return found
    return tuple(Signal(f"{name}[{i}]") for i in range(size))


def _port(port: Port) -> OutputPort:
    return port[0].get_output_port(OutputPortIndex(port[1]))


def _ports(ports: Mapping[str, Port]) -> dict[str, OutputPort]:
    return {name: _port(port) for name, port in ports.items()}
