"""The description of a loop for a bench in a browser: its scene, its controls and its outputs."""

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
from drake_dae.running.bench.any_diagram import controls_of_diagram, parts_of_diagram
from drake_dae.running.bench.controls import Controls, controls_of, prediction, strongest_pushes
from drake_dae.running.bench.inputs import with_input_values
from drake_dae.running.bench.scene import (
    RobotScene,
    Scene,
    path_in_meshcat,
    scene_of,
    surface_direction,
)

PUSHED_FRACTION = 0.15
"""The distance by which the strongest push moves a robot, as a fraction of the robot's size."""

USUAL_POLE = 4.0
"""The assumed rate of decay of the errors where there is no law with poles, in 1/s."""

TICK = 1.0 / 120.0
"""Commands take effect at multiples of this time after the start, in s."""

OF_LOOP = ("state", "constraint_force", "reference", "integral", "exogenous", "known_exogenous")
"""The output ports of a loop on which its scene and its errors depend."""


@dataclass(frozen=True, eq=False)
class Bench:
    """What a page shows of a loop or any diagram.

    Attributes:
        loop: The loop or diagram.
        context: The initial context of the diagram; all vector inputs of a diagram have values.
        scene: The drawn robots.
        controls: The inputs that a person can change.
        ports: Name -> output port: the ports on which scene and errors depend and, for a diagram,
            all output ports of the diagram with vectors.
        outputs: The names of the plotted ports, in the order of the plots.
        data: The data for the browser, as JSON represents them.
    """

    loop: ClosedLoop | Diagram
    context: Context
    scene: Scene
    controls: Controls
    ports: Mapping[str, OutputPort]
    outputs: Sequence[str]
    data: dict[str, Any]


def bench_of(
    loop: ClosedLoop | Diagram, context: Context, title: str, notes: Sequence[str] = ()
) -> Bench:
    """Returns the bench of a loop or diagram.

    Args:
        loop: The loop of a robot, or a diagram.
        context: The initial context of its diagram, which is not changed.
        title: The title of the page.
        notes: Sentences that the page shows, for example which changes are not possible.

    Raises:
        ModelError: The plant of a loop is not a robot, or a diagram has no vector output port.
        OSError: There is no free port for Meshcat.
    """
    if isinstance(loop, Diagram):
        context = with_input_values(loop, context)
        parts = parts_of_diagram(loop, context)
        scene = scene_of(parts.robots, parts.scene_graph, context)
        controls, slowest, compared = controls_of_diagram(loop, context), USUAL_POLE, None
        outputs: list[dict[str, Any]] = [{"name": s.name, "unit": s.unit} for s in parts.signals]
        ports, plotted, notes = parts.ports, parts.outputs, [*notes, *parts.notes]
        desired = ""
    else:
        scene = scene_of([loop.plant], loop.scene_graph, context)
        controls = controls_of(loop, context, scene.size)
        poles = loop.controller.law.gains.poles.real
        slowest = float(np.min(-poles)) if poles.size else USUAL_POLE
        compared, plotted = prediction(loop, controls.inputs), ["controlled_output"]
        signals, desired, places = loop.plant.dae.output_signals, *_desired(loop)
        outputs = [
            {"name": s.name, "unit": s.unit, "desired": k}
            for s, k in zip(signals, places, strict=True)
        ]
        names = [name for name in OF_LOOP if loop.diagram.HasOutputPort(name)]
        ports = {name: loop.diagram.GetOutputPort(name) for name in names}
    inputs = controls.inputs
    strongest = strongest_pushes(
        [robot.plant for robot in scene.robots],
        context,
        list(controls.pushes),
        PUSHED_FRACTION * scene.size * slowest**2,
    )
    values = inputs.values(context)
    data = {
        "title": title,
        "version": version("drake_dae"),
        "start": context.get_time(),
        "tick": TICK,
        "size": scene.size,
        "desired": desired,
        "outputs": outputs,
        "bodies": [{"name": name, "path": path} for name, path in scene.links],
        "constraints": [],
        "surfaces": [],
        "targets": [],
        "controls": controls.data(),
        "pushes": {
            name: {"input": index, "most": strongest[name]}
            for name, index in controls.pushes.items()
            if name in strongest  # A payload of the plant alone is not drawn.
        },
        "prediction": compared,
        "phase_names": [] if isinstance(loop, Diagram) else loop.controller.phase_names,
        "inputs": [
            {"name": name, "unit": unit, "value": value}
            for name, unit, value in zip(inputs.names, inputs.units, values.tolist(), strict=True)
        ],
        "notes": list(notes),
    }
    for robot in scene.robots:
        for key, value in _robot_data(robot, controls, context).items():
            data[key] += value
    return Bench(loop, context, scene, controls, ports, plotted, data)


def _desired(loop: ClosedLoop) -> tuple[str, list[int]]:
    """Returns the port with the desired values of the plant's outputs, and their places there."""
    if loop.diagram.HasOutputPort("reference"):
        return "reference", loop.controller.law.layout.lowest.tolist()
    # A task desires distances, too, while its contact is open.
    return "desired_output", list(range(loop.plant.dae.num_outputs))


def _robot_data(robot: RobotScene, controls: Controls, context: Context) -> dict[str, Any]:
    """Returns the data of a robot for the browser: its constraints, surfaces and targets."""
    plant, model = robot.plant, robot.plant.robot("a bench")
    state = plant.state(plant.GetMyContextFromRoot(context))
    sliders = {(slider.kind, slider.label): i for i, slider in enumerate(controls.sliders)}
    names = [signal.name for signal in plant.dae.output_signals]
    surfaces = []
    for surface in robot.surfaces:
        position = next(p for p in surface.parameters if p.name == f"{surface.name}.position")
        direction = None
        if surface in robot.constraints:
            direction = surface_direction(model, surface, state).tolist()
        surfaces.append(
            {
                "name": surface.name,
                "path": path_in_meshcat(surface, "surface"),
                "controls": [sliders.get(("surface", s.name)) for s in position.signals],
                "direction": direction,
            }
        )
    targets = []
    for target in robot.targets:
        signals = zip(target.axes, target.signals(model.links), strict=True)
        axes = [("xyz".index(axis), signal.name) for axis, signal in signals]
        commanded = [(axis, sliders.get(("reference", name))) for axis, name in axes]
        targets.append(
            {
                "name": target.name or target.frame,
                "axes": [[axis, slider] for axis, slider in commanded if slider is not None],
                "outputs": [[axis, names.index(name)] for axis, name in axes],
            }
        )
    return {
        "constraints": [
            {
                "name": constraint.name,
                "force": path_in_meshcat(constraint, "force"),
                "moment": path_in_meshcat(constraint, "moment") if has_moment else None,
            }
            for constraint, has_moment in zip(robot.constraints, robot.with_moment, strict=True)
        ],
        "surfaces": surfaces,
        "targets": targets,
    }


def shown_function(bench: Bench, columns: Mapping[str, ca.SX], values: ca.SX) -> ca.SX:
    """Returns the column of the scene, and below it the error coordinates of a loop.

    Args:
        bench: The bench.
        columns: Name of a port of the bench -> its symbols.
        values: The values of all inputs, in the order of `Inputs`.
    """
    loop, inputs = bench.loop, bench.controls.inputs

    def parameters_of(block: Any, size: int, exogenous: str) -> ca.SX:
        """Returns the parameters of a block, with the present values of exogenous signals."""
        parameters = ca.SX(block.dae.parameter_values[:size])
        if block in inputs.blocks:
            first = inputs.blocks[block]
            parameters = ca.SX(values[first : first + size])
        if exogenous in columns:
            parameters[list(block.exogenous_places)] = columns[exogenous]
        return parameters

    parts = list[Any]()
    for robot in bench.scene.robots:
        plant, model = robot.plant, robot.plant.robot("a bench")
        prefix = f"{plant.get_name()}." if isinstance(loop, Diagram) else ""
        state, links = columns[f"{prefix}state"], model.links.q.numel() + model.links.v.numel()
        state = state[:links]
        size = model.dae.parameter_symbol.numel()
        parameters = parameters_of(plant, size, f"{prefix}exogenous")
        parts.append(robot.function(state, columns[f"{prefix}constraint_force"], parameters))
    rows = [ca.vertcat(*rows) for rows in zip(*parts, strict=True)]
    scene = ca.vertcat(ca.SX(0, 1), *rows)
    if isinstance(loop, Diagram) or bench.data["prediction"] is None:
        return scene
    controller, law = loop.controller, loop.controller.law
    integral = columns.get("integral", ca.SX(len(law.integral.outputs), 1))
    size = law.system.parameter_symbol.numel()
    parameters = parameters_of(controller, size, "known_exogenous")
    function = law.coordinates_function.function
    coordinates = function(columns["state"], columns["reference"], integral, parameters)[0]
    return ca.vertcat(scene, coordinates)


def as_script(data: Any) -> str:
    """Returns data as JSON for a script element, escaped so that no text in it ends the script.

    Raises:
        ModelError: A number is not finite.
    """
    try:
        text = json.dumps(data, allow_nan=False)
    except ValueError:
        raise ModelError("a bench needs finite numbers") from None
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
