"""The sliders and pushes by which a person changes the numeric parameters of a running loop."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.dae import DaeSystem, poles
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import GainError
from drake_dae.running.bench.inputs import PUSH, Inputs
from drake_dae.systems.control.commanded import CommandedReferences
from drake_dae.systems.control.contract import SIGNAL, Controller
from drake_dae.systems.plants.contract import Plant

MAX_SURFACE_SPEED = 0.05
"""The largest speed, in m/s, of a surface whose motion is not in the law's model."""

_ORDER = ("N", "m")
"""The units of the first sliders of references; all others follow."""


@dataclass(frozen=True)
class Control:
    """A slider, or an object that a person drags, and the inputs that it sets.

    Attributes:
        kind: "reference", "surface", "signal", "plant", "pole", "parameter" or "input".
        label, unit: Its name and unit.
        low, high, value: The smallest, the largest and the initial value.
        inputs: The indices in `Inputs` that it sets.
        known: The indices of the same parameters in the law's model, which it sets, too, if the
            person so chooses.
        factors, powers: For poles: it sets input i to `factors[i] * |value| ** powers[i]`.
        rate: The largest rate of change, in its unit per s; 0 for no limit.
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
    """All controls of a loop or diagram.

    Attributes:
        inputs: The inputs of the loop or diagram.
        sliders: The sliders and dragged objects.
        pushes: Name of a link -> the index of the first of six inputs: force, then moment.
    """

    inputs: Inputs
    sliders: Sequence[Control]
    pushes: Mapping[str, int] = field(default_factory=dict)

    def data(self) -> list[dict[str, Any]]:
        """Returns the sliders in the form of JSON."""
        return [asdict(slider) for slider in self.sliders]


def controls_of(loop: ClosedLoop, context: Context, size: float) -> Controls:
    """Returns the controls of a loop.

    Args:
        loop: The loop.
        context: The initial context of its diagram.
        size: The size of the robot, in m.
    """
    inputs = Inputs.of(loop)
    values = inputs.values(context)
    plant, controller = loop.plant, loop.controller
    sliders = [
        *_commands(loop, inputs, context, size),
        *_exogenous_surfaces(loop, inputs, 0.2 * size),
        *_compliant_surfaces(plant, inputs, values, 0.2 * size),
    ]
    sliders += [
        Control("signal", port.get_name().removeprefix(SIGNAL), "", 0.0, 1.0, 0.0, (index,))
        for port, index in inputs.ports.items()
    ]
    sliders += sliders_of_plant(plant, controller, inputs, values)
    sliders += slider_of_pole(controller, inputs, values)
    return Controls(inputs, sliders, pushes_of([plant], inputs))


def pushes_of(plants: Sequence[Plant], inputs: Inputs) -> dict[str, int]:
    """Returns the name of a link that can be pushed -> the index of the first of its six inputs."""
    pushes = dict[str, int]()
    for plant in plants:
        for name, index in _parameter_indices(plant.dae, inputs.blocks.get(plant)).items():
            if name.startswith(PUSH) and name.endswith(".force.0"):
                pushes[name.removeprefix(PUSH).removesuffix(".force.0")] = index
    return pushes


def _parameter_indices(dae: DaeSystem, first: int | None) -> dict[str, int]:
    """Returns "name.k" for entry k of a system's parameter -> its index in `Inputs`."""
    return {
        f"{parameter.name}.{k}": first + dae.parameter_slice(parameter.name).start + k
        for parameter in dae.parameters
        for k in range(parameter.value.size)
        if first is not None
    }


def sliders_of_plant(
    plant: Plant, controller: Controller | None, inputs: Inputs, values: FloatArray
) -> list[Control]:
    """Returns the sliders of frictions, then those of masses, from the tool to the base.

    Args:
        plant: The plant.
        controller: The controller whose law contains the same parameters, or None.
        inputs, values: All inputs, and their values.
    """
    first, known = inputs.blocks.get(plant), dict[str, int]()
    if controller is not None:
        known = _parameter_indices(controller.law.system, inputs.blocks.get(controller))
    indices = _parameter_indices(plant.dae, first)
    if first is not None:
        further = plant.further_parameters.items()
        indices |= {f"{name}.0": first + offset for name, (_, offset) in further}
    frictions, masses = list[Control](), list[Control]()
    for name, index in reversed(indices.items()):
        unit, value, label = inputs.units[index], float(values[index]), name.removesuffix(".0")
        set_inputs = (index,), (known[name],) if name in known else ()
        if label.endswith((".friction", ".viscous_friction")):
            high = rounded(max(0.6, 2.0 * value))
            frictions.append(Control("plant", label, unit, 0.0, high, value, *set_inputs))
        elif label.endswith(".mass") and unit == "kg":
            high = rounded(max(3.0 * value, 1.0))
            masses.append(Control("plant", label, unit, 0.5 * value, high, value, *set_inputs))
    return frictions + masses


def _commands(loop: ClosedLoop, inputs: Inputs, context: Context, size: float) -> list[Control]:
    """Returns sliders for a change of each reference."""
    generator = loop.generator
    if not isinstance(generator, CommandedReferences):
        return []
    first = inputs.blocks[generator]
    reference = generator.reference(context.get_time())[loop.controller.law.layout.lowest]
    sliders = []
    for i, signal in enumerate(generator.commands):
        r = abs(reference[i])
        ranges = {"m": 0.15 * size, "N": max(r, 10.0), "N m": max(r, 1.0)}
        high = rounded(ranges.get(signal.unit, 0.5))
        index = (first + i,)
        sliders.append(Control("reference", signal.name, signal.unit, -high, high, 0.0, index))
    return sorted(sliders, key=lambda s: _ORDER.index(s.unit) if s.unit in _ORDER else 2)


def _exogenous_surfaces(loop: ClosedLoop, inputs: Inputs, distance: float) -> list[Control]:
    """Returns sliders for the positions of surfaces, which move in the plant and in the law."""
    indices_of = dict[str, list[int]]()
    for generator in (loop.plant_exogenous, loop.exogenous):
        if isinstance(generator, CommandedReferences):
            for i, signal in enumerate(generator.commands):
                indices_of.setdefault(signal.name, []).append(inputs.blocks[generator] + i)
    high = rounded(distance)
    return [
        Control("surface", name, "m", -high, high, 0.0, tuple(indices))
        for name, indices in indices_of.items()
        if ".position" in name and inputs.units[indices[0]] == "m"
    ]


def _compliant_surfaces(
    plant: Plant, inputs: Inputs, values: FloatArray, distance: float
) -> list[Control]:
    """Returns sliders for the positions of the surfaces of a compliant contact.

    They are parameters of the plant and not of the law, and change in steps. The limited rate makes
    the steps small.
    """
    if plant.is_ideal or plant.model is None or plant not in inputs.blocks:
        return []
    indices = _parameter_indices(plant.dae, inputs.blocks[plant])
    exogenous = {parameter.name for parameter in plant.dae.exogenous.moving}
    reach, sliders = rounded(distance), list[Control]()
    for constraint in plant.model.constraints:
        name = f"{constraint.name}.position"
        if f"{name}.0" not in indices or name in exogenous:
            continue
        for k in range(3):
            index = indices[f"{name}.{k}"]
            value, label = float(values[index]), inputs.names[index].partition(".")[2]
            limits = value - reach, value + reach, value
            sliders.append(
                Control("surface", label, "m", *limits, (index,), rate=MAX_SURFACE_SPEED)
            )
    return sliders


def slider_of_pole(controller: Controller, inputs: Inputs, values: FloatArray) -> list[Control]:
    """Returns a slider for the pole of all errors; none if the gains do not have a single pole."""
    law = controller.law
    if not controller.follows or controller not in inputs.blocks:
        return []
    first = inputs.blocks[controller]
    size = law.system.parameter_vector(None).size
    try:
        gains = {p: law.all_parameters(None, poles(-p))[size:] for p in (1.0, 2.0, 3.0)}
    except GainError:
        return []
    factors = gains[1.0]
    indices = [first + size + i for i in range(factors.size)]
    powers = np.round(np.log2(np.where(factors, gains[2.0] / np.where(factors, factors, 1.0), 1.0)))
    if not indices or not np.allclose(factors * 3.0**powers, gains[3.0], rtol=1e-9):
        return []
    # The mean of all poles, since the computed eigenvalues of a multiple pole are not exact.
    pole = -float(np.trace(law.gains.error_matrix)) / law.gains.layout.chain_size
    if not np.allclose(values[indices], factors * pole**powers, rtol=1e-9):
        return []
    set_inputs = tuple(indices), (), tuple(factors.tolist()), tuple(powers.astype(int).tolist())
    fastest = rounded(max(4.0 * pole, 20.0))
    return [Control("pole", "pole of all errors", "1/s", -fastest, -0.5, -pole, *set_inputs)]


def strongest_pushes(
    robots: Sequence[Plant],
    context: Context,
    links: Sequence[str],
    rate: float,
) -> dict[str, float]:
    """Returns link -> the force of the strongest push on it, N.

    A law with poles at -p acts on a mass m like a spring of stiffness m p^2, and the effective mass
    at the link's origin is 1 / (J M^-1 J^T). So a force m p^2 d moves the link by d.

    Args:
        robots: The robots that contain the links.
        context: The context of the diagram.
        links: The names of the links.
        rate: p^2 d, in m/s^2.
    """
    masses = dict[str, float]()
    for robot in robots:
        multibody = robot.robot("a bench").links.plant
        if multibody is not None:
            state = robot.state(robot.GetMyContextFromRoot(context))
            masses |= _effective_masses(multibody, state[: multibody.num_positions()], links)
    return {name: mass * rate for name, mass in masses.items()}


def _effective_masses(
    plant: MultibodyPlant, positions: FloatArray, links: Sequence[str]
) -> dict[str, float]:
    """Returns link -> the effective mass at its origin, kg."""
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, positions)
    M, world, masses = plant.CalcMassMatrix(context), plant.world_frame(), dict[str, float]()
    for name in links:
        model, _, body = name.rpartition("::")
        if not plant.HasModelInstanceNamed(model):
            continue
        instance = plant.GetModelInstanceByName(model)
        if not plant.HasBodyNamed(body, instance):
            continue
        frame = plant.GetBodyByName(body, instance).body_frame()
        J = plant.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, frame, np.zeros(3), world, world
        )
        # In the direction of the smallest mass; the bound covers links whose origin cannot move.
        mobility = float(np.linalg.eigvalsh(J @ np.linalg.solve(M, J.T))[-1])
        masses[name] = 1.0 / max(mobility, 1.0 / float(np.trace(M)))
    return masses


def rounded(value: float) -> float:
    """Returns a value rounded to one significant digit."""
    return float(f"{value:.1g}")


def prediction(loop: ClosedLoop, inputs: Inputs) -> dict[str, Any] | None:
    """Returns the data for the prediction of the error: E of e' = E e (30), and its outputs.

    Returns:
        "size": the number of error coordinates; "ends": the rows of E that contain gains; "gains":
        (row, column, index in `Inputs`) of each gain; "shown": (output, coordinate, whether the
        derivative is shown), without outputs whose error is zero. None if the controller's errors
        do not form a linear system.
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
        (row_of[i], j, first + k)
        for k, (i, j) in enumerate(
            (i, j)
            for j in range(layout.chain_size)
            for i in np.flatnonzero(law.gains.matrix[:, j]).tolist()
        )
    ]
    shown = [(i, int(layout.starts[i]), i in law.integral.outputs) for i in layout.dynamic.tolist()]
    ends = layout.ends.tolist()
    return {"size": layout.chain_size, "ends": ends, "gains": gains, "shown": shown}
