"""The parts of a loop that can be exported: the controller, the plant, and the whole loop."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pydrake.systems.framework import Context, Diagram, OutputPort

from drake_dae.compiler.compile import compile_part
from drake_dae.compiler.compiled import CompiledDiagram
from drake_dae.compiler.wires import Wires
from drake_dae.dae import Signal
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
"""The ticks of a part without sample instants."""


@dataclass(frozen=True, eq=False)
class ExportedPart:
    """A part of a loop for an export.

    Attributes:
        compiled: The functions of the part; its inputs are the last entries of the parameters.
        inputs, outputs: Name of a port -> names and units of its entries.
        ticks: The sample instants of a controller.
        acts_at_once: Whether the control has direct feedthrough from the measurements. Otherwise
            the control is a discrete state, which changes only by updates.
    """

    compiled: CompiledDiagram
    inputs: Mapping[str, tuple[Signal, ...]]
    outputs: Mapping[str, tuple[Signal, ...]]
    ticks: Ticks = NEVER
    acts_at_once: bool = False


def controller_part(loop: ClosedLoop | Diagram, context: Context) -> ExportedPart:
    """Returns the controller: all blocks between measurements and the plant's control.

    These are the law, references, observers, integrals, samplers, delays, limits, and any user
    blocks between them. Sensors belong to the machine: their outputs are inputs of the controller.

    Args:
        loop: The loop, or any diagram with one `Plant`.
        context: Its context at the start.

    Raises:
        ModelError: There is not exactly one plant, or the controller cannot run in discrete steps.
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
    """Returns the plant of a loop with its sensors; the input is the control.

    The outputs include all inputs of the controller, under the same names.

    Args:
        loop, context: As in `controller_part`.

    Raises:
        ModelError: There is not exactly one plant, or it has events, Drake's contact or noise.
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
    """Returns the whole loop, which has no inputs; the outputs are the signals of the record.

    Args:
        loop, context: As in `controller_part`; a diagram may have any number of plants.
        further: Names of output ports of a loop's diagram that become outputs, too.

    Raises:
        ModelError: The loop has events, Drake's contact or noise.
    """
    program = program_of(loop)
    compiled, signals = program.compiled, program.signals
    if not isinstance(loop, Diagram) and further:
        ports = {name: loop.diagram.GetOutputPort(name) for name in (*loop.signals, *further)}
        compiled = compile_part(loop.diagram, {}, ports, context)
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


def check_events(compiled: CompiledDiagram, what: str) -> None:
    """Checks that a part has not Drake's own contact.

    Raises:
        ModelError: The part has one of them.
    """
    if compiled.has_stepped:
        raise ModelError(
            f"{what} has Drake's own contact ('{compiled.stepped[1].system.get_name()}'), which no "
            "export knows; a rollout does. Export one with an ideal plant"
        )


def _check_time(compiled: CompiledDiagram, what: str) -> None:
    """Checks that a part has neither events nor Drake's own contact nor noise."""
    check_events(compiled, what)
    if compiled.noise:
        raise ModelError(
            f"{what} draws random numbers ('{compiled.noise[0].system.get_name()}'), which no "
            "export does: leave the noise out, in a scenario noise_deviation"
        )


def _check_steps(compiled: CompiledDiagram) -> None:
    """Checks that a controller can run in discrete steps.

    Raises:
        ModelError: A block of the controller has a continuous state, phases or random numbers.
    """
    for places, reason in (
        (
            compiled.states,
            "has a continuous state, as integrals of a law without samples: give the loop a "
            "sampling, in a scenario `sampling: {period: 0.001}`",
        ),
        (
            compiled.noise,
            "draws random numbers, which are none of a controller's: leave it out, or put "
            "it behind a sensor",
        ),
    ):
        if places:
            raise ModelError(f"'{places[0].system.get_name()}' {reason}")


def _known_signals(loop: ClosedLoop | Diagram, plant: Plant) -> dict[str, tuple[Signal, ...]]:
    dae = plant.dae
    signals: dict[str, Sequence[Signal]] = {
        "state": dae.state_signals,
        "estimated_state": dae.state_signals,
        "constraint_force": dae.force_signals,
        "measured_force": dae.constraint_input_signals,
        "constraint_residual": plant.port_signals["constraint_residual"],
        "controlled_output": dae.output_signals,
        CONTROL: dae.control_signals,
        **plant.further_signals,
        **({} if isinstance(loop, Diagram) else loop.signals),
    }
    return {name: tuple(entries) for name, entries in signals.items()}


def _signals(known: Mapping[str, tuple[Signal, ...]], name: str, size: int) -> tuple[Signal, ...]:
    """The known signals of a port if their number is right, otherwise numbered ones."""
    signals = known.get(name, ())
    if len(signals) == size:
        return signals
    return tuple(Signal(f"{name}[{i}]") for i in range(size))
