"""What a person can change in a loop that runs: its numeric parameters, and what moves them."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.gains import poles
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import GainError
from drake_dae.running.bench.inputs import PUSH, Inputs
from drake_dae.systems.control.command_filter import SPEED
from drake_dae.systems.control.commanded import CommandedReferences
from drake_dae.systems.control.contract import SIGNAL, Controller
from drake_dae.systems.plants.contract import Plant
from drake_dae.systems.task.phases.by_hand import BY_HAND

SLOW = 0.05
"""How fast a surface moves that no law knows, in m/s."""

_ORDER = {("speed", ""): 0, ("reference", "N"): 1, ("reference", "m"): 2}
"""The order of sliders; others follow."""


@dataclass(frozen=True)
class Control:
    """A slider, or something that is dragged, and the inputs that it sets.

    Attributes:
        kind: "speed", "reference", "surface", "signal", "plant", "pole", "parameter" or "input".
        label, unit: What it is called.
        low, high, value: The ends of the slider, and where it begins.
        inputs: The entries of `Inputs` that it sets.
        known: Those of the law's model with the same meaning, which it sets if the law is to know.
        powers: For poles: each input is `factors[i] * |value| ** powers[i]`.
        rate: How fast it changes at most, in its unit per s; 0 for at once.
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
    rate: float = 0.0


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
    found += _unknown_surfaces(loop.plant, inputs, values, 0.2 * size)
    found += [
        Control("signal", name, "", 0.0, 1.0, 0.0, (place,))
        for port, place in inputs.ports.items()
        if not (name := port.get_name().removeprefix(SIGNAL)).startswith(BY_HAND)
    ]
    plant, controller = loop.plant, loop.controller
    found += of_plant(plant, controller, inputs, values) + of_pole(controller, inputs, values)
    return Controls(inputs, found, pushes_of([plant], inputs))


def pushes_of(plants: Sequence[Plant], inputs: Inputs) -> dict[str, int]:
    """Name of a link that can be pushed -> the first of its six inputs."""
    found = dict[str, int]()
    for plant in plants:
        for name, place in _places(plant.dae, inputs.blocks.get(plant)).items():
            if name.startswith(PUSH) and name.endswith(".force.0"):
                found[name.removeprefix(PUSH).removesuffix(".force.0")] = place
    for place, name in enumerate(inputs.names):
        _, is_push, link = name.partition(f".{PUSH}")
        if is_push and link.endswith(".force[0]"):
            found.setdefault(link.removesuffix(".force[0]"), place)
    return found


def _places(dae: DaeSystem, first: int | None) -> dict[str, int]:
    """Name and number of an entry of a system's parameters -> its place among the inputs."""
    return {
        f"{parameter.name}.{k}": first + dae.parameter_slice(parameter.name).start + k
        for parameter in dae.parameters
        for k in range(parameter.value.size)
        if first is not None
    }


def of_plant(
    plant: Plant, controller: Controller | None, inputs: Inputs, values: FloatArray
) -> list[Control]:
    """Frictions and masses: first frictions, then links from the tool on.

    Args:
        plant: The plant.
        controller: The one whose law may know them; None without one.
        inputs, values: All inputs, and their values.
    """
    first, known = inputs.blocks.get(plant), dict[str, int]()
    if controller is not None:
        known = _places(controller.law.system, inputs.blocks.get(controller))
    places = _places(plant.dae, first)
    if first is not None:
        further = plant.further_parameters.items()
        places |= {f"{name}.0": first + place for name, (_, place) in further}
    frictions, masses = list[Control](), list[Control]()
    for name, place in reversed(places.items()):
        unit, value, label = inputs.units[place], float(values[place]), name.removesuffix(".0")
        given = (place,), (known[name],) if name in known else ()
        if label.endswith((".friction", ".viscous_friction")):
            most = rounded(max(0.6, 2.0 * value))
            frictions.append(Control("plant", label, unit, 0.0, most, value, *given))
        elif label.endswith(".mass") and unit == "kg":
            most = rounded(max(3.0 * value, 1.0))
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
        most = rounded(reach.get(signal.unit, 0.5))
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
    most = rounded(reach)
    return [
        Control("surface", name, inputs.units[places[0]], -most, most, 0.0, tuple(places))
        for name, places in found.items()
        if ".position" in name and inputs.units[places[0]] == "m"
    ]


def _unknown_surfaces(
    plant: Plant, inputs: Inputs, values: FloatArray, reach: float
) -> list[Control]:
    """The positions of the surfaces of a compliant contact, which no law knows.

    They are parameters of the plant, and so change in steps: slow ones, which are small.
    """
    if plant.is_ideal or plant.model is None or plant not in inputs.blocks:
        return []
    places, moving = _places(plant.dae, inputs.blocks[plant]), plant.dae.exogenous.moving
    known, most, found = {one.name for one in moving}, rounded(reach), list[Control]()
    for constraint in plant.model.constraints:
        name = f"{constraint.name}.position"
        for k in range(3) if f"{name}.0" in places and name not in known else ():
            place = places[f"{name}.{k}"]
            value, label = float(values[place]), inputs.names[place].partition(".")[2]
            limits = value - most, value + most, value
            found.append(Control("surface", label, "m", *limits, (place,), rate=SLOW))
    return found


def of_pole(controller: Controller, inputs: Inputs, values: FloatArray) -> list[Control]:
    """One pole for all errors, where the gains are those of one pole."""
    law = controller.law
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
    most = rounded(max(4.0 * own, 20.0))
    return [Control("pole", "pole of all errors", "1/s", -most, -0.5, -own, *given)]


def rounded(value: float) -> float:
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
