"""The sliders and pushes by which a person changes the parameters of a running diagram."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.multibody.tree import BodyIndex, JacobianWrtVariable
from pydrake.systems.framework import System

from drake_dae.arrays import FloatArray
from drake_dae.dae import Signal
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.systems.controller import SIGNAL, Controller
from drake_dae.systems.plant import Plant
from drake_dae.systems.references import CommandedReferences

# The largest speed, in m/s, of a surface whose motion is not in the law's model.
MAX_SURFACE_SPEED = 0.05
PUSH = "push."  # The prefix of the names of the wrenches that push links.
_ORDER = ("N", "m")  # The units of the first sliders of references; all others follow.


@dataclass(frozen=True)
class Control:
    """A slider, or an object that a person drags, and the places of the parameters that it sets."""

    kind: str  # "reference", "surface", "signal", "plant" or "pole"
    label: str
    unit: str
    low: float
    high: float
    value: float
    inputs: tuple[int, ...]
    known: tuple[int, ...] = ()  # The same parameters of the law's model, if the person so chooses.
    factors: tuple[float, ...] = ()  # Of poles: parameter i is factors[i] * |value| ** powers[i].
    powers: tuple[int, ...] = ()
    rate: float = 0.0  # the largest rate of change per s; 0: no limit


@dataclass(frozen=True, eq=False)
class Numbers:
    """All parameters of a page in one column, with their values at the start."""

    signals: Sequence[Signal]
    values: FloatArray
    systems: Mapping[System, slice]  # System -> the place of its parameters.
    inputs: Mapping[str, slice]  # Name of a free input port -> the place of its value.

    def of(self, system: Any) -> dict[str, int]:
        """Name of a parameter of a block -> its place."""
        part = self.systems.get(system)
        if part is None:
            return {}
        named = system.block.signals.get("parameters", ())
        return {signal.name: part.start + i for i, signal in enumerate(named)}


def controls_of(loop: ClosedLoop, numbers: Numbers, time: float, size: float) -> list[Control]:
    """The controls of a loop with a robot of some size in m, from a time in s on."""
    signals = [
        Control("signal", name.removeprefix(SIGNAL), "", 0.0, 1.0, 0.0, (place.start,))
        for name, place in numbers.inputs.items()
        if name.startswith(SIGNAL)
    ]
    return [
        *_commands(loop, numbers, time, size),
        *_surfaces(loop, numbers, rounded(0.2 * size)),
        *signals,
        *_controls_of_plant(loop, numbers),
        *_control_of_pole(loop.controller, numbers),
    ]


def pushes_of(plant: Plant, numbers: Numbers) -> dict[str, int]:
    """Name of a link that can be pushed -> the place of the first of six parameters."""
    end = ".force[0]"
    return {
        name.removeprefix(PUSH).removesuffix(end): place
        for name, place in numbers.of(plant).items()
        if name.startswith(PUSH) and name.endswith(end)
    }


def _controls_of_plant(loop: ClosedLoop, numbers: Numbers) -> list[Control]:
    """Sliders of frictions, then those of masses, from the tool to the base."""
    plant, known = loop.plant, numbers.of(loop.controller)
    frictions, masses = list[Control](), list[Control]()
    for name, place in reversed(numbers.of(plant).items()):
        unit, value = numbers.signals[place].unit, float(numbers.values[place])
        places = (place,), (known[name],) if name in known else ()
        if name.endswith((".friction", ".viscous_friction")):
            high = rounded(max(0.6, 2.0 * value))
            frictions.append(Control("plant", name, unit, 0.0, high, value, *places))
        elif name.endswith(".mass") and unit == "kg":
            high = rounded(max(3.0 * value, 1.0))
            masses.append(Control("plant", name, unit, 0.5 * value, high, value, *places))
    return frictions + masses


def _commands(loop: ClosedLoop, numbers: Numbers, time: float, size: float) -> list[Control]:
    """Sliders for a change of each reference."""
    if not isinstance(loop.generator, CommandedReferences):
        return []
    reference = loop.generator.reference(time)[loop.controller.law.layout.lowest]
    controls = []
    for r, (name, place) in zip(np.abs(reference), numbers.of(loop.generator).items(), strict=True):
        unit = numbers.signals[place].unit
        ranges = {"m": 0.15 * size, "N": max(r, 10.0), "N m": max(r, 1.0)}
        high = rounded(ranges.get(unit, 0.5))
        controls.append(Control("reference", name, unit, -high, high, 0.0, (place,)))
    return sorted(controls, key=lambda s: _ORDER.index(s.unit) if s.unit in _ORDER else 2)


def _surfaces(loop: ClosedLoop, numbers: Numbers, reach: float) -> list[Control]:
    """Sliders for the positions of surfaces."""
    # Those that move do so in the plant and in the law. Those of a compliant contact are parameters
    # of the plant and not of the law, and change in steps, which the limited rate makes small.
    places, plant = dict[str, list[int]](), loop.plant
    for generator in dict.fromkeys((loop.plant_exogenous, loop.exogenous)):
        if isinstance(generator, CommandedReferences):
            for name, place in numbers.of(generator).items():
                if ".position" in name and numbers.signals[place].unit == "m":
                    places.setdefault(name, []).append(place)
    controls = [
        Control("surface", name, "m", -reach, reach, 0.0, tuple(every))
        for name, every in places.items()
    ]
    if plant.is_ideal or plant.model is None:
        return controls
    own, exogenous = numbers.of(plant), {signal.name for signal in plant.dae.exogenous.signals}
    names = [f"{c.name}.position[{k}]" for c in plant.model.constraints for k in range(3)]
    for name in [name for name in names if name in own and name not in exogenous]:
        value, rate = float(numbers.values[own[name]]), MAX_SURFACE_SPEED
        limits = value - reach, value + reach, value
        controls.append(Control("surface", name, "m", *limits, (own[name],), rate=rate))
    return controls


def _control_of_pole(controller: Controller, numbers: Numbers) -> list[Control]:
    """A slider that moves all poles of the errors in proportion: their mean."""
    gains, part = controller.law.gains, numbers.systems.get(controller)
    layout = gains.layout
    if not controller.follows or part is None or not layout.chain_size:
        return []
    first = part.start + controller.law.system.parameter_symbol.numel()
    starts = {int(i): int(layout.starts[i]) for i in layout.dynamic}
    lengths = {i: end - starts[i] + 1 for i, end in zip(starts, layout.ends.tolist(), strict=True)}
    # Of (30) in the time s t, the gain from derivative k to one of order n is s^(n - k) as large.
    powers = [
        lengths[i] - j + max(start for start in starts.values() if start <= j)
        for j, i in np.argwhere(gains.matrix.T).tolist()
    ]
    places = range(first, first + len(powers))
    pole = -float(np.trace(gains.error_matrix)) / layout.chain_size
    factors = numbers.values[places] / pole ** np.array(powers)
    sets = tuple(places), (), tuple(factors.tolist()), tuple(powers)
    fastest = rounded(max(4.0 * pole, 20.0))
    return [Control("pole", "pole of all errors", "1/s", -fastest, -0.5, -pole, *sets)]


def strongest_pushes(
    plant: Plant, state: FloatArray, links: Sequence[str], rate: float
) -> dict[str, float]:
    """Link -> the force of the strongest push on it, in N; `rate` is p^2 d."""
    # A law with poles at -p acts on a mass m like a spring of stiffness m p^2, and the mass at the
    # link's origin is 1 / (J M^-1 J^T). So a force m p^2 d moves the link by d.
    robot, forces = plant.robot("a page").links.plant, dict[str, float]()
    if robot is None:
        return forces
    context = robot.CreateDefaultContext()
    robot.SetPositions(context, state[: robot.num_positions()])
    M, world = robot.CalcMassMatrix(context), robot.world_frame()
    bodies = [robot.get_body(BodyIndex(i)) for i in range(1, robot.num_bodies())]
    for body in (body for body in bodies if body.scoped_name().get_full() in links):
        J = robot.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, body.body_frame(), np.zeros(3), world, world
        )
        # The bound covers links whose origin cannot move.
        mobility = float(np.linalg.eigvalsh(J @ np.linalg.solve(M, J.T))[-1])
        mass = 1.0 / max(mobility, 1.0 / float(np.trace(M)))
        forces[body.scoped_name().get_full()] = mass * rate
    return forces


def rounded(value: float) -> float:
    """A value with one significant digit."""
    return float(f"{value:.1g}")


def prediction(loop: ClosedLoop, part: slice | None) -> dict[str, Any] | None:
    """E of e' = E e (30) for the browser; None if the errors do not form a linear system.

    "ends" are the rows of E that contain gains, "gains" (row, column, place) of each, "shown"
    (output, coordinate, whether its derivative is shown), without outputs whose error is zero.
    """
    law = loop.controller.law
    if not loop.controller.follows or loop.generator is None or part is None:
        return None
    if law.system.num_states != loop.plant.dae.num_states:
        return None
    layout, first = law.gains.layout, part.start + law.system.parameter_symbol.numel()
    row_of = dict(zip(layout.dynamic.tolist(), layout.ends.tolist(), strict=True))
    entries = [(row_of[i], j) for j, i in np.argwhere(law.gains.matrix.T).tolist()]
    shown = [(i, int(layout.starts[i]), i in law.integral.outputs) for i in layout.dynamic.tolist()]
    return {
        "size": layout.chain_size,
        "ends": layout.ends.tolist(),
        "gains": [(row, j, first + k) for k, (row, j) in enumerate(entries)],
        "shown": shown,
    }
