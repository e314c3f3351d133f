"""Writes a loop as one HTML file in which it runs as WebAssembly."""

import base64
import html
import json
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.tree import Frame
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, PortDataType

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import stacked
from drake_dae.blocks.compose import compose
from drake_dae.dae import DaeSystem
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import MachineCodeError, ModelError
from drake_dae.pictures.motion import surface_normals
from drake_dae.pictures.page_controls import (
    Numbers,
    controls_of,
    prediction,
    pushes_of,
    strongest_pushes,
)
from drake_dae.robots import (
    Constraint,
    ConstraintWrenches,
    PointCoordinates,
    RobotModel,
    rotation_of,
)
from drake_dae.running.c_code import BlockCode
from drake_dae.running.export import check_traced, write_loop
from drake_dae.scene.arrows import path_of
from drake_dae.scene.surroundings import scene_points
from drake_dae.scene.view import draw_scene, start_unwatched_meshcat, view_of_links
from drake_dae.systems.plant import Plant
from drake_dae.trace.compiled import compile_webassembly

WEB = Path(__file__).with_name("web")

# The scripts, in the order in which the page contains them.
SCRIPTS = ("engine.js", "prediction.js", "view.js", "drag.js", "plots.js", "panel.js", "bench.js")
# The output ports of a loop that the page reads as they are.
SHOWN = ("controlled_output", "reference", "desired_output", "change")
# The distance by which the strongest push moves a robot, as a fraction of the robot's size.
PUSHED_FRACTION = 0.15
# The assumed rate of decay of the errors where there is no law with poles, in 1/s.
USUAL_POLE = 4.0
# Commands take effect at multiples of this time after the start, in s, or of the steps near it.
TICK = 1.0 / 120.0
_BACKGROUND = [0.97, 0.97, 0.98]
# The Content-Security-Policy of the page, which loads nothing from the network.
_CONTENT_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' data: blob:; "
    "style-src 'unsafe-inline'; img-src data: blob:; worker-src data: blob:; "
    "connect-src data: blob:"
)


@checked(ModelError)
def write_page(
    loop: ClosedLoop,
    context: Context | None,
    file: str | Path,
    config: SimulatorConfig | None = None,
    title: str = "",
    notes: Sequence[str] = (),
) -> Path:
    """Writes a loop of a robot as one HTML file in which it runs, without server and network.

    Plant, law and references run in real time as WebAssembly, by the stepper of rollouts. The page
    draws the robot by the bundle of Drake's Meshcat, and a person pushes its links with the
    pointer. Sliders change the masses and the friction of the plant, and the poles; in a loop with
    `LoopSettings.commanded` also the references and the positions of surfaces. Plots show forces
    and errors, with the predicted error over the actual one.

    Args:
        loop: The loop.
        context: The initial context of its diagram, which is not changed; the default one if None.
        file: The path of the page.
        config: Drake's settings, of which the fixed steps apply; with error control, or for None,
            steps of at most 1 ms by `runge_kutta5`.
        title: The title; the robot's name if empty.
        notes: Sentences that the page shows, for example which changes are not possible.

    Returns:
        The path of the page.

    Raises:
        ModelError: The plant is not a robot, or the loop cannot be traced, with the reason.
        MachineCodeError: zig is not installed (`pip install ziglang` adds it), or it fails.
        OSError: A file cannot be written.
    """
    if find_spec("ziglang") is None:
        raise MachineCodeError(
            "a page is compiled to WebAssembly by zig, which is not installed: pip install ziglang"
        )
    bench, file = Bench(loop, context), Path(file)
    with tempfile.TemporaryDirectory() as folder:
        start = bench.context.get_time()
        _, source = write_loop(bench.code, start, "page", folder, config)
        source.write_text(in_pieces(source.read_text("utf-8")), "utf-8")
        target = source.with_suffix(".wasm")
        compile_webassembly(source, target)
        code = base64.b64encode(target.read_bytes()).decode()
    data = bench.data() | {"title": title or loop.plant.dae.name, "notes": list(notes)}
    page = meshcat_page(bench.robot, bench.state, loop.scene_graph)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(_page_of(page, data, code), encoding="utf-8")
    return file


def _page_of(page: str, data: Mapping[str, Any], code: str) -> str:
    """Meshcat's page with the bench over it."""
    texts = (WEB / name for name in SCRIPTS)
    scripts = "\n".join(
        [f"const data = {as_script(data)};", f'const code = "{code}";']
        + [text.read_text("utf-8") for text in texts]
    )
    style, body = ((WEB / f"bench.{end}").read_text("utf-8") for end in ("css", "html"))
    added = f'<style>\n{style}</style>\n{body}<script type="module">\n{scripts}</script>\n'
    head = (
        f'<meta http-equiv="Content-Security-Policy" content="{_CONTENT_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(data['title'])}</title>"
    )
    before, mark, after = page.rpartition("</body>")
    before = before.replace("<title>Drake MeshCat</title>", head, 1)
    return before.replace("<html>", '<html lang="en">', 1) + added + mark + after


def as_script(data: Any) -> str:
    """Data as JSON for a script element, escaped so that no text in it ends the script."""
    try:
        text = json.dumps(data, allow_nan=False)
    except ValueError:
        raise ModelError("a page needs finite numbers") from None
    return text.replace("<", "\\u003c")


class Bench:
    """What a page shows and changes of a loop, from a context on; `size` is the scene's in m."""

    def __init__(self, loop: ClosedLoop, context: Context | None) -> None:
        """Of a loop, whose free inputs are 0 where they have no value."""
        diagram, plant, law = loop.diagram, loop.plant, loop.controller.law
        context = (context or diagram.CreateDefaultContext()).Clone()
        for port in map(diagram.get_input_port, range(diagram.num_input_ports())):
            if port.get_data_type() == PortDataType.kVectorValued and not port.HasValue(context):
                port.FixValue(context, np.zeros(port.size()))
        self.robot = robot = RobotScene(plant, loop.scene_graph)
        names = "state", "constraint_force", "integral", "exogenous", "known_exogenous", *SHOWN
        ports = {name: diagram.GetOutputPort(name) for name in names if diagram.HasOutputPort(name)}
        composed = compose(diagram, ports, context=context, shares=False)
        check_traced(composed, "the loop")
        values = composed.block.outputs

        def parameters_of(system: Any, dae: DaeSystem, exogenous: str) -> ca.SX:
            """Its parameters, with the present values of exogenous signals."""
            count, place = dae.parameter_symbol.numel(), composed.parameters.get(system)
            own = ca.SX(dae.parameter_values)
            if place is not None:
                own = ca.SX(composed.block.parameters[place.start : place.start + count, 0])
            if exogenous in values:
                own[list(system.exogenous_places)] = values[exogenous]
            return own

        state, force = values["state"], values["constraint_force"]
        scene = robot.columns(state, force, parameters_of(plant, plant.dae, "exogenous"))
        outputs = {name: values[name] for name in SHOWN if name in values} | {"scene": scene}
        self.predicted = prediction(loop, composed.parameters.get(loop.controller))
        if self.predicted is not None:
            outputs["coordinates"] = law.coordinates_function.function(
                state,
                values["reference"],
                values.get("integral", ca.SX(0, 1)),
                parameters_of(loop.controller, law.system, "known_exogenous"),
            )[0]
        composed = replace(composed, block=replace(composed.block, outputs=outputs))
        self.loop, self.context = loop, context
        self.code = code = BlockCode(composed, context, {}, loop.signals)
        self.numbers = Numbers(code.parameters, code.values, composed.parameters, code.places)
        self.state = plant.state(plant.GetMyContextFromRoot(context))
        corners = scene_points(robot.model, robot.wrenches, self.state[None], loop.scene_graph)
        self.size = float(np.linalg.norm(np.ptp(corners, axis=0)))
        self.controls = controls_of(loop, self.numbers, context.get_time(), self.size)

    def data(self) -> dict[str, Any]:
        """What the browser knows, as JSON represents it."""
        loop, numbers, law = self.loop, self.numbers, self.loop.controller.law
        sliders = {(control.kind, control.label): i for i, control in enumerate(self.controls)}
        ends = np.cumsum([0, *map(len, self.code.outputs.values())]).tolist()
        first = dict(zip(self.code.outputs, ends, strict=False))
        signals, places = loop.plant.dae.output_signals, law.layout.lowest.tolist()
        if "reference" in first:
            r = [first["reference"] + k for k in places]
        else:  # A task desires distances, too, while its contact is open.
            r = [first["desired_output"] + k for k in range(len(signals))]
        slowest = float(np.min(-law.gains.poles.real)) if law.gains.poles.size else USUAL_POLE
        # The state of a plant that steps is shown just before a step, where it is that of the time.
        step = loop.plant.time_step
        tick = step * max(round(TICK / step), 1) if step else TICK
        pushes = pushes_of(loop.plant, numbers)
        rate = PUSHED_FRACTION * self.size * slowest**2
        strongest = strongest_pushes(loop.plant, self.state, list(pushes), rate)
        return {
            **self.robot.data(self.state, lambda *which: sliders.get(which)),
            "start": self.context.get_time(),
            "tick": tick,
            "early": 1e-6 * step,
            "size": self.size,
            "outputs": [asdict(signal) for signal in signals],
            "places": {
                "z": [first["controlled_output"] + i for i in range(len(signals))],
                "r": r,
                "scene": first["scene"],
                "coordinates": first.get("coordinates", ends[-1]),
                "phase": first["change"] + 1 if "change" in first else -1,
                "end": ends[-1],
            },
            "controls": [asdict(control) for control in self.controls],
            # A payload of the plant alone is not drawn.
            "pushes": {
                name: {"input": place, "most": strongest[name]}
                for name, place in pushes.items()
                if name in strongest
            },
            "prediction": self.predicted,
            "phase_names": list(loop.controller.phase_names),
            "inputs": numbers.values.tolist(),
        }


class RobotScene:
    """The drawn parts of a robot: bodies, `surfaces` that move, `targets`: outputs of points."""

    def __init__(self, plant: Plant, scene_graph: SceneGraph | None) -> None:
        model, self.plant = plant.robot("a page"), plant
        self.model = model
        self.bodies, self.wrenches = _drawn_bodies(model, scene_graph), ConstraintWrenches(model)
        self.surfaces = list[Constraint]()
        for each in model.constraints:
            # In a compliant contact their parameters move them, too.
            names = {p.name for p in each.parameters if p.exogenous or not plant.is_ideal}
            if names & {f"{each.name}.position", f"{each.name}.rpy"}:
                self.surfaces.append(each)
        self.targets = [each for each in model.outputs if isinstance(each, PointCoordinates)]

    def columns(self, state: ca.SX, force: ca.SX, parameters: ca.SX) -> ca.SX:
        """Poses of bodies, R by columns and p; wrenches; poses of surfaces; targets: one column."""
        model, links = self.model, self.model.links
        symbols = [ca.vertcat(links.q, links.v), ca.SX.sym("force", model.dae.num_constraints)]
        symbols.append(model.dae.parameter_symbol)
        loads = self.wrenches.function.function.call([links.q, links.v, *symbols[1:]])[:3]
        surfaces = list[ca.SX]()
        for constraint in self.surfaces:
            named = {parameter.name: parameter.symbol for parameter in constraint.parameters}
            rpy = named.get(f"{constraint.name}.rpy")
            surfaces.append(ca.SX.eye(3) if rpy is None else rotation_of(rpy))
            surfaces.append(named[f"{constraint.name}.position"])
        poses = [p for _, _, f in self.bodies for p in (links.rotation(f), links.position(f))]
        points = [links.position(target.frame, target.point) for target in self.targets]
        parts = [ca.vec(ca.densify(part)) for part in (*poses, *loads, *surfaces, *points)]
        function = ca.Function("scene", symbols, ca.cse([stacked(parts)]))
        return function(state[: symbols[0].numel()], force, parameters)

    def data(self, state: FloatArray, slider: Callable[[str, str], int | None]) -> dict[str, Any]:
        """What the browser knows of these parts; `slider` gives the index of a slider."""
        model, acting = self.model, list(self.wrenches.constraints)
        normals = surface_normals(model, self.wrenches, state, model.dae.parameter_values)
        names = [signal.name for signal in self.plant.dae.output_signals]
        constraints = [
            {
                "name": constraint.name,
                "force": _path(constraint, "force"),
                "moment": _path(constraint, "moment") if has_moment else None,
            }
            for constraint, has_moment in zip(acting, self.wrenches.with_moment, strict=True)
        ]
        surfaces = []
        for surface in self.surfaces:
            position = next(p for p in surface.parameters if p.name == f"{surface.name}.position")
            normal = normals[acting.index(surface)] if surface in acting else np.zeros(3)
            surfaces.append(
                {
                    "name": surface.name,
                    "path": _path(surface, "surface"),
                    "controls": [slider("surface", s.name) for s in position.signals],
                    "direction": normal.tolist() if normal.any() else None,
                }
            )
        targets = []
        for target in self.targets:
            signals = zip(target.axes, target.signals(model.links), strict=True)
            axes = [("xyz".index(axis), signal.name) for axis, signal in signals]
            commanded = [(axis, slider("reference", name)) for axis, name in axes]
            targets.append(
                {
                    "name": target.name or target.frame,
                    "axes": [[axis, place] for axis, place in commanded if place is not None],
                    "outputs": [[axis, names.index(name)] for axis, name in axes],
                }
            )
        return {
            "bodies": [{"name": name, "path": path} for name, path, _ in self.bodies],
            "constraints": constraints,
            "surfaces": surfaces,
            "targets": targets,
        }


def meshcat_page(robot: RobotScene, state: FloatArray, scene_graph: SceneGraph | None) -> str:
    """Meshcat's page at the start, self-contained."""
    meshcat = start_unwatched_meshcat()
    meshcat.SetProperty("/Background", "visible", True)
    for part in ("top_color", "bottom_color"):
        meshcat.SetProperty("/Background/<object>", part, _BACKGROUND)
    draw_scene(robot.plant, meshcat, scene_graph)
    links = view_of_links(robot.plant, scene_graph, meshcat)
    if links is not None:
        context, port = links.CreateDefaultContext(), links.get_input_port()
        port.FixValue(context, state[: port.size()])
        links.ForcedPublish(context)
    return str(meshcat.StaticHtml())


def _drawn_bodies(
    model: RobotModel, scene_graph: SceneGraph | None
) -> list[tuple[str, tuple[str, ...], Frame]]:
    """Name, path in Meshcat and frame of each moving body with geometry."""
    plant = model.links.plant
    if scene_graph is None or plant is None or plant.get_source_id() is None:
        return []
    inspector, bodies = scene_graph.model_inspector(), []
    for frame in inspector.GetAllFrameIds():
        body = plant.GetBodyFromFrameId(frame)
        if body is None or plant.IsAnchored(body) or not plant.GetVisualGeometriesForBody(body):
            continue
        path = ("drake", "visualizer", *inspector.GetName(frame).split("::"))
        bodies.append((body.scoped_name().get_full(), path, body.body_frame()))
    return bodies


def _path(constraint: Constraint, part: str) -> list[str]:
    """The path in Meshcat of a constraint's "force", "moment" or "surface"."""
    return path_of(constraint, part).strip("/").split("/")


# ------------------------------------------------------------------ long functions in pieces

# The largest number of assignments in a function. For 60,000 assignments, clang needs 180 s of CPU
# in one function, and seconds in pieces of 2,000.
LONGEST = 2000

_NAME = re.compile(r"\ba0*(\d+)\b")
_FUNCTION = re.compile(
    r"(?P<head>static int (?P<name>casadi_f\d+)\([^\n]*\{)\n(?P<body>(?:  [^\n]*\n)*)\}"
)
_DECLARATION = "  casadi_real a"
_ARGUMENTS = (
    "const casadi_real** arg, casadi_real** res, casadi_int* iw, casadi_real* w, casadi_real* a"
)


def in_pieces(source: str, longest: int = LONGEST) -> str:
    """Splits long functions of C into pieces, for which all variables are entries of one array."""
    return _FUNCTION.sub(lambda function: _split(function, longest), source)


def _split(function: re.Match[str], longest: int) -> str:
    rows = [
        row
        for row in function["body"].splitlines()
        if not row.startswith(_DECLARATION) and row.strip() != "return 0;"
    ]
    if len(rows) <= longest:
        return function[0]
    size = 1 + max(map(int, _NAME.findall(function["body"])))
    name, text, calls = function["name"], "", f"  casadi_real a[{size}];\n"
    for k, i in enumerate(range(0, len(rows), longest)):
        piece = (_NAME.sub(r"a[\1]", row) for row in rows[i : i + longest])
        head = f"static int __attribute__((noinline)) {name}_{k}({_ARGUMENTS}) {{"
        text += "\n".join([head, *piece, "  return 0;", "}", "", ""])
        calls += f"  if ({name}_{k}(arg, res, iw, w, a)) return 1;\n"
    return f"{text}{function['head']}\n{calls}  return 0;\n}}"
