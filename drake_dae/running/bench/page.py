"""A loop as one HTML file, in which it runs as WebAssembly."""

import base64
import html
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import casadi as ca
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.compiler.wires import leaf_inputs
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.running.bench.any_diagram import parts_of_diagram
from drake_dae.running.bench.description import Bench, as_script, bench_of, shown_function
from drake_dae.running.bench.inputs import started
from drake_dae.running.export.steps.boundary import ExportedPart, diagram_part, loop_part
from drake_dae.running.export.steps.integrated import write_integrated
from drake_dae.running.export.steps.parts import LOOP
from drake_dae.running.export.steps.words import identifiers
from drake_dae.running.export.wasm.wasm import write_module
from drake_dae.systems.blocks.traced import Traced

WEB = Path(__file__).with_name("web")

SCRIPTS = ("prediction.js", "view.js", "drag.js", "plots.js", "panel.js", "bench.js")
"""The scripts of the bench, in their order."""

_BEGIN, _END = '<script type="text/javascript">', "</script>"
"""Around the bundle in Meshcat's page."""

_FROM_ELSEWHERE = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' data: blob: "
    "'self' file:; style-src 'unsafe-inline'; img-src data: blob:; worker-src data: blob:; "
    "connect-src data: blob: {own}"
)
"""What a browser may load: nothing from outside."""


@checked(ModelError)
def write_page(
    loop: ClosedLoop | Diagram,
    context: Context | None,
    file: str | Path,
    config: SimulatorConfig | None = None,
    title: str = "",
    notes: Sequence[str] = (),
    shared_bundle: str | Path | None = None,
) -> list[Path]:
    """Writes a loop of a robot as one HTML file in which it runs, without server and network.

    Plant, law and references are WebAssembly, see `export_wasm`, and run in real time; the robot is
    drawn by the bundle of Drake's Meshcat. Links are pushed with the pointer. Numeric parameters of
    the blocks are sliders: masses and friction of the plant, poles; in a loop with
    `LoopSettings.commands` references, speed along the path, and exogenous surfaces, too. Forces
    and errors are plotted, with the predicted error over the actual one.

    Of any other diagram the output ports are plotted, the robots in it are drawn, and numeric
    parameters of its blocks and values of free input ports are sliders. A diagram without a robot
    has plots and sliders.

    Args:
        loop: The loop, or any diagram that can be compiled; see `compile_diagram`.
        context: The context of its diagram at the start, not changed; the default context if None.
        file: Where to write.
        config: Drake's settings, whose fixed steps it takes, as `export_wasm` does; for None,
            steps of at most 1 ms by `runge_kutta5`.
        title: The title; the robot's name if empty.
        notes: Sentences that the page shows, such as what cannot be changed.
        shared_bundle: Where to write Meshcat's bundle of 2.2 MB, for several pages; None to have it
            in the page. The page finds it relative to itself.

    Returns:
        The files that were written.

    Raises:
        ModelError: The plant of a loop is no robot, or the loop or diagram cannot be exported: why.
        MachineCodeError: There is no zig, as of `pip install 'drake_dae[compiler]'`, or it fails.
        OSError: A file cannot be written.
    """
    target, bundle = Path(file), list[Path]()
    page = page_text(loop, context, config, title, notes)
    if shared_bundle is not None:
        bundle = [Path(shared_bundle)]
        page = _with_shared_bundle(page, target, bundle[0])
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(page, encoding="utf-8")
    return [target, *bundle]


def page_text(
    loop: ClosedLoop | Diagram,
    context: Context | None,
    config: SimulatorConfig | None = None,
    title: str = "",
    notes: Sequence[str] = (),
) -> str:
    """The page of a loop or diagram as text; arguments and errors are those of `write_page`."""
    diagram = loop if isinstance(loop, Diagram) else loop.diagram
    context = diagram.CreateDefaultContext() if context is None else context
    if isinstance(loop, Diagram):
        context = started(loop, context)
        ports = parts_of_diagram(loop, context).ports
        part = diagram_part(loop, context, ports)
    else:
        if isinstance(loop.plant, Traced) and loop.plant.traced().stepped is not None:
            raise ModelError("the plant has Drake's own contact, which no export knows")
        further = ["known_exogenous"] if loop.exogenous is not None else []
        part = loop_part(loop, context, further)
    bench = bench_of(loop, context, title or title_of(loop), notes)
    with tempfile.TemporaryDirectory() as folder:
        written = write_integrated(part, LOOP, context, "page", folder, config)
        module, loader, _ = write_module([written], "page", folder, {"shown": _shown(bench, part)})
        code, text = module.read_bytes(), loader.read_text(encoding="utf-8")
    words = zip(identifiers(part.outputs), filter(part.outputs.get, part.outputs), strict=True)
    word_of = {name: word for word, name in words}
    data = bench.data | {"kind": "page", "places": _places(bench, part)}
    data["plotted"] = [word_of[name] for name in bench.outputs]
    encoded = base64.b64encode(code).decode()
    parts = [text, f'const wasm = "{encoded}";', web_text("page.js")]
    return page_of(bench, data, parts)


def title_of(loop: ClosedLoop | Diagram) -> str:
    """The name of the robot of a loop, or that of a diagram."""
    if not isinstance(loop, Diagram):
        return loop.plant.dae.name
    return "diagram" if "@" in loop.get_name() else loop.get_name() or "diagram"


def page_of(bench: Bench, data: object, engine: Sequence[str], own: str = "") -> str:
    """Meshcat's page with the bench over it.

    Args:
        bench: The bench.
        data: What its script gets.
        engine: The scripts before that of the bench, which define `makeEngine`.
        own: What the page may connect to, as in a Content-Security-Policy.
    """
    script = "\n".join([f"const data = {as_script(data)};", *engine, *map(web_text, SCRIPTS)])
    added = f"<style>\n{web_text('bench.css')}</style>\n{web_text('bench.html')}"
    added += f'<script type="module">\n{script}</script>\n'
    head = (
        f'<meta http-equiv="Content-Security-Policy" content="{_FROM_ELSEWHERE.format(own=own)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(bench.data['title'])}</title>"
    )
    before, mark, after = bench.scene.page.rpartition("</body>")
    return before.replace("<title>Drake MeshCat</title>", head, 1) + added + mark + after


def web_text(name: str) -> str:
    """A file of the bench in a browser."""
    return (WEB / name).read_text("utf-8")


def _with_shared_bundle(page: str, target: Path, bundle: Path) -> str:
    """Takes the bundle out of a page and writes it as a file."""
    before, _, rest = page.partition(_BEGIN)
    code, _, after = rest.partition(_END)
    bundle.parent.mkdir(parents=True, exist_ok=True)
    bundle.write_text(code, encoding="utf-8")
    relative = os.path.relpath(bundle.resolve(), target.resolve().parent)
    address = html.escape(Path(relative).as_posix(), quote=True)
    return f'{before}<script src="{address}">{_END}{after}'


def _shown(bench: Bench, part: ExportedPart) -> ca.Function:
    """(all outputs, all parameters) of the exported loop -> what the bench shows."""
    sizes = {name: len(signals) for name, signals in part.outputs.items()}
    row = ca.SX.sym("row", sum(sizes.values()))
    parameters = ca.SX.sym("parameters", part.compiled.sizes["parameters"])
    columns, first = {}, 0
    for name, size in sizes.items():
        columns[name], first = row[first : first + size], first + size
    # What leads to no output of the part stays as it is.
    now = bench.controls.inputs.values(bench.context)
    places = zip(_places(bench, part), now.tolist(), strict=True)
    given = ca.vertcat(ca.SX(0, 1), *[parameters[at[0]] if at else x for at, x in places])
    value = ca.cse([ca.densify(shown_function(bench, columns, given))])
    return ca.Function("shown", [row, parameters], value)


def _places(bench: Bench, part: ExportedPart) -> list[list[int]]:
    """Where each of the inputs stands among the parameters of the part: none, one or several."""
    starts = {system: place.start for system, place in part.compiled.parameters}
    fixed = {
        (system, int(system.GetInputPort(name).get_index())): place.start
        for system, name, place in part.compiled.fixed
    }
    inputs, found = bench.controls.inputs, list[list[int]]()
    for block in inputs.blocks:
        own = block.GetMyContextFromRoot(bench.context).get_numeric_parameter(0).size()
        first = starts.get(block)
        found += [[] if first is None else [first + i] for i in range(own)]
    for port in inputs.ports:
        taken = leaf_inputs(port.get_system(), int(port.get_index()))
        firsts = [fixed[leaf] for leaf in taken if leaf in fixed]
        found += [[first + i for first in firsts] for i in range(port.size())]
    return found + [[]] * (len(inputs.names) - len(found))
