"""What a bench in a browser knows of a loop: its scene, its controls and its outputs."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import casadi as ca
import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.pictures.scene.arrows import path_of
from drake_dae.robots.constraint_wrenches import ConstraintWrenches
from drake_dae.running.bench.controls import Controls, controls_of, prediction
from drake_dae.running.bench.scene import (
    Scene,
    path_of_surface,
    scene_of,
    surface_direction,
)

SHARE = 0.15
"""How far the strongest push moves a robot, as a share of its size."""

TICK = 1.0 / 120.0
"""Commands take effect at multiples of this time after the start, in s."""


@dataclass(frozen=True, eq=False)
class Bench:
    """What page and live bench have of a loop.

    Attributes:
        loop, context: The loop, and the context of its diagram at the start.
        scene, controls: What is drawn, and what can be changed.
        data: All that the browser needs, as plain data.
    """

    loop: ClosedLoop
    context: Context
    scene: Scene
    controls: Controls
    data: dict[str, Any]


def bench_of(loop: ClosedLoop, context: Context, title: str, notes: Sequence[str] = ()) -> Bench:
    """The bench of a loop.

    Args:
        loop: The loop of a robot.
        context: The context of its diagram at the start; not changed.
        title: The title.
        notes: What cannot be changed, a sentence for each.

    Raises:
        ModelError: The plant is no robot.
        OSError: There is no free port for Meshcat.
    """
    scene = scene_of(loop, context)
    controls = controls_of(loop, context, scene.size)
    plant, inputs = loop.plant, controls.inputs
    state = plant.state(plant.GetMyContextFromRoot(context))
    values = inputs.values(context)
    signals = plant.dae.output_signals
    sliders = {(each.kind, each.label): number for number, each in enumerate(controls.sliders)}
    model = plant.robot("a bench")
    surfaces = []
    for each in scene.surfaces:
        position = next(p for p in each.parameters if p.name == f"{each.name}.position")
        direction = None
        if each in scene.constraints:
            direction = surface_direction(model, each, state).tolist()
        surfaces.append(
            {
                "name": each.name,
                "path": path_of_surface(each),
                "controls": [sliders.get(("surface", s.name)) for s in position.signals],
                "direction": direction,
            }
        )
    targets = [
        {
            "name": each.name or each.frame,
            "axes": [
                ["xyz".index(axis), number]
                for axis, signal in zip(each.axes, each.signals(model.links), strict=True)
                if (number := sliders.get(("reference", signal.name))) is not None
            ],
            "outputs": [
                ["xyz".index(axis), [s.name for s in signals].index(signal.name)]
                for axis, signal in zip(each.axes, each.signals(model.links), strict=True)
            ],
        }
        for each in scene.targets
    ]
    links = _links_in_contact(loop, controls)
    strongest = _strongest_pushes(loop, state, list(controls.pushes), scene.size)
    layout = loop.controller.law.layout
    data = {
        "title": title,
        "version": version("drake_dae"),
        "start": context.get_time(),
        "tick": TICK,
        "size": scene.size,
        "outputs": [
            {"name": s.name, "unit": s.unit, "lowest": int(k)}
            for s, k in zip(signals, layout.lowest, strict=True)
        ],
        "bodies": [{"name": name, "path": path} for name, path in scene.links],
        "constraints": [
            {
                "name": each.name,
                "link": links.get(each.name),
                "force": path_of(each, "force").strip("/").split("/"),
                "moment": path_of(each, "moment").strip("/").split("/") if turns else None,
            }
            for each, turns in zip(scene.constraints, scene.with_moment, strict=True)
        ],
        "opens": bool(set(plant.contacts) & set(links)),
        "surfaces": surfaces,
        "targets": targets,
        "controls": controls.data(),
        "pushes": {
            name: {"input": place, "most": strongest[name]}
            for name, place in controls.pushes.items()
        },
        "prediction": prediction(loop, inputs),
        "inputs": [
            {"name": name, "unit": unit, "value": value}
            for name, unit, value in zip(inputs.names, inputs.units, values.tolist(), strict=True)
        ],
        "notes": list(notes),
    }
    return Bench(loop, context, scene, controls, data)


def _links_in_contact(loop: ClosedLoop, controls: Controls) -> dict[str, str]:
    """Constraint -> the link that can be pushed on which it acts."""
    wrenches = ConstraintWrenches(loop.plant.robot("a bench"))
    drawn = loop.plant.robot("a bench").links.plant
    found = {}
    for constraint, frame in zip(wrenches.constraints, wrenches.frames, strict=True):
        if drawn is not None and isinstance(frame, str) and drawn.HasFrameNamed(frame):
            link = drawn.GetFrameByName(frame).body().scoped_name().get_full()
            if link in controls.pushes:
                found[constraint.name] = link
    return found


def _strongest_pushes(
    loop: ClosedLoop, state: FloatArray, links: Sequence[str], size: float
) -> dict[str, float]:
    """Link -> the force of the strongest push on it, N.

    A law with poles at -p holds a mass m as a spring of stiffness m p^2 does, and the mass felt at
    the link's origin is 1 / (J M^-1 J^T). The push moves it by `SHARE` of the robot's size.
    """
    drawn, gains = loop.plant.robot("a bench").links.plant, loop.controller.law.gains
    if drawn is None or not links:
        return {}
    slowest = float(np.min(-gains.poles.real)) if gains.poles.size else 4.0
    context = drawn.CreateDefaultContext()
    drawn.SetPositions(context, state[: drawn.num_positions()])
    mass, world, found = drawn.CalcMassMatrix(context), drawn.world_frame(), {}
    for name in links:
        instance, _, body = name.rpartition("::")
        frame = drawn.GetBodyByName(body, drawn.GetModelInstanceByName(instance)).body_frame()
        J = drawn.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, frame, np.zeros(3), world, world
        )
        # The direction in which it is lightest; a base that turns about its origin is not moved.
        lightest = float(np.linalg.eigvalsh(J @ np.linalg.solve(mass, J.T))[-1])
        felt = 1.0 / max(lightest, 1.0 / float(np.trace(mass)))
        found[name] = felt * slowest**2 * SHARE * size
    return found


def shown_function(bench: Bench, columns: dict[str, ca.SX], given: ca.SX) -> ca.SX:
    """The column of the scene, and below it the error coordinates, of a loop.

    Args:
        bench: The bench.
        columns: Name of an output of the loop -> its symbols.
        given: The parameters of all blocks, in the order of `Inputs`.
    """
    loop, inputs = bench.loop, bench.controls.inputs
    plant, controller = loop.plant, loop.controller

    def own(block: Any, size: int, moving: str) -> ca.SX:
        """The parameters of a block, with those that move as they are now."""
        found = ca.SX(block.dae.parameter_values[:size])
        if block in inputs.blocks:
            first = inputs.blocks[block]
            found = ca.SX(given[first : first + size])
        if moving in columns:
            found[list(block.exogenous_places)] = columns[moving]
        return found

    model = plant.robot("a bench")
    size = model.links.q.numel() + model.links.v.numel()
    values = own(plant, model.dae.parameter_symbol.numel(), "exogenous")
    scene = bench.scene.function(columns["state"][:size], columns["constraint_force"], values)
    if bench.data["prediction"] is None:
        return scene
    law = controller.law
    integral = columns.get("integral", ca.SX(len(law.integral.outputs), 1))
    known = own(controller, law.system.parameter_symbol.numel(), "known_exogenous")
    function = law.coordinates_function.function
    coordinates = function(columns["state"], columns["reference"], integral, known)[0]
    return ca.vertcat(scene, coordinates)


def as_script(data: Any) -> str:
    """Data in a script; no text in it ends the script.

    Raises:
        ModelError: A number in it is not finite.
    """
    try:
        text = json.dumps(data, allow_nan=False)
    except ValueError:
        raise ModelError("a bench needs numbers that are finite") from None
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
