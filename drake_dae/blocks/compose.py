"""A diagram, or the part of it that can be traced, as one block.

What plant and law share stands here alone. By default each leaf has its own symbols, and a wire
is all that joins two of them. A law says which DaeSystem it is for (`TracedSystem.equations`,
`is_law`); a plant with these same `equations` and equal numbers in its parameters shares, with
`shares`, (1) the symbols of these parameters, and (2) if its control comes straight from this law,
x' under the law (`TracedSystem.motion`), in which A and B are factorized once for both: 1,507
operations in place of 2,770 for seven joints on a wall. `simulate` and `compile_diagram` share, for
numbers that stay; a rollout shares in the runs in which the numbers are equal. Pages and exported
loops share nothing: their numbers change.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise, starmap

import casadi as ca
import numpy as np
from pydrake.systems.framework import (
    Context,
    Diagram,
    InputPortIndex,
    OutputPort,
    OutputPortIndex,
    PortDataType,
    System,
)

from drake_dae.arguments import checked, uncollected
from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import NOTHING, Block, Held, Projection, is_same, stacked
from drake_dae.blocks.symbolic import symbolic_block
from drake_dae.blocks.traced_system import TracedSystem, context_in
from drake_dae.dae import Signal
from drake_dae.errors import ModelError

Port = tuple[System, int]
"""A leaf system and the index of one of its ports."""


@dataclass(frozen=True, eq=False)
class Leaves:
    """The leaf systems of a diagram, and the wires between them, with nested diagrams flattened."""

    systems: list[System] = field(default_factory=list)  # in the order of Drake's states
    # Input port -> the output port that it is wired to.
    sources: dict[Port, Port] = field(default_factory=dict)

    @classmethod
    def of(cls, diagram: Diagram) -> "Leaves":
        """The leaves of a diagram."""
        found = cls()
        found._collect(diagram)
        return found

    def _collect(self, diagram: Diagram) -> None:
        for system in diagram.GetSystems():
            if isinstance(system, Diagram):
                self._collect(system)
            else:
                self.systems.append(system)
        for (reader, read), (writer, written) in diagram.connection_map().items():
            source = leaf_port(writer.get_output_port(int(written)))
            self.sources.update(dict.fromkeys(leaf_inputs(reader, int(read)), source))


def leaf_port(port: OutputPort) -> Port:
    """The port of a leaf that an output port exports, through all nested diagrams."""
    system, index = port.get_system(), int(port.get_index())
    while isinstance(system, Diagram):
        system, index = system.get_output_port_locator(OutputPortIndex(index))
    return system, int(index)


def leaf_inputs(system: System, index: int) -> list[Port]:
    """The ports of leaves that an input port of a system leads to."""
    if not isinstance(system, Diagram):
        return [(system, index)]
    found = system.GetInputPortLocators(InputPortIndex(index))
    return [leaf for inner, port in found for leaf in leaf_inputs(inner, int(port))]


def laws_of(systems: Iterable[System]) -> dict[TracedSystem, TracedSystem]:
    """Plant -> the law whose model it is."""
    traced = [system for system in systems if isinstance(system, TracedSystem)]
    laws = {id(system.equations): system for system in traced if system.is_law}
    plants = [s for s in traced if not s.is_law and id(s.equations) in laws]
    return {plant: laws[id(plant.equations)] for plant in plants}


@dataclass(frozen=True, eq=False)
class Composed:
    """A part of a diagram as one block, and the places of its leaves there."""

    block: Block
    cuts: Mapping[str, Port]  # input -> the output port of a leaf that is not in the block
    fixed: Mapping[str, Port]  # input -> the input port of a leaf, exported or with a fixed value
    states: Mapping[System, slice]  # leaf -> its slice of the block's column
    parameters: Mapping[System, slice]
    held: Mapping[tuple[System, int], tuple[str, slice]]  # (leaf, group) -> group and slice

    @property
    def systems(self) -> set[System]:
        """The leaves in the block that have states."""
        return {*self.states, *(system for system, _ in self.held)}


@checked(ModelError)
def compile_diagram(
    diagram: Diagram,
    outputs: Mapping[str, OutputPort] | None = None,
    *,
    context: Context | None = None,
) -> Block:
    """A diagram as one block: the expressions of its blocks, with wires in place of inputs.

    The diagram may contain `TracedSystem` blocks, and all that Drake converts to symbolic
    expressions: its primitives, and LeafSystems templated on the scalar type. Nested diagrams are
    flattened. Systems on which no output depends, such as loggers, are left out. Output ports of
    other systems, such as a MultibodyPlant or a RandomSource, become inputs of the block, and so do
    the diagram's own input ports.

    Algebraic loops need no check: Drake finds them, by ports, when it builds the diagram.

    Args:
        diagram: The diagram.
        outputs: Name -> an output port of a system in it; its own vector-valued ports if None.
        context: A context of the diagram, with the start; the default one if None.

    Raises:
        ModelError: An input port has neither a wire nor a value, or an output port has no vector.
    """
    return compose(diagram, outputs, context=context).block


@uncollected
def compose(
    diagram: Diagram,
    outputs: Mapping[str, OutputPort] | None = None,
    *,
    context: Context | None = None,
    cuts: Mapping[str, OutputPort] | None = None,
    merge: bool = False,
    is_whole: bool = False,
    shares: bool = True,
) -> Composed:
    """As `compile_diagram`, with the places of the systems in the block.

    The block ends at the output ports of `cuts`, which are inputs of these names. With `merge` held
    values of one rate become one group, which takes Drake less time. With `is_whole` it has all
    blocks with states, also those on which no output depends.
    """
    if outputs is None:
        every = [diagram.get_output_port(i) for i in range(diagram.num_output_ports())]
        vectors = [p for p in every if p.get_data_type() == PortDataType.kVectorValued]
        outputs = {port.get_name(): port for port in vectors}
    walk = _Walk(diagram, context or diagram.CreateDefaultContext(), cuts or {}, shares)
    values = {name: walk.port(leaf_port(port)) for name, port in outputs.items()}
    for system in walk.leaves.systems if is_whole else ():
        block = walk.block(system)
        if block is not None and (block.state.numel() or block.held):
            walk.used.add(system)
    parts: dict[System, Block] = {}
    while new := [s for s in walk.leaves.systems if s in walk.used and s not in parts]:
        parts |= {system: walk.part(system) for system in new}  # May use more.
    parts = {s: parts[s] for s in walk.leaves.systems if s in parts}  # In Drake's order of states.
    owners = [s for s in walk.leaves.systems if s in walk.owners]
    states = _slices({s: part.state.numel() for s, part in parts.items()})
    parameters = _slices({s: walk.own[s]["parameters"].numel() for s in owners})
    held, places = _grouped(walk, parts, [*values.values()] if merge else None)
    starts = {
        "state": [part.default("state") for part in parts.values()],
        "parameters": [walk.parameters_of(system) for system in parameters],
    }
    scales = [s for part in parts.values() if (s := part.scale) is not None]
    block = Block(
        diagram.get_name() or "compiled",
        walk.inputs,
        values,
        stacked([part.state for part in parts.values()]),
        stacked([part.derivative for part in parts.values()]),
        held,
        stacked([walk.own[system]["parameters"] for system in parameters]),
        {name: np.concatenate([np.zeros(0), *each]) for name, each in starts.items()},
        projection=_projection(states, parts),
        scale=np.concatenate([np.zeros(0), *scales]),
        requirements=tuple(r for part in parts.values() for r in part.requirements),
        signals=walk.signals(outputs) | {"parameters": walk.parameter_signals(parameters)},
    )
    return Composed(block, walk.cuts, walk.fixed, states, parameters, places)


def _slices(sizes: Mapping[System, int]) -> dict[System, slice]:
    """The place of each system in one column, of those with entries there."""
    ends = np.cumsum([0, *sizes.values()]).tolist()
    places = zip(sizes, starmap(slice, pairwise(ends)), strict=True)
    return {system: place for system, place in places if sizes[system]}


class _Walk:
    """The expressions of a diagram's ports, found from port to port."""

    def __init__(
        self, diagram: Diagram, context: Context, cuts: Mapping[str, OutputPort], shares: bool
    ) -> None:
        self.leaves, self.context = Leaves.of(diagram), context
        self.names_of_cuts = {leaf_port(port): name for name, port in cuts.items()}
        self.prefix = f"{diagram.GetSystemPathname()}::"
        self.inputs: dict[str, ca.SX] = {}
        self.cuts: dict[str, Port] = {}
        self.fixed: dict[str, Port] = {}
        self.blocks: dict[System, Block | None] = {}
        self.own: dict[System, dict[str, ca.SX]] = {}  # Source -> symbols of this leaf.
        self.values: dict[Port, ca.SX] = {}
        self.used: set[System] = set()  # Those whose states matter.
        self.owners: set[System] = set()  # Those with parameters of their own.
        self.exported = {
            place: diagram.get_input_port(i).get_name()
            for i in range(diagram.num_input_ports())
            for place in leaf_inputs(diagram, i)
        }
        self._twins = self._find_twins() if shares else {}

    def name(self, system: System) -> str:
        """The name of a leaf, with those of the diagrams in which it is nested."""
        return system.GetSystemPathname().removeprefix(self.prefix).replace("::", ".")

    def local(self, system: System) -> Context:
        return context_in(system, self.context)

    def parameters_of(self, system: System) -> np.ndarray:
        """All numeric parameters of a leaf in the context."""
        local = self.local(system)
        groups = range(local.num_numeric_parameter_groups())
        values = [local.get_numeric_parameter(i).CopyToVector() for i in groups]
        return np.concatenate([np.zeros(0), *values])

    def _find_twins(self) -> dict[System, TracedSystem]:
        """Plant -> the law whose model it is, with equal parameters: see the head of this file."""
        twins = dict[System, TracedSystem]()
        for plant, law in laws_of(self.leaves.systems).items():
            own = self.parameters_of(plant)
            if np.array_equal(own, self.parameters_of(law)[: own.size]):
                twins[plant] = law
        return twins

    def block(self, system: System) -> Block | None:
        """The block of a leaf, which gets symbols of its own in the whole; None without one."""
        if system not in self.blocks:
            self.blocks[system] = block = (
                system.block if isinstance(system, TracedSystem) else symbolic_block(system)
            )
            if block is not None:
                self._add_symbols(system, block)
        return self.blocks[system]

    def _add_symbols(self, system: System, block: Block) -> None:
        name, own = self.name(system), dict[str, ca.SX]()
        own["state"] = ca.SX.sym(f"{name}.state", block.state.numel())
        for group, held in block.held.items():
            own[f"held {group}"] = ca.SX.sym(f"{name}.{group}", held.symbol.numel())
        size = block.parameters.numel()
        if (law := self._twins.get(system)) is not None:
            self.block(law)
            own["parameters"] = self.own[law]["parameters"][:size, 0]
        else:
            own["parameters"] = ca.SX.sym(f"{name}.parameters", size)
            self.owners.add(system)
        self.own[system] = own

    def port(self, port: Port) -> ca.SX:
        """The expression of an output port of a leaf."""
        if port not in self.values:
            system, index = port
            output = system.get_output_port(index)
            if (name := self.names_of_cuts.get(port)) is not None:
                self.values[port] = self._new_input(self.cuts, name, port, output.size())
                return self.values[port]
            block = self.block(system)
            if block is None or output.get_name() not in block.outputs:
                if output.get_data_type() != PortDataType.kVectorValued:
                    raise ModelError(
                        f"the output port '{output.get_name()}' of '{self.name(system)}' has no "
                        "vector: what depends on it cannot be traced"
                    )
                self.values[port] = self._new_input(
                    self.cuts, f"{self.name(system)}.{output.get_name()}", port, output.size()
                )
            else:
                (self.values[port],) = self.expressions(system, [block.outputs[output.get_name()]])
        return self.values[port]

    def _new_input(self, kind: dict[str, Port], name: str, port: Port, size: int) -> ca.SX:
        kind[name], self.inputs[name] = port, ca.SX.sym(name, size)
        return self.inputs[name]

    def expressions(self, system: System, values: Sequence[ca.SX]) -> list[ca.SX]:
        """Expressions of a leaf's block as expressions of the whole."""
        block = self.block(system)
        assert block is not None
        columns, sources, meanings = block.columns(), block.sources(*values), list[ca.SX]()
        for source in sources:
            if source == "time":
                meanings.append(columns[source])
            elif source.startswith("input "):
                meanings.append(ca.densify(self.input(system, source.removeprefix("input "))))
            else:
                meanings.append(self.own[system][source])
                self.used |= {system} - ({system} if source == "parameters" else set())
        if not sources:
            return [*values]
        found: list[ca.SX] = ca.substitute(list(values), [columns[s] for s in sources], meanings)
        return found

    def input(self, system: System, name: str) -> ca.SX:
        """The expression of an input of a leaf."""
        block, port = self.block(system), system.GetInputPort(name)
        place = system, int(port.get_index())
        if place in self.leaves.sources:
            return self.port(self.leaves.sources[place])
        assert block is not None
        if not port.HasValue(self.local(system)) and name in block.defaults:
            return self.expressions(system, [block.defaults[name]])[0]
        if place in self.exported or port.HasValue(self.local(system)):
            label = self.exported.get(place, f"{self.name(system)}.{name}")
            if label not in self.inputs:
                self._new_input(self.fixed, label, place, port.size())
            return self.inputs[label]
        if not port.size():
            return NOTHING
        raise ModelError(
            f"the input port '{name}' of '{self.name(system)}' has neither a wire nor a value: "
            "connect it, or fix its value in the context"
        )

    def part(self, system: System) -> Block:
        """The block of a leaf in symbols of the whole, without outputs, with its numbers."""
        block, local, own = self.block(system), self.local(system), self.own[system]
        assert block is not None
        moved = replace(block, outputs={}, defaults={}).mapped(partial(self.expressions, system))
        size = block.state.numel()
        start = local.get_continuous_state_vector().CopyToVector() if size else np.zeros(0)
        held = {
            name: replace(
                each, symbol=own[f"held {name}"], start=local.get_discrete_state(i).CopyToVector()
            )
            for i, (name, each) in enumerate(moved.held.items())
        }
        return replace(
            moved,
            state=own["state"],
            derivative=self._under(system, moved.derivative),
            held=held,
            start={"state": start},
            scale=np.ones(size) if block.scale is None else block.scale,
        )

    def _under(self, plant: System, derivative: ca.SX) -> ca.SX:
        """x' of a plant, that under its law if it is its model and gets its control by a wire."""
        law, block = self._twins.get(plant), self.block(plant)
        if law is None or block is None or "exogenous" in block.inputs:
            return derivative
        wired = self.leaves.sources.get((plant, int(plant.GetInputPort("control").get_index())))
        if wired != (law, int(law.GetOutputPort("control").get_index())):
            return derivative
        motion = law.motion()
        return derivative if motion is None else self.expressions(law, [motion])[0]

    def parameter_signals(self, systems: Iterable[System]) -> list[Signal]:
        """Names and units of the parameters of leaves; numbers where a block names none."""
        named = []
        for system in systems:
            block, name = self.block(system), self.name(system)
            assert block is not None
            count = block.parameters.numel()
            own = list(block.signals.get("parameters", ()))
            own += [Signal(f"parameter[{i}]") for i in range(len(own), count)]
            if "@" in name:  # It has no name, but an address.
                name = name.partition("@")[0].rpartition("/")[2]
            named += [Signal(f"{name}.{signal.name}", signal.unit) for signal in own[:count]]
        return named

    def signals(self, outputs: Mapping[str, OutputPort]) -> dict[str, Sequence[Signal]]:
        """Names and units of outputs, as far as their blocks have them."""
        named = {}
        for name, port in outputs.items():
            system, index = leaf_port(port)
            block = self.block(system)
            own = system.get_output_port(index).get_name()
            if block is not None and own in block.signals:
                named[name] = block.signals[own]
        return named


def _projection(
    states: Mapping[System, slice], leaves: Mapping[System, Block]
) -> Projection | None:
    """The projection of all states, each by that of its leaf."""
    parts = [(states[s], p) for s, leaf in leaves.items() if (p := leaf.projection) is not None]
    if not parts:
        return None
    ends = np.cumsum([0, *(p.parameters.numel() for _, p in parts)]).tolist()
    own = [slice(a, b) for a, b in pairwise(ends)]
    total = max(part.stop for part in states.values())
    x, start = ca.SX.sym("x", total), ca.SX.sym("start", total)
    values, steps = ca.SX.sym("parameters", ends[-1]), ca.SX.zeros(total)
    for (part, each), place in zip(parts, own, strict=True):
        steps[part] = each.newton(x[part], start[part], values[place])

    def project(state: FloatArray, parameters: FloatArray) -> FloatArray:
        moved = state
        for (part, each), place in zip(parts, own, strict=True):
            before = state[part]
            after = each.project(before, parameters[place])
            if after is not before:
                moved = state.copy() if moved is state else moved
                moved[part] = after
        return moved

    newton = ca.Function("newton", [x, start, values], [steps])
    return Projection(newton, project, stacked([p.parameters for _, p in parts]))


def _grouped(
    walk: _Walk, parts: Mapping[System, Block], outputs: Sequence[ca.SX] | None
) -> tuple[dict[str, Held], dict[tuple[System, int], tuple[str, slice]]]:
    """The groups of held values; those of one rate as one, except for those that are outputs."""
    groups, places = dict[str, list[Held]](), {}
    for system, part in parts.items():
        for i, (own, each) in enumerate(part.held.items()):
            name = f"{walk.name(system)}.{own}"
            if outputs is not None and not any(is_same(v, each.symbol) for v in outputs):
                name = f"held at {each.offset:g} s + k {each.period:g} s"
                name += "" if each.is_unrestricted else ", last"
            members = groups.setdefault(name, [])
            first = sum(member.symbol.numel() for member in members)
            places[system, i] = name, slice(first, first + each.symbol.numel())
            members.append(each)
    found = dict[str, Held]()
    for name, members in groups.items():
        begins = [ca.SX(e.start) if e.begin is None else e.begin for e in members]
        found[name] = replace(
            members[0],
            symbol=stacked([each.symbol for each in members]),
            next=stacked([each.next for each in members]),
            start=np.concatenate([each.start for each in members]),
            begin=stacked(begins) if any(e.begin is not None for e in members) else None,
        )
    return found, places
