"""The numbers of a diagram that a person can change while the diagram runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import SceneGraph
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import (
    Context,
    Diagram,
    InputPort,
    LeafSystem,
    PortDataType,
    System,
)

from drake_dae.arrays import FloatArray
from drake_dae.compiler.wires import Wires, leaf_inputs
from drake_dae.dae.system.signals import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.running.export.steps.words import block_name, distinct, parameters_of_block
from drake_dae.systems.control.contract import SIGNAL
from drake_dae.systems.plants.contract import Plant

PUSH = "push."
"""The prefix of the names of the wrenches that push links."""

_WRENCH = [
    (f"{part}[{k}]", unit) for part, unit in (("force", "N"), ("moment", "N m")) for k in range(3)
]
_Forces = Value[list[ExternallyAppliedSpatialForce]]


@dataclass(frozen=True, eq=False)
class Inputs:
    """The numeric parameters of the blocks of a diagram, and its free inputs, as one vector.

    Attributes:
        blocks: A block with numeric parameter 0 -> the index of its first entry.
        ports: An input port without connection -> the index of its first entry.
        pushed: One of Drake's own plants whose port `applied_spatial_force` has no connection, so
            that it can push the links -> the index of the first entry of the links' wrenches.
        names, units: The name and the unit of each entry.
    """

    blocks: Mapping[System, int]
    ports: Mapping[InputPort, int]
    names: Sequence[str]
    units: Sequence[str]
    pushed: Mapping[MultibodyPlant, int] = field(default_factory=dict)

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
            systems, free, plants = _parts_of_diagram(loop, context)
        else:
            sources = loop.generator, loop.exogenous, loop.plant_exogenous
            systems = [*sources, loop.plant, loop.controller, loop.plant.pushes]
            inputs = [(port.get_name(), port) for port in _vector_inputs(diagram)]
            free, plants = [(name, p) for name, p in inputs if name.startswith(SIGNAL)], []
        blocks, signals = dict[System, int](), list[Signal]()
        for block in systems:
            # A plant with Drake's own contact is a Diagram: it contains many blocks.
            if not isinstance(block, LeafSystem):
                continue
            block_context = block.GetMyContextFromRoot(context)
            if block_context.num_numeric_parameter_groups():
                blocks[block] = len(signals)
                size = block_context.get_numeric_parameter(0).size()
                signals += parameters_of_block(block, size)
        ports, pushed = dict[InputPort, int](), dict[MultibodyPlant, int]()
        for name, port in free:
            ports[port] = len(signals)
            names = [f"{name}[{i}]" for i in range(port.size())] if port.size() > 1 else [name]
            signals += map(Signal, names)
        for plant in plants:
            pushed[plant] = len(signals)
            signals += [
                Signal(f"{block_name(plant)}.{PUSH}{body}.{part}", unit)
                for body in _links(plant)
                for part, unit in _WRENCH
            ]
        signals = distinct(signals)
        return cls(blocks, ports, [s.name for s in signals], [s.unit for s in signals], pushed)

    def values(self, context: Context) -> FloatArray:
        """Returns their values in a context of the diagram; zero for ports without a value."""
        contexts = (block.GetMyContextFromRoot(context) for block in self.blocks)
        parts = [c.get_numeric_parameter(0).CopyToVector() for c in contexts]
        parts += [_port_value(port, context) for port in self.ports]
        parts += [_wrenches(plant, context) for plant in self.pushed]
        return np.concatenate([np.zeros(0), *parts])

    def set(self, context: Context, changes: Mapping[int, float]) -> None:
        """Sets entries in a context: index -> value."""
        for block, first in self.blocks.items():
            block_context = block.GetMyMutableContextFromRoot(context)
            values = block_context.get_numeric_parameter(0).CopyToVector()
            if _apply_changes(values, first, changes):
                block_context.get_mutable_numeric_parameter(0).SetFromVector(values)
        for port, first in self.ports.items():
            values = _port_value(port, context)
            if _apply_changes(values, first, changes):
                port.FixValue(port.get_system().GetMyMutableContextFromRoot(context), values)
        for plant, first in self.pushed.items():
            values = _wrenches(plant, context)
            if _apply_changes(values, first, changes):
                forces = [
                    _spatial_force(BodyIndex(i), wrench)
                    for i, wrench in enumerate(values.reshape(-1, 6), start=1)
                ]
                plant_context = plant.GetMyMutableContextFromRoot(context)
                port = plant.get_applied_spatial_force_input_port()
                port.FixValue(plant_context, _Forces(forces))


def _port_value(port: InputPort, context: Context) -> FloatArray:
    """Returns a copy of the value of an input port; zero without a value."""
    system_context = port.get_system().GetMyContextFromRoot(context)
    has_value = port.HasValue(system_context)
    return np.array(port.Eval(system_context)) if has_value else np.zeros(port.size())


def _wrenches(plant: MultibodyPlant, context: Context) -> FloatArray:
    """Returns force and moment on each link, below each other."""
    port = plant.get_applied_spatial_force_input_port()
    plant_context = plant.GetMyContextFromRoot(context)
    wrenches = np.zeros((plant.num_bodies() - 1, 6))
    for force in port.Eval(plant_context) if port.HasValue(plant_context) else ():
        F = force.F_Bq_W
        wrenches[int(force.body_index) - 1] = [*F.translational(), *F.rotational()]
    return wrenches.ravel()


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


def _apply_changes(values: FloatArray, first: int, changes: Mapping[int, float]) -> bool:
    """Changes values in place, of which `first` is the first index; returns whether any changed."""
    local = {i - first: x for i, x in changes.items() if first <= i < first + values.size}
    values[list(local)] = list(local.values())
    return bool(local)


def _parts_of_diagram(
    diagram: Diagram, context: Context
) -> tuple[list[System | None], list[tuple[str, InputPort]], list[MultibodyPlant]]:
    """Returns a diagram's blocks, its free inputs, and Drake's own plants with a free force port.

    Free are the inputs of the diagram, and unconnected inputs of blocks that have a fixed value.
    """
    wires, count = Wires.of(diagram), diagram.num_input_ports()
    exported = list(chain.from_iterable(leaf_inputs(diagram, index) for index in range(count)))
    free = [(port.get_name(), port) for port in _vector_inputs(diagram) if port.size()]
    blocks, plants = list[System | None](), list[MultibodyPlant]()
    for system in wires.systems:
        # The parameters of bodies and geometry have no names.
        if not isinstance(system, MultibodyPlant | SceneGraph):
            blocks.append(system)
        if isinstance(system, Plant):
            blocks.append(system.pushes)
        connected = {port for target, port in chain(wires.sources, exported) if target is system}
        system_context = system.GetMyContextFromRoot(context)
        free += [
            (f"{block_name(system)}.{port.get_name()}", port)
            for port in _vector_inputs(system)
            if int(port.get_index()) not in connected and port.HasValue(system_context)
        ]
        if isinstance(system, MultibodyPlant):
            port = system.get_applied_spatial_force_input_port()
            if int(port.get_index()) not in connected and not port.HasValue(system_context):
                plants.append(system)
    return blocks, free, plants


def _links(plant: MultibodyPlant) -> list[str]:
    """Returns the names of the links of a plant, in the order of their wrenches."""
    bodies = (plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies()))
    return [body.scoped_name().get_full() for body in bodies]


def _spatial_force(body: BodyIndex, wrench: FloatArray) -> ExternallyAppliedSpatialForce:
    """Returns a force and a moment, in this order in `wrench`, at the origin of a body."""
    force = ExternallyAppliedSpatialForce()
    force.body_index = body
    force.F_Bq_W = SpatialForce(wrench[3:], wrench[:3])
    return force
