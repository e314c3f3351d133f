"""What a bench shows of any Drake diagram, and what a person changes in it."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
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
from drake_dae.compiler.wires import Wires
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.running.bench.controls import (
    Control,
    Controls,
    of_plant,
    of_pole,
    pushes_of,
    rounded,
)
from drake_dae.running.bench.inputs import PUSH, Inputs
from drake_dae.running.bench.posed import NO_BODIES, VISUALIZER, PosedBodies
from drake_dae.systems.blocks.traced import Traced
from drake_dae.systems.control.contract import Controller
from drake_dae.systems.plants.contract import Plant

MOST_SLIDERS = 24
"""Further numbers are set by their names."""


@dataclass(frozen=True, eq=False)
class DiagramParts:
    """What a bench shows of a diagram.

    Attributes:
        robots: The plants that are drawn as robots.
        scene_graph: The geometry of their links, or None.
        posed: What Drake's SceneGraph poses.
        ports: Name -> port: all output ports of the diagram with vectors, and those of robots.
        outputs, signals: The names of the former; names and units of their entries.
        notes: What is not shown, a sentence for each.
    """

    robots: Sequence[Plant]
    scene_graph: SceneGraph | None
    posed: PosedBodies
    ports: dict[str, OutputPort]
    outputs: Sequence[str]
    signals: Sequence[Signal]
    notes: Sequence[str]


def parts_of_diagram(diagram: Diagram, context: Context) -> DiagramParts:
    """What a bench shows of a diagram.

    Args:
        diagram: The diagram.
        context: Its context at the start.

    Raises:
        ModelError: It has no output port with a vector.
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
    outputs, scenes = list(ports), [one for one in wires.systems if isinstance(one, SceneGraph)]
    robots = _robots(wires, notes)
    for robot in robots:
        for name in ("state", "constraint_force"):
            ports[f"{robot.get_name()}.{name}"] = robot.GetOutputPort(name)
        if (moving := _exogenous(wires, robot)) is not None:
            ports[f"{robot.get_name()}.exogenous"] = moving
    scene_graph, posed = scenes[0] if scenes else None, NO_BODIES
    own = [each.robot("a bench").links.plant for each in robots]
    if scene_graph is not None:
        inspector = scene_graph.model_inspector()
        known = [one for one in own if one is not None and one.get_source_id() is not None]
        sources = [one.get_source_id() for one in known]
        frames = chain.from_iterable(
            inspector.FramesForSource(s) for s in sources if inspector.SourceIsRegistered(s)
        )
        drawn = {"/".join((*VISUALIZER, *inspector.GetName(f).split("::"))) for f in frames}
        multibody = [one for one in wires.systems if isinstance(one, MultibodyPlant)]
        posed = PosedBodies.of(scene_graph, multibody, drawn)
        try:
            posed.poses(context)
        except RuntimeError:
            posed = NO_BODIES
            notes.append("bodies of a SceneGraph are not drawn, since its poses have no wire")
        if not any(map(inspector.SourceIsRegistered, sources)):
            scene_graph = None
    if robots and scene_graph is None:
        names = ", ".join(each.get_name() for each in robots)
        notes.append(
            f"links of {names} are not drawn: add the SceneGraph of their MultibodyPlant to the "
            "diagram, builder.AddSystem(scene_graph)"
        )
    return DiagramParts(robots, scene_graph, posed, ports, outputs, signals, notes)


def vector_outputs(diagram: Diagram) -> list[tuple[str, OutputPort]]:
    """The output ports of a diagram with vectors, and their names."""
    found = (diagram.get_output_port(index) for index in range(diagram.num_output_ports()))
    vectors = (p for p in found if p.get_data_type() == PortDataType.kVectorValued and p.size())
    return [(port.get_name(), port) for port in vectors]


def controls_of_diagram(diagram: Diagram, context: Context) -> Controls:
    """Sliders for the numbers of a diagram, and the links that are pushed.

    Of a plant they are masses and coefficients of friction, of a law the pole. A parameter p of
    another block goes from 0 to 3 p, an input or a constant from -3 |p| to 3 |p|; one that is 0
    goes from -1 to 1.

    Args:
        diagram: The diagram.
        context: Its context at the start.
    """
    inputs = Inputs.of(diagram, context)
    values, found = inputs.values(context), list[Control]()
    plants = [one for one in inputs.blocks if isinstance(one, Plant)]
    laws = [one for one in inputs.blocks if isinstance(one, Controller)]
    for port, first in inputs.ports.items():
        found += _sliders("input", inputs, values, first, port.size(), is_signed=True)
    for block, first in inputs.blocks.items():
        if isinstance(block, Plant | Controller) or f".{PUSH}" in inputs.names[first]:
            continue
        count = block.GetMyContextFromRoot(context).get_numeric_parameter(0).size()
        is_signed = isinstance(block, ConstantVectorSource)
        kind = "input" if is_signed else "parameter"
        found += _sliders(kind, inputs, values, first, count, is_signed)
    found = found[:MOST_SLIDERS]
    for plant in plants:
        twin = laws[0] if len(plants) == len(laws) == 1 else None
        found += of_plant(plant, twin, inputs, values)
    for law in laws:
        found += of_pole(law, inputs, values)
    return Controls(inputs, found, pushes_of(plants, inputs))


def _sliders(
    kind: str, inputs: Inputs, values: FloatArray, first: int, count: int, is_signed: bool
) -> list[Control]:
    found = []
    for place in range(first, first + count):
        value = float(values[place])
        most = rounded(3.0 * abs(value)) or 1.0
        low = -most if is_signed or value <= 0.0 else 0.0
        high = 0.0 if value < 0.0 and not is_signed else most
        name, unit = inputs.names[place], inputs.units[place]
        found.append(Control(kind, name, unit, low, high, value, (place,)))
    return found


def _robots(wires: Wires, notes: list[str]) -> list[Plant]:
    """The plants that are robots; of those with constraints of the same name, the first."""
    found, names = list[Plant](), set[str]()
    for system in wires.systems:
        if not isinstance(system, Plant) or system.model is None:
            continue
        own = {constraint.name for constraint in system.model.constraints}
        if own & names:
            notes.append(
                f"{system.get_name()} is not drawn: another robot has constraints of the name "
                f"{', '.join(sorted(own & names))}"
            )
            continue
        names |= own
        found.append(system)
    return found


def _exogenous(wires: Wires, plant: Plant) -> OutputPort | None:
    """What feeds a plant's exogenous signals."""
    if not plant.HasInputPort("exogenous"):
        return None
    source = wires.sources.get((plant, int(plant.GetInputPort("exogenous").get_index())))
    return None if source is None else source[0].get_output_port(OutputPortIndex(source[1]))


def _signals(port: OutputPort, system: System, index: int) -> list[Signal]:
    """Names and units of the entries of an output port, as far as its block tells them."""
    known = tuple[Signal, ...]()
    own = system.get_output_port(OutputPortIndex(index)).get_name()
    if isinstance(system, Traced):
        try:
            known = system.traced().ports.get(own, ())
        except ModelError:  # It runs in Drake's Simulator alone.
            known = ()
    if len(known) == port.size():
        return list(known)
    name = port.get_name()
    return [Signal(f"{name}[{i}]" if port.size() > 1 else name) for i in range(port.size())]
