"""What a person can change in a loop that runs: its numeric parameters, and what moves them."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, InputPort, LeafSystem, System

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.gains import poles
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import GainError
from drake_dae.running.export.steps.words import distinct, parameters_of_block
from drake_dae.systems.control.command_filter import SPEED
from drake_dae.systems.control.commanded import CommandedReferences
from drake_dae.systems.control.contract import SIGNAL

PUSH = "push."
"""Begins the names of the wrenches that push links."""


_ORDER = {("speed", ""): 0, ("reference", "N"): 1, ("reference", "m"): 2}
"""The order of sliders; others follow."""


@dataclass(frozen=True, eq=False)
class Inputs:
    """The numeric parameters of the blocks of a loop, below each other, and signals it waits for.

    Attributes:
        blocks: The blocks, each with numeric parameter 0, and where its entries begin.
        ports: The signals for which a task waits: input port of the diagram -> its entry.
        names, units: Those of each entry.
    """

    blocks: Mapping[System, int]
    ports: Mapping[InputPort, int]
    names: Sequence[str]
    units: Sequence[str]

    @classmethod
    def of(cls, loop: ClosedLoop) -> "Inputs":
        """Those of generators, plant and controller."""
        context = loop.diagram.CreateDefaultContext()
        sources = loop.generator, loop.exogenous, loop.plant_exogenous
        made = (*sources, loop.plant, loop.controller, loop.plant.pushes)
        blocks, signals = dict[System, int](), list[Signal]()
        for block in made:
            # Drake's own contact is a Diagram, whose numbers are those of many blocks.
            if not isinstance(block, LeafSystem):
                continue
            own = block.GetMyContextFromRoot(context)
            if own.num_numeric_parameter_groups():
                blocks[block] = len(signals)
                signals += parameters_of_block(block, own.get_numeric_parameter(0).size())
        diagram, ports = loop.diagram, dict[InputPort, int]()
        for i in range(diagram.num_input_ports()):
            port = diagram.get_input_port(i)
            if port.get_name().startswith(SIGNAL):
                ports[port] = len(signals)
                signals.append(Signal(port.get_name()))
        found = distinct(signals)
        return cls(blocks, ports, [s.name for s in found], [s.unit for s in found])

    def values(self, context: Context) -> FloatArray:
        """Their values in a context of the loop's diagram."""
        own = (block.GetMyContextFromRoot(context) for block in self.blocks)
        parts = [each.get_numeric_parameter(0).CopyToVector() for each in own]
        given = [port.Eval(context) if port.HasValue(context) else [0.0] for port in self.ports]
        return np.concatenate([*parts, *given])

    def set(self, context: Context, changes: Mapping[int, float]) -> None:
        """Changes entries in a context."""
        for block, first in self.blocks.items():
            own = block.GetMyMutableContextFromRoot(context)
            size = own.get_numeric_parameter(0).size()
            mine = {i - first: x for i, x in changes.items() if first <= i < first + size}
            if mine:
                values = own.get_numeric_parameter(0).CopyToVector()
                values[list(mine)] = list(mine.values())
                own.get_mutable_numeric_parameter(0).SetFromVector(values)
        for port, place in self.ports.items():
            if place in changes:
                port.FixValue(context, [changes[place]])


@dataclass(frozen=True)
class Control:
    """A slider, or something that is dragged, and the inputs that it sets.

    Attributes:
        kind: "speed", "reference", "surface", "signal", "plant" or "pole".
        label, unit: What it is called.
        low, high, value: The ends of the slider, and where it begins.
        inputs: The entries of `Inputs` that it sets.
        known: Those of the law's model with the same meaning, which it sets if the law is to know.
        powers: For poles: each input is `factors[i] * |value| ** powers[i]`.
    """

    kind: str
    label: str
    unit: str
    low: float
    high: float
    value: float
    inputs: tuple[int, ...]
    known: tuple[int, ...] = ()
    factors: tuple[float, ...] = ()
    powers: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Controls:
    """All controls of a loop, and the names of the rest.

    Attributes:
        inputs: The parameters.
        sliders: The controls that are sliders.
        pushes: Name of a link -> the first of six inputs: force, then moment.
    """

    inputs: Inputs
    sliders: Sequence[Control]
    pushes: Mapping[str, int] = field(default_factory=dict)

    def data(self) -> list[dict[str, Any]]:
        """The sliders as plain data."""
        return [asdict(each) for each in self.sliders]


def controls_of(loop: ClosedLoop, context: Context, size: float) -> Controls:
    """The controls of a loop.

    Args:
        loop: The loop.
        context: The context of its diagram at the start.
        size: The size of the robot, in m.
    """
    inputs = Inputs.of(loop)
    values = inputs.values(context)
    found = _commands(loop, inputs, context, size) + _surfaces(loop, inputs, 0.2 * size)
    found += [
        Control("signal", port.get_name().removeprefix(SIGNAL), "", 0.0, 1.0, 0.0, (place,))
        for port, place in inputs.ports.items()
    ]
    found += _plant(loop, inputs, values) + _pole(loop, inputs, values)
    places = _places(loop.plant.dae, inputs.blocks.get(loop.plant))
    pushes = {
        name.removeprefix(PUSH).removesuffix(".force.0"): place
        for name, place in places.items()
        if name.startswith(PUSH) and name.endswith(".force.0")
    }
    if loop.plant.pushes in inputs.blocks:
        first, end = inputs.blocks[loop.plant.pushes], f".{PUSH}"
        for place in range(first, len(inputs.names)):
            _, is_push, name = inputs.names[place].partition(end)
            if is_push and name.endswith(".force[0]"):
                pushes[name.removesuffix(".force[0]")] = place
    return Controls(inputs, found, pushes)


def _places(dae: DaeSystem, first: int | None) -> dict[str, int]:
    """Name and number of an entry of a system's parameters -> its place among the inputs."""
    return {
        f"{parameter.name}.{k}": first + dae.parameter_slice(parameter.name).start + k
        for parameter in dae.parameters
        for k in range(parameter.value.size)
        if first is not None
    }


def _plant(loop: ClosedLoop, inputs: Inputs, values: FloatArray) -> list[Control]:
    """Frictions and masses: first frictions, then links from the tool on."""
    plant, first = loop.plant, inputs.blocks.get(loop.plant)
    known = _places(loop.controller.law.system, inputs.blocks.get(loop.controller))
    places = _places(plant.dae, first)
    if first is not None:
        further = plant.further_parameters.items()
        places |= {f"{name}.0": first + place for name, (_, place) in further}
    frictions, masses = list[Control](), list[Control]()
    for name, place in reversed(places.items()):
        unit, value, label = inputs.units[place], float(values[place]), name.removesuffix(".0")
        given = (place,), (known[name],) if name in known else ()
        if label.endswith((".friction", ".viscous_friction")):
            most = _round(max(0.6, 2.0 * value))
            frictions.append(Control("plant", label, unit, 0.0, most, value, *given))
        elif label.endswith(".mass") and unit == "kg":
            most = _round(max(3.0 * value, 1.0))
            masses.append(Control("plant", label, unit, 0.5 * value, most, value, *given))
    return frictions + masses


def _commands(loop: ClosedLoop, inputs: Inputs, context: Context, size: float) -> list[Control]:
    """The speed along the path, and a change of each reference."""
    generator = loop.generator
    if not isinstance(generator, CommandedReferences):
        return []
    first = inputs.blocks[generator]
    layout = loop.controller.law.layout
    now = generator.reference(context.get_time())[layout.lowest]
    start = int(generator.commands[0] is SPEED)
    found = []
    if start:
        found.append(Control("speed", "speed along the path", "", 0.0, 2.0, 1.0, (first,)))
    for i, signal in enumerate(generator.commands[start:]):
        reach = {"m": 0.15 * size, "N": max(abs(now[i]), 10.0), "N m": max(abs(now[i]), 1.0)}
        most = _round(reach.get(signal.unit, 0.5))
        place = (first + start + i,)
        found.append(Control("reference", signal.name, signal.unit, -most, most, 0.0, place))
    return sorted(found, key=lambda each: _ORDER.get((each.kind, each.unit), 3))


def _surfaces(loop: ClosedLoop, inputs: Inputs, reach: float) -> list[Control]:
    """The positions of surfaces, for plant and law."""
    generators = loop.plant_exogenous, loop.exogenous
    found = dict[str, list[int]]()
    for generator in generators:
        if isinstance(generator, CommandedReferences):
            for i, signal in enumerate(generator.commands):
                found.setdefault(signal.name, []).append(inputs.blocks[generator] + i)
    most = _round(reach)
    return [
        Control("surface", name, inputs.units[places[0]], -most, most, 0.0, tuple(places))
        for name, places in found.items()
        if ".position" in name and inputs.units[places[0]] == "m"
    ]


def _pole(loop: ClosedLoop, inputs: Inputs, values: FloatArray) -> list[Control]:
    """One pole for all errors, where the gains are those of one pole."""
    controller, law = loop.controller, loop.controller.law
    if not controller.follows or controller not in inputs.blocks:
        return []
    first = inputs.blocks[controller]
    size = law.system.parameter_vector(None).size
    try:
        at = {p: law.all_parameters(None, poles(-p))[size:] for p in (1.0, 2.0, 3.0)}
    except GainError:
        return []
    places = [first + size + i for i in range(at[1.0].size)]
    factors = at[1.0]
    powers = np.round(np.log2(np.where(factors, at[2.0] / np.where(factors, factors, 1.0), 1.0)))
    if not places or not np.allclose(factors * 3.0**powers, at[3.0], rtol=1e-9):
        return []
    # The mean of all poles; eigenvalues that coincide are not found exactly.
    own = -float(np.trace(law.gains.error_matrix)) / law.gains.layout.chain_size
    if not np.allclose(values[places], factors * own**powers, rtol=1e-9):
        return []
    given = tuple(places), (), tuple(factors.tolist()), tuple(powers.astype(int).tolist())
    most = _round(max(4.0 * own, 20.0))
    return [Control("pole", "pole of all errors", "1/s", -most, -0.5, -own, *given)]


def _round(value: float) -> float:
    """A number of one or two digits near a value."""
    return float(f"{value:.1g}")


def prediction(loop: ClosedLoop, inputs: Inputs) -> dict[str, Any] | None:
    """How the error is predicted: E of e' = E e (30), and which of e each output shows.

    Returns:
        "size"; "ends": the rows of E that hold gains; "gains": (row, column, input) of each;
        "shown": (output, coordinate, whether its derivative is shown), without outputs whose error
        is zero. None where the errors of a controller are no linear system.
    """
    controller = loop.controller
    if not (controller.follows and loop.generator is not None and controller in inputs.blocks):
        return None
    law = controller.law
    if law.system.num_states != loop.plant.dae.num_states:
        return None
    layout = law.gains.layout
    first = inputs.blocks[controller] + law.system.parameter_vector(None).size
    row_of = dict(zip(layout.dynamic.tolist(), layout.ends.tolist(), strict=True))
    gains = [
        (row_of[i], j, first + number)
        for number, (i, j) in enumerate(
            (i, j)
            for j in range(layout.chain_size)
            for i in np.flatnonzero(law.gains.matrix[:, j]).tolist()
        )
    ]
    shown = [(i, int(layout.starts[i]), i in law.integral.outputs) for i in layout.dynamic.tolist()]
    ends = layout.ends.tolist()
    return {"size": layout.chain_size, "ends": ends, "gains": gains, "shown": shown}
