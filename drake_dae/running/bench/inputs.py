"""The numbers of a diagram that a person changes while it runs."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

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
"""Begins the names of the wrenches that push links."""

_WRENCH = [
    (f"{part}[{k}]", unit) for part, unit in (("force", "N"), ("moment", "N m")) for k in range(3)
]
_Forces = Value[list[ExternallyAppliedSpatialForce]]


@dataclass(frozen=True, eq=False)
class Inputs:
    """The numeric parameters of the blocks of a diagram, below each other, and its free inputs.

    Attributes:
        blocks: The blocks, each with numeric parameter 0, and where its entries begin.
        ports: Input ports without a wire -> where their entries begin.
        pushed: Plants of Drake's whose links are pushed through the port `applied_spatial_force`,
            which has no wire -> where the wrenches of their links begin.
        names, units: Those of each entry.
    """

    blocks: Mapping[System, int]
    ports: Mapping[InputPort, int]
    names: Sequence[str]
    units: Sequence[str]
    pushed: Mapping[MultibodyPlant, int] = field(default_factory=dict)

    @classmethod
    def of(cls, loop: ClosedLoop | Diagram, context: Context | None = None) -> "Inputs":
        """Those of the generators, the plant and the controller of a loop, or of all blocks.

        Args:
            loop: The loop, or any diagram.
            context: The context of the diagram in which inputs have values; the default if None.
        """
        diagram = loop if isinstance(loop, Diagram) else loop.diagram
        if context is None:
            context = diagram.CreateDefaultContext()
        if isinstance(loop, Diagram):
            made, free, plants = _all(loop, context)
        else:
            sources = loop.generator, loop.exogenous, loop.plant_exogenous
            made = [*sources, loop.plant, loop.controller, loop.plant.pushes]
            free, plants = _signals(diagram), []
        blocks, signals = dict[System, int](), list[Signal]()
        for block in made:
            # Drake's own contact is a Diagram, whose numbers are those of many blocks.
            if not isinstance(block, LeafSystem):
                continue
            own = block.GetMyContextFromRoot(context)
            if own.num_numeric_parameter_groups():
                blocks[block] = len(signals)
                signals += parameters_of_block(block, own.get_numeric_parameter(0).size())
        ports, pushed = dict[InputPort, int](), dict[MultibodyPlant, int]()
        for name, port in free:
            ports[port] = len(signals)
            several = [f"{name}[{i}]" for i in range(port.size())] if port.size() > 1 else [name]
            signals += map(Signal, several)
        for plant in plants:
            pushed[plant] = len(signals)
            signals += [
                Signal(f"{block_name(plant)}.{PUSH}{body}.{part}", unit)
                for body in _links(plant)
                for part, unit in _WRENCH
            ]
        found = distinct(signals)
        return cls(blocks, ports, [s.name for s in found], [s.unit for s in found], pushed)

    def values(self, context: Context) -> FloatArray:
        """Their values in a context of the diagram; zero where a port has none."""
        own = (block.GetMyContextFromRoot(context) for block in self.blocks)
        parts = [each.get_numeric_parameter(0).CopyToVector() for each in own]
        for port in self.ports:
            at = port.get_system().GetMyContextFromRoot(context)
            parts.append(port.Eval(at) if port.HasValue(at) else np.zeros(port.size()))
        parts += [self._wrenches(plant, context) for plant in self.pushed]
        return np.concatenate([np.zeros(0), *parts])

    def set(self, context: Context, changes: Mapping[int, float]) -> None:
        """Changes entries in a context."""
        for block, first in self.blocks.items():
            own = block.GetMyMutableContextFromRoot(context)
            values = own.get_numeric_parameter(0).CopyToVector()
            if _changed(values, first, changes):
                own.get_mutable_numeric_parameter(0).SetFromVector(values)
        for port, first in self.ports.items():
            own = port.get_system().GetMyMutableContextFromRoot(context)
            values = np.array(port.Eval(own)) if port.HasValue(own) else np.zeros(port.size())
            if _changed(values, first, changes):
                port.FixValue(own, values)
        for plant, first in self.pushed.items():
            values = self._wrenches(plant, context)
            if _changed(values, first, changes):
                applied = [
                    _applied(BodyIndex(number), row)
                    for number, row in enumerate(values.reshape(-1, 6), start=1)
                ]
                own = plant.GetMyMutableContextFromRoot(context)
                plant.get_applied_spatial_force_input_port().FixValue(own, _Forces(applied))

    @staticmethod
    def _wrenches(plant: MultibodyPlant, context: Context) -> FloatArray:
        port = plant.get_applied_spatial_force_input_port()
        own, found = plant.GetMyContextFromRoot(context), np.zeros((plant.num_bodies() - 1, 6))
        for one in port.Eval(own) if port.HasValue(own) else ():
            wrench = one.F_Bq_W
            found[int(one.body_index) - 1] = [*wrench.translational(), *wrench.rotational()]
        return found.ravel()


def started(diagram: Diagram, context: Context) -> Context:
    """A copy of a context of a diagram in which all vector inputs have values: zero if none."""
    found = context.Clone()
    for index in range(diagram.num_input_ports()):
        port = diagram.get_input_port(index)
        if port.get_data_type() == PortDataType.kVectorValued and not port.HasValue(found):
            port.FixValue(found, np.zeros(port.size()))
    return found


def _changed(values: FloatArray, first: int, changes: Mapping[int, float]) -> bool:
    """Puts changes of entries into the values that begin at one of them; whether there were any."""
    own = {i - first: x for i, x in changes.items() if first <= i < first + values.size}
    values[list(own)] = list(own.values())
    return bool(own)


def _signals(diagram: Diagram) -> list[tuple[str, InputPort]]:
    """The inputs of a loop for the signals for which its task waits."""
    ports = (diagram.get_input_port(i) for i in range(diagram.num_input_ports()))
    return [(port.get_name(), port) for port in ports if port.get_name().startswith(SIGNAL)]


def _all(
    diagram: Diagram, context: Context
) -> tuple[list[System | None], list[tuple[str, InputPort]], list[MultibodyPlant]]:
    """All blocks of a diagram, its free inputs, and its plants whose links may be pushed.

    An input port of a block that is no input of the diagram is free where it has a value.
    """
    wires, exported = Wires.of(diagram), set[tuple[System, int]]()
    free = list[tuple[str, InputPort]]()
    for index in range(diagram.num_input_ports()):
        port = diagram.get_input_port(index)
        exported |= set(leaf_inputs(diagram, index))
        if port.get_data_type() == PortDataType.kVectorValued and port.size():
            free.append((port.get_name(), port))
    blocks, plants = list[System | None](), list[MultibodyPlant]()
    for system in wires.systems:
        # Bodies and geometry have parameters without names.
        if not isinstance(system, MultibodyPlant | SceneGraph):
            blocks.append(system)
        if isinstance(system, Plant):
            blocks.append(system.pushes)
        taken = {port for giver, port in wires.sources if giver is system}
        taken |= {port for giver, port in exported if giver is system}
        free += _with_values(system, taken, context)
        if isinstance(system, MultibodyPlant):
            own = system.get_applied_spatial_force_input_port()
            at = system.GetMyContextFromRoot(context)
            if int(own.get_index()) not in taken and not own.HasValue(at):
                plants.append(system)
    return blocks, free, plants


def _with_values(
    system: System, taken: set[int], context: Context
) -> Iterator[tuple[str, InputPort]]:
    """The input ports of a block without a wire, and with a value in a context."""
    own = system.GetMyContextFromRoot(context)
    for index in range(system.num_input_ports()):
        port = system.get_input_port(index)
        is_vector = port.get_data_type() == PortDataType.kVectorValued
        if is_vector and index not in taken and port.HasValue(own):
            yield f"{block_name(system)}.{port.get_name()}", port


def _links(plant: MultibodyPlant) -> list[str]:
    """The names of the links of a plant, in the order of their wrenches."""
    bodies = (plant.get_body(BodyIndex(i)) for i in range(1, plant.num_bodies()))
    return [body.scoped_name().get_full() for body in bodies]


def _applied(body: BodyIndex, wrench: FloatArray) -> ExternallyAppliedSpatialForce:
    """A force and a moment at the origin of a body."""
    found = ExternallyAppliedSpatialForce()
    found.body_index = body
    found.F_Bq_W = SpatialForce(wrench[3:], wrench[:3])
    return found
