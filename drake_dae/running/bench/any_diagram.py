"""The plots, the scene and the sliders of a bench of any Drake diagram."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from pydrake.geometry import SceneGraph
from pydrake.systems.framework import (
    Context,
    Diagram,
    OutputPort,
    OutputPortIndex,
    PortDataType,
    System,
)
from pydrake.systems.primitives import ConstantVectorSource

from drake_dae.arrays import FloatArray
from drake_dae.blocks.computations import Traced
from drake_dae.compiler.wires import Wires
from drake_dae.dae import Signal
from drake_dae.errors import ModelError
from drake_dae.running.bench.controls import (
    Control,
    Controls,
    pushes_of,
    rounded,
    slider_of_pole,
    sliders_of_plant,
)
from drake_dae.running.bench.inputs import Inputs
from drake_dae.systems.control.contract import Controller
from drake_dae.systems.plants.contract import Plant

MOST_SLIDERS = 24
"""The largest number of sliders of general blocks; the page sets other inputs by their names."""


@dataclass(frozen=True, eq=False)
class DiagramParts:
    """The parts of a diagram that a bench shows.

    Attributes:
        robots: The plants that are drawn as robots.
        scene_graph: The geometry of the robots' links, or None.
        ports: Name -> port: all vector output ports of the diagram, and those of the robots.
        outputs: The names of the diagram's vector output ports.
        signals: Names and units of the entries of these ports.
        notes: A sentence for each part that is not shown.
    """

    robots: Sequence[Plant]
    scene_graph: SceneGraph | None
    ports: dict[str, OutputPort]
    outputs: Sequence[str]
    signals: Sequence[Signal]
    notes: Sequence[str]


def parts_of_diagram(diagram: Diagram, context: Context) -> DiagramParts:
    """Returns the parts of a diagram that a bench shows.

    Args:
        diagram: The diagram.
        context: Its initial context.

    Raises:
        ModelError: The diagram has no vector output port.
    """
    wires, notes = Wires.of(diagram), list[str]()
    ports, signals = dict[str, OutputPort](), list[Signal]()
    for name, port in vector_outputs(diagram):
        ports[name] = port
        signals += _signals(port, *wires.outputs[name])
    if not ports:
        raise ModelError(
            "the diagram has no output port with a vector, so that a bench has nothing to plot: "
            "export one, builder.ExportOutput(system.GetOutputPort(...), name)"
        )
    outputs, robots = list(ports), _robots(wires, notes)
    for robot in robots:
        for name in ("state", "constraint_force"):
            ports[f"{robot.get_name()}.{name}"] = robot.GetOutputPort(name)
        if (exogenous := _exogenous_source(wires, robot)) is not None:
            ports[f"{robot.get_name()}.exogenous"] = exogenous
    scene_graph = next((s for s in wires.systems if isinstance(s, SceneGraph)), None)
    if scene_graph is not None:
        inspector = scene_graph.model_inspector()
        multibodies = (robot.robot("a bench").links.plant for robot in robots)
        ids = [plant.get_source_id() for plant in multibodies if plant is not None]
        if not any(s is not None and inspector.SourceIsRegistered(s) for s in ids):
            scene_graph = None
    if robots and scene_graph is None:
        names = ", ".join(robot.get_name() for robot in robots)
        notes.append(
            f"links of {names} are not drawn: add the SceneGraph of their MultibodyPlant to the "
            "diagram, builder.AddSystem(scene_graph)"
        )
    return DiagramParts(robots, scene_graph, ports, outputs, signals, notes)


def vector_outputs(diagram: Diagram) -> list[tuple[str, OutputPort]]:
    """Returns name and port of a diagram's vector outputs."""
    ports = (diagram.get_output_port(index) for index in range(diagram.num_output_ports()))
    vectors = (p for p in ports if p.get_data_type() == PortDataType.kVectorValued and p.size())
    return [(port.get_name(), port) for port in vectors]


def controls_of_diagram(diagram: Diagram, context: Context) -> Controls:
    """Returns sliders for the numbers of a diagram, and the links that can be pushed.

    A plant has sliders for masses and coefficients of friction, a law one for its pole. The range
    of a parameter p of another block is from 0 to 3 p; of an input or a constant p, from -3 |p| to
    3 |p|; of a value 0, from -1 to 1.

    Args:
        diagram: The diagram.
        context: Its initial context.
    """
    inputs = Inputs.of(diagram, context)
    values, sliders = inputs.values(context), list[Control]()
    plants = [block for block in inputs.blocks if isinstance(block, Plant)]
    controllers = [block for block in inputs.blocks if isinstance(block, Controller)]
    for port, first in inputs.ports.items():
        sliders += _sliders("input", inputs, values, first, port.size(), is_signed=True)
    for block, first in inputs.blocks.items():
        if isinstance(block, Plant | Controller):
            continue
        count = block.GetMyContextFromRoot(context).get_numeric_parameter(0).size()
        is_signed = isinstance(block, ConstantVectorSource)
        kind = "input" if is_signed else "parameter"
        sliders += _sliders(kind, inputs, values, first, count, is_signed)
    sliders = sliders[:MOST_SLIDERS]
    only_controller = controllers[0] if len(plants) == len(controllers) == 1 else None
    for plant in plants:
        sliders += sliders_of_plant(plant, only_controller, inputs, values)
    for controller in controllers:
        sliders += slider_of_pole(controller, inputs, values)
    return Controls(inputs, sliders, pushes_of(plants, inputs))


def _sliders(
    kind: str, inputs: Inputs, values: FloatArray, first: int, count: int, is_signed: bool
) -> list[Control]:
    sliders = []
    for index in range(first, first + count):
        value = float(values[index])
        reach = rounded(3.0 * abs(value)) or 1.0
        low = -reach if is_signed or value <= 0.0 else 0.0
        high = 0.0 if value < 0.0 and not is_signed else reach
        name, unit = inputs.names[index], inputs.units[index]
        sliders.append(Control(kind, name, unit, low, high, value, (index,)))
    return sliders


def _robots(wires: Wires, notes: list[str]) -> list[Plant]:
    """Returns the plants that are robots; of several with equal names of constraints, the first."""
    robots, names = list[Plant](), set[str]()
    for system in wires.systems:
        if not isinstance(system, Plant) or system.model is None:
            continue
        constraints = {constraint.name for constraint in system.model.constraints}
        if constraints & names:
            notes.append(
                f"{system.get_name()} is not drawn: another robot has constraints of the name "
                f"{', '.join(sorted(constraints & names))}"
            )
            continue
        names |= constraints
        robots.append(system)
    return robots


def _exogenous_source(wires: Wires, plant: Plant) -> OutputPort | None:
    """Returns the output port of a plant's exogenous signals, or None."""
    if not plant.HasInputPort("exogenous"):
        return None
    source = wires.sources.get((plant, int(plant.GetInputPort("exogenous").get_index())))
    return None if source is None else source[0].get_output_port(OutputPortIndex(source[1]))


def _signals(port: OutputPort, system: System, index: int) -> list[Signal]:
    """Returns names and units of the entries of an output port, from its block if possible."""
    signals = tuple[Signal, ...]()
    block_port = system.get_output_port(OutputPortIndex(index)).get_name()
    if isinstance(system, Traced):
        with suppress(ModelError):  # Only Drake's Simulator runs this block.
            signals = system.traced().ports.get(block_port, ())
    if len(signals) == port.size():
        return list(signals)
    name = port.get_name()
    return [Signal(f"{name}[{i}]" if port.size() > 1 else name) for i in range(port.size())]
