"""The parts of a loop that are exported by themselves: controller, plant, and all of it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydrake.systems.framework import Context, Diagram, OutputPort

from drake_dae.compiler.compile import compile_diagram, compile_part
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.compiler.wires import Wires
from drake_dae.dae.system.signals import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.export.steps.cuts import (
    CONTROL,
    control_port,
    measured_ports,
    plant_of,
    port_of,
    reaches,
    upstream,
)
from drake_dae.running.export.steps.ticks import Ticks
from drake_dae.running.rollout.program import program_of
from drake_dae.systems.plants.contract import Plant

NEVER = Ticks(0.0)
"""Of a part that steps whenever it is asked to."""


@dataclass(frozen=True, eq=False)
class ExportedPart:
    """A part of a loop that is exported by itself.

    Attributes:
        compiled: Its functions; its inputs are the last of the parameters.
        inputs, outputs: Names and units of what it reads and shows.
        ticks: When a controller steps.
        acts_at_once: Whether its control depends on what is measured in the same instant; else it
            is held, and changes by the updates of an instant.
    """

    compiled: CompiledDiagram
    inputs: Mapping[str, tuple[Signal, ...]]
    outputs: Mapping[str, tuple[Signal, ...]]
    ticks: Ticks = NEVER
    acts_at_once: bool = False


def controller_part(loop: ClosedLoop | Diagram, context: Context) -> ExportedPart:
    """All that leads from what a plant and its sensors show to the plant's control.

    That is the law, the references, observers, integrals, samples, delays, limits, and any block of
    a user between. Sensors are parts of the machine: what they show are inputs.

    Args:
        loop: The loop, or any diagram with one `Plant`.
        context: Its context at the start.

    Raises:
        ModelError: There is not one plant, or the controller has no steps: why.
    """
    diagram, plant = _diagram_and_plant(loop)
    wires, measured = Wires.of(diagram), measured_ports(diagram, plant)
    control = control_port(wires, plant)
    systems, inputs = upstream(wires, control, measured)
    acts_at_once = reaches(wires, control, measured)
    outputs = {CONTROL: control}
    for name, port in wires.outputs.items():
        is_own = port != control and port not in measured and port[0] in systems
        if is_own and name != CONTROL and not reaches(wires, port, measured):
            outputs[name] = port
    compiled = compile_part(
        diagram,
        {name: port_of(port) for port, name in inputs.items()},
        {name: port_of(port) for name, port in outputs.items()},
        context,
    )
    _check_steps(compiled)
    if acts_at_once and not plant.time_step:
        raise ModelError(
            "the controller acts continuously, and as one step it needs samples: give the loop a "
            "sampling, in a scenario `sampling: {period: 0.001}`"
        )
    ticks = Ticks.of(compiled.rates, plant.time_step)
    known = {**compiled.signals, **_known_signals(loop, plant)}
    return _part(compiled, known, ticks, acts_at_once)


def plant_part(loop: ClosedLoop | Diagram, context: Context) -> ExportedPart:
    """The plant of a loop with its sensors, whose input is the control.

    Its outputs have the names of the controller's inputs, among others.

    Args:
        loop, context: As of `controller_part`.

    Raises:
        ModelError: There is not one plant, or it changes as no function of the time does: why.
    """
    diagram, plant = _diagram_and_plant(loop)
    wires, inputs = Wires.of(diagram), {}
    names = ["state", "constraint_force", "constraint_residual", "controlled_output"]
    outputs = {name: plant.GetOutputPort(name) for name in names}
    if plant.dae.num_controls:
        inputs[CONTROL] = control = control_port(wires, plant)
        _, read = upstream(wires, control, measured_ports(diagram, plant))
        outputs |= {name: port_of(port) for port, name in read.items()}
    compiled = compile_part(
        diagram,
        {name: port_of(port) for name, port in inputs.items()},
        {name: port for name, port in outputs.items() if port.size()},
        context,
    )
    _check_time(compiled, "the plant")
    return _part(compiled, _known_signals(loop, plant))


def loop_part(
    loop: ClosedLoop | Diagram, context: Context, further: Sequence[str] = ()
) -> ExportedPart:
    """A loop as a whole, which has no inputs. Its outputs are those of the record.

    Args:
        loop, context: As of `controller_part`; a diagram may have any number of plants.
        further: Names of output ports of a loop's diagram that are outputs as well.

    Raises:
        ModelError: It changes as no function of the time does: why.
    """
    if further and not isinstance(loop, Diagram):
        compiled = compile_diagram(loop.diagram, [*loop.signals, *further])
        signals: Mapping[str, Sequence[Signal]] = loop.signals
    else:
        program = program_of(loop)
        compiled, signals = program.compiled, program.signals
    _check_time(compiled, "the loop")
    return _part(compiled, {name: tuple(each) for name, each in signals.items()})


def diagram_part(
    diagram: Diagram, context: Context, outputs: Mapping[str, OutputPort]
) -> ExportedPart:
    """All that leads to some output ports in a diagram, which may be those of its blocks.

    Args:
        diagram: The diagram.
        context: Its context, in which inputs without a wire have values.
        outputs: Name -> an output port in it.

    Raises:
        ModelError: A block cannot be traced, or it changes as no function of the time does: why.
    """
    compiled = compile_part(diagram, {}, outputs, context)
    _check_time(compiled, "the diagram")
    return _part(compiled, {})


def _part(
    compiled: CompiledDiagram,
    known: Mapping[str, tuple[Signal, ...]],
    ticks: Ticks = NEVER,
    acts_at_once: bool = False,
) -> ExportedPart:
    inputs = {name: part.stop - part.start for name, part in compiled.inputs}
    ports = {name: port_of(compiled.wires.outputs[name]) for name in compiled.outputs}
    return ExportedPart(
        compiled,
        {name: _signals(known, name, size) for name, size in inputs.items()},
        {name: _signals(known, name, port.size()) for name, port in ports.items()},
        ticks,
        acts_at_once,
    )


def _diagram_and_plant(loop: ClosedLoop | Diagram) -> tuple[Diagram, Plant]:
    if isinstance(loop, Diagram):
        return loop, plant_of(loop)
    return loop.diagram, loop.plant


def _check_time(compiled: CompiledDiagram, what: str) -> None:
    """Refuses what is no function of the time, the state and the inputs.

    Raises:
        ModelError: Contacts open, phases end, Drake steps something, or random numbers are drawn.
    """
    changing = [*compiled.guards, *compiled.watched]
    if changing:
        raise ModelError(
            f"{what} changes at moments that a run has to find, as where a contact opens or a "
            f"phase ends ('{changing[0].system.get_name()}'): no export knows it; a rollout does"
        )
    if compiled.has_stepped:
        raise ModelError(
            f"{what} has Drake's own contact ('{compiled.stepped[1].system.get_name()}'), which no "
            "export knows; a rollout does. Export one with an ideal plant"
        )
    if compiled.noise:
        raise ModelError(
            f"{what} draws random numbers ('{compiled.noise[0].system.get_name()}'), which no "
            "export does: leave the noise out, in a scenario noise_deviation"
        )


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
