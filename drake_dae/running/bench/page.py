"""Writes a loop as one HTML file in which it runs as WebAssembly."""

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
from drake_dae.blocks.computations import Traced
from drake_dae.compiler.wires import leaf_inputs
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.files import check_unwritten
from drake_dae.running.bench.any_diagram import parts_of_diagram
from drake_dae.running.bench.description import Bench, as_script, bench_of, shown_function
from drake_dae.running.bench.inputs import with_input_values
from drake_dae.running.export.steps.boundary import ExportedPart, diagram_part, loop_part
from drake_dae.running.export.steps.integrated import write_integrated
from drake_dae.running.export.steps.parts import LOOP
from drake_dae.running.export.steps.words import identifiers
from drake_dae.running.export.wasm.wasm import write_module

WEB = Path(__file__).with_name("web")

SCRIPTS = ("page.js", "prediction.js", "view.js", "drag.js", "plots.js", "panel.js", "bench.js")
"""The scripts of the bench, in the order in which the page contains them."""

_BEGIN, _END = '<script type="text/javascript">', "</script>"
"""The tags around the bundle in Meshcat's page."""

_CONTENT_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' data: blob: "
    "'self' file:; style-src 'unsafe-inline'; img-src data: blob:; worker-src data: blob:; "
    "connect-src data: blob:"
)
"""The Content-Security-Policy of the page, which loads nothing from the network."""


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

    Plant, law and references run in real time as WebAssembly, see `export_wasm`. The page draws the
    robot by the bundle of Drake's Meshcat, and a person pushes its links with the pointer. Sliders
    change the masses and the friction of the plant, and the poles; in a loop with
    `LoopSettings.commanded` also the references and the positions of exogenous surfaces. Plots show
    forces and errors, with the predicted error over the actual one.

    The page of any other diagram plots its output ports and draws its robots. Sliders change the
    numeric parameters of its blocks and the values of its free input ports.

    Args:
        loop: The loop, or any diagram that can be compiled; see `compile_diagram`.
        context: The initial context of its diagram, which is not changed; the default context if
            None.
        file: The path of the page.
        config: Drake's settings, of which the fixed steps apply, as in `export_wasm`; for None,
            steps of at most 1 ms by `runge_kutta5`.
        title: The title; the robot's name if empty.
        notes: Sentences that the page shows, for example which changes are not possible.
        shared_bundle: The path of a separate file for Meshcat's bundle (2.2 MB), which several
            pages can share; if None, the page contains the bundle. The page refers to the file by
            a relative path. A file with other contents is not replaced.

    Returns:
        The paths of the written files.

    Raises:
        ModelError: The plant of a loop is not a robot, or the loop or diagram cannot be exported,
            with the reason.
        MachineCodeError: zig is not installed (`pip install 'drake_dae[compiler]'` adds it), or it
            fails.
        OSError: A file cannot be written.
    """
    files = [Path(file)]
    page = page_text(loop, context, config, title, notes)
    if shared_bundle is not None:
        files.append(Path(shared_bundle))
        page = _with_shared_bundle(page, *files)
    files[0].parent.mkdir(parents=True, exist_ok=True)
    files[0].write_text(page, encoding="utf-8")
    return files


def page_text(
    loop: ClosedLoop | Diagram,
    context: Context | None,
    config: SimulatorConfig | None = None,
    title: str = "",
    notes: Sequence[str] = (),
) -> str:
    """Returns the page of a loop or diagram as text; for arguments and errors see `write_page`."""
    diagram = loop if isinstance(loop, Diagram) else loop.diagram
    context = diagram.CreateDefaultContext() if context is None else context
    context = with_input_values(diagram, context)
    if isinstance(loop, Diagram):
        ports = parts_of_diagram(loop, context).ports
        part = diagram_part(loop, context, ports)
    else:
        if isinstance(loop.plant, Traced) and loop.plant.traced().stepped is not None:
            raise ModelError(
                "the plant has Drake's own contact, which cannot be exported: take a CompliantPlant"
            )
        names = [n for n in ("known_exogenous", "desired_output") if diagram.HasOutputPort(n)]
        part = loop_part(loop, context, [name for name in names if name not in loop.signals])
    bench = bench_of(loop, context, title or _title_of(loop), notes)
    with tempfile.TemporaryDirectory() as folder:
        written = write_integrated(part, LOOP, context, "page", folder, config)
        module, loader, _ = write_module([written], "page", folder, {"shown": _shown(bench, part)})
        code, loader_text = module.read_bytes(), loader.read_text(encoding="utf-8")
    nonempty = filter(part.outputs.get, part.outputs)
    identifier_of = dict(zip(nonempty, identifiers(part.outputs), strict=True))
    data = bench.data | {
        "places": _parameter_indices(bench, part),
        "plotted": [identifier_of[name] for name in bench.outputs],
    }
    encoded = base64.b64encode(code).decode()
    return _page_of(bench, data, [loader_text, f'const wasm = "{encoded}";'])


def _title_of(loop: ClosedLoop | Diagram) -> str:
    """Returns the name of the robot of a loop, or the name of a diagram."""
    if not isinstance(loop, Diagram):
        return loop.plant.dae.name
    return "diagram" if "@" in loop.get_name() else loop.get_name() or "diagram"


def _page_of(bench: Bench, data: object, engine: Sequence[str]) -> str:
    """Returns Meshcat's page with the bench over it.

    Args:
        bench: The bench.
        data: The data of the bench's script, in the form of JSON.
        engine: The scripts that define the loop and its loader.
    """
    script = "\n".join([f"const data = {as_script(data)};", *engine, *map(_web_text, SCRIPTS)])
    added = f"<style>\n{_web_text('bench.css')}</style>\n{_web_text('bench.html')}"
    added += f'<script type="module">\n{script}</script>\n'
    head = (
        f'<meta http-equiv="Content-Security-Policy" content="{_CONTENT_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(bench.data['title'])}</title>"
    )
    before, mark, after = bench.scene.page.rpartition("</body>")
    before = before.replace("<title>Drake MeshCat</title>", head, 1)
    return before.replace("<html>", '<html lang="en">', 1) + added + mark + after


def _web_text(name: str) -> str:
    """Returns the text of a file in the folder `web`."""
    return (WEB / name).read_text("utf-8")


def _with_shared_bundle(page: str, target: Path, bundle: Path) -> str:
    """Writes the bundle of a page as a file, and returns the page with a reference to it."""
    before, _, rest = page.partition(_BEGIN)
    code, _, after = rest.partition(_END)
    if not bundle.is_file() or bundle.read_bytes() != code.encode():
        check_unwritten([bundle], False)
        bundle.parent.mkdir(parents=True, exist_ok=True)
        bundle.write_bytes(code.encode())
    relative = os.path.relpath(bundle.resolve(), target.resolve().parent)
    address = html.escape(Path(relative).as_posix(), quote=True)
    return f'{before}<script src="{address}">{_END}{after}'


def _shown(bench: Bench, part: ExportedPart) -> ca.Function:
    """Returns `shown_function` as a function of all outputs and all parameters of the part."""
    sizes = {name: len(signals) for name, signals in part.outputs.items()}
    row = ca.SX.sym("row", sum(sizes.values()))
    parameters = ca.SX.sym("parameters", part.compiled.sizes["parameters"])
    columns, first = {}, 0
    for name, size in sizes.items():
        columns[name], first = row[first : first + size], first + size
    # Inputs that are no parameters of the part keep their values.
    values = bench.controls.inputs.values(bench.context).tolist()
    indices = zip(_parameter_indices(bench, part), values, strict=True)
    inputs = ca.vertcat(ca.SX(0, 1), *[parameters[at[0]] if at else x for at, x in indices])
    value = ca.cse([ca.densify(shown_function(bench, columns, inputs))])
    return ca.Function("shown", [row, parameters], value)


def _parameter_indices(bench: Bench, part: ExportedPart) -> list[list[int]]:
    """Returns, for each input, its indices among the parameters of the part: none, one or more."""
    starts = {system: entries.start for system, entries in part.compiled.parameters}
    fixed = {
        (system, int(system.GetInputPort(name).get_index())): entries.start
        for system, name, entries in part.compiled.fixed
    }
    inputs, indices = bench.controls.inputs, list[list[int]]()
    for block in inputs.blocks:
        size = block.GetMyContextFromRoot(bench.context).get_numeric_parameter(0).size()
        first = starts.get(block)
        indices += [[] if first is None else [first + i] for i in range(size)]
    for port in inputs.ports:
        leaves = leaf_inputs(port.get_system(), int(port.get_index()))
        firsts = [fixed[leaf] for leaf in leaves if leaf in fixed]
        indices += [[first + i for first in firsts] for i in range(port.size())]
    return indices + [[]] * (len(inputs.names) - len(indices))
