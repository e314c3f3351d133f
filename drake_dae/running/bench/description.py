"""What a bench in a browser knows of a loop: its scene, its controls and its outputs."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import casadi as ca
import numpy as np
from pydrake.systems.framework import Context, Diagram, OutputPort

from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.pictures.scene.arrows import path_of
from drake_dae.robots.constraint_wrenches import ConstraintWrenches
from drake_dae.running.bench.any_diagram import controls_of_diagram, parts_of_diagram
from drake_dae.running.bench.controls import Controls, controls_of, prediction
from drake_dae.running.bench.inputs import Inputs, started
from drake_dae.running.bench.pushes import strongest_pushes
from drake_dae.running.bench.scene import (
    RobotScene,
    Scene,
    path_of_surface,
    scene_of,
    surface_direction,
)
from drake_dae.systems.control.contract import SIGNAL
from drake_dae.systems.plants.contract import Plant

SHARE = 0.15
"""How far the strongest push moves a robot, as a share of its size."""

USUAL_POLE = 4.0
"""The rate at which errors are taken to decay where no law says so, in 1/s."""

TICK = 1.0 / 120.0
"""Commands take effect at multiples of this time after the start, in s."""

OF_LOOP = ("state", "constraint_force", "reference", "integral", "exogenous", "known_exogenous")
"""The output ports of a loop of which its scene and its errors are functions."""


@dataclass(frozen=True, eq=False)
class Bench:
    """What page and live bench have of a loop, or of any diagram.

    Attributes:
        loop, context: The loop or diagram, and the context of the diagram at the start, in which
            inputs of a diagram have values.
        scene, controls: What is drawn, and what can be changed.
        ports: Name -> an output port in the diagram of which the scene and errors are functions;
            for a diagram, those of its own output ports as well.
        outputs: The names of those that are plotted, below each other.
        data: All that the browser needs, as plain data.
    """

    loop: ClosedLoop | Diagram
    context: Context
    scene: Scene
    controls: Controls
    ports: Mapping[str, OutputPort]
    outputs: Sequence[str]
    data: dict[str, Any]

    @property
    def diagram(self) -> Diagram:
        """The diagram."""
        return self.loop if isinstance(self.loop, Diagram) else self.loop.diagram


def bench_of(
    loop: ClosedLoop | Diagram, context: Context, title: str, notes: Sequence[str] = ()
) -> Bench:
    """The bench of a loop, or of any diagram.

    Args:
        loop: The loop of a robot, or a diagram.
        context: The context of its diagram at the start; not changed.
        title: The title.
        notes: What cannot be changed, a sentence for each.

    Raises:
        ModelError: The plant of a loop is no robot; or a diagram has no output port with a vector.
        OSError: There is no free port for Meshcat.
    """
    if isinstance(loop, Diagram):
        context = started(loop, context)
        parts = parts_of_diagram(loop, context)
        scene = scene_of(parts.robots, parts.scene_graph, context, parts.posed)
        controls, slowest, compared = controls_of_diagram(loop, context), USUAL_POLE, None
        outputs: list[dict[str, Any]] = [{"name": s.name, "unit": s.unit} for s in parts.signals]
        ports, plotted, notes = parts.ports, parts.outputs, [*notes, *parts.notes]
    else:
        scene = scene_of([loop.plant], loop.scene_graph, context)
        controls = controls_of(loop, context, scene.size)
        found = loop.controller.law.gains.poles.real
        slowest = float(np.min(-found)) if found.size else USUAL_POLE
        compared, plotted = prediction(loop, controls.inputs), ["controlled_output"]
        layout, signals = loop.controller.law.layout, loop.plant.dae.output_signals
        outputs = [
            {"name": s.name, "unit": s.unit, "lowest": int(k)}
            for s, k in zip(signals, layout.lowest, strict=True)
        ]
        names = [name for name in OF_LOOP if loop.diagram.HasOutputPort(name)]
        ports = {name: loop.diagram.GetOutputPort(name) for name in names}
    inputs = controls.inputs
    strongest = strongest_pushes(
        [one.plant for one in scene.robots],
        [*inputs.pushed],
        context,
        list(controls.pushes),
        SHARE * scene.size * slowest**2,
    )
    values = inputs.values(context)
    data = {
        "title": title,
        "version": version("drake_dae"),
        "start": context.get_time(),
        "tick": TICK,
        "size": scene.size,
        "compares": not isinstance(loop, Diagram),
        "outputs": outputs,
        "bodies": [{"name": name, "path": path} for name, path in scene.links],
        "constraints": [],
        "opens": False,
        "surfaces": [],
        "targets": [],
        "controls": controls.data(),
        "pushes": {
            name: {"input": place, "most": strongest[name]}
            for name, place in controls.pushes.items()
            if name in strongest  # A payload of the plant alone is not drawn.
        },
        "prediction": compared,
        "phases": _phase_inputs(loop, inputs),
        "inputs": [
            {"name": name, "unit": unit, "value": value}
            for name, unit, value in zip(inputs.names, inputs.units, values.tolist(), strict=True)
        ],
        "notes": list(notes),
    }
    for robot in scene.robots:
        for key, found in _robot_data(robot, controls, context).items():
            data[key] = data[key] or found if key == "opens" else data[key] + found
    return Bench(loop, context, scene, controls, ports, plotted, data)


def _phase_inputs(loop: ClosedLoop | Diagram, inputs: Inputs) -> list[int | None]:
    """The input that ends each phase of a task by hand; None where there is none."""
    if isinstance(loop, Diagram):
        return []
    places = {port.get_name(): place for port, place in inputs.ports.items()}
    return [places.get(SIGNAL + name) for name in loop.controller.phase_ends]


def _robot_data(robot: RobotScene, controls: Controls, context: Context) -> dict[str, Any]:
    """What the browser needs of a robot: its constraints, surfaces and targets."""
    plant, model = robot.plant, robot.plant.robot("a bench")
    state = plant.state(plant.GetMyContextFromRoot(context))
    sliders = {(each.kind, each.label): number for number, each in enumerate(controls.sliders)}
    names = [signal.name for signal in plant.dae.output_signals]
    surfaces = []
    for each in robot.surfaces:
        position = next(p for p in each.parameters if p.name == f"{each.name}.position")
        direction = None
        if each in robot.constraints:
            direction = surface_direction(model, each, state).tolist()
        surfaces.append(
            {
                "name": each.name,
                "path": path_of_surface(each),
                "controls": [sliders.get(("surface", s.name)) for s in position.signals],
                "direction": direction,
            }
        )
    targets = []
    for target in robot.targets:
        signals = zip(target.axes, target.signals(model.links), strict=True)
        places = [("xyz".index(axis), signal.name) for axis, signal in signals]
        commanded = [(axis, sliders.get(("reference", name))) for axis, name in places]
        targets.append(
            {
                "name": target.name or target.frame,
                "axes": [[axis, number] for axis, number in commanded if number is not None],
                "outputs": [[axis, names.index(name)] for axis, name in places],
            }
        )
    links = _links_in_contact(plant, controls)
    return {
        "constraints": [
            {
                "name": each.name,
                "link": links.get(each.name),
                "force": path_of(each, "force").strip("/").split("/"),
                "moment": path_of(each, "moment").strip("/").split("/") if turns else None,
            }
            for each, turns in zip(robot.constraints, robot.with_moment, strict=True)
        ],
        "opens": bool(links if not plant.is_ideal else set(plant.contacts) & set(links)),
        "surfaces": surfaces,
        "targets": targets,
    }


def _links_in_contact(plant: Plant, controls: Controls) -> dict[str, str]:
    """Constraint -> the link that can be pushed on which it acts."""
    model = plant.robot("a bench")
    wrenches, drawn, found = ConstraintWrenches(model), model.links.plant, {}
    for constraint, frame in zip(wrenches.constraints, wrenches.frames, strict=True):
        if drawn is not None and isinstance(frame, str) and drawn.HasFrameNamed(frame):
            link = drawn.GetFrameByName(frame).body().scoped_name().get_full()
            if link in controls.pushes:
                found[constraint.name] = link
    return found


def shown_function(bench: Bench, columns: Mapping[str, ca.SX], given: ca.SX) -> ca.SX:
    """The column of the scene, and below it the error coordinates of a loop.

    Bodies that Drake's SceneGraph poses stand where they are at the start.

    Args:
        bench: The bench.
        columns: Name of one of its ports -> its symbols.
        given: The parameters of all blocks, in the order of `Inputs`.
    """
    loop, inputs = bench.loop, bench.controls.inputs

    def own(block: Any, size: int, moving: str) -> ca.SX:
        """The parameters of a block, with those that move as they are now."""
        found = ca.SX(block.dae.parameter_values[:size])
        if block in inputs.blocks:
            first = inputs.blocks[block]
            found = ca.SX(given[first : first + size])
        if moving in columns:
            found[list(block.exogenous_places)] = columns[moving]
        return found

    parts = list[Any]()
    for robot in bench.scene.robots:
        plant, model = robot.plant, robot.plant.robot("a bench")
        before = f"{plant.get_name()}." if isinstance(loop, Diagram) else ""
        size = model.links.q.numel() + model.links.v.numel()
        values = own(plant, model.dae.parameter_symbol.numel(), f"{before}exogenous")
        force = columns[f"{before}constraint_force"]
        parts.append(robot.function(columns[f"{before}state"][:size], force, values))
    posed = ca.SX(ca.DM(bench.scene.posed.poses(bench.context)))
    rows = [ca.vertcat(*rows) for rows in zip(*parts, strict=True)]
    scene = ca.vertcat(ca.SX(0, 1), posed, *rows)
    if isinstance(loop, Diagram) or bench.data["prediction"] is None:
        return scene
    controller, law = loop.controller, loop.controller.law
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
