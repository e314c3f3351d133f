"""A controller and its plant as FMUs (FMI 3.0, co-simulation)."""

import platform
import tempfile
import uuid
import zipfile
from pathlib import Path
from string import Template

from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram

from drake_dae.arguments import checked
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import MachineCodeError, ModelError
from drake_dae.running.export.fmu.description import groups_of, model_description, ranges
from drake_dae.running.export.steps.controller import COMMON, write_controller
from drake_dae.running.export.steps.integrated import write_integrated
from drake_dae.running.export.steps.parts import (
    CONTROLLER,
    PLANT,
    Export,
    WrittenPart,
    parts_of_loop,
)
from drake_dae.running.export.steps.words import common_words, file_of, prefix_of
from drake_dae.running.export.text import written
from drake_dae.trace.compiler import find_compiler

TEMPLATES = Path(__file__).parent / "c99"

LEVEL, PATIENCE = "-O1", 600.0
"""The optimization level of the binary, and the longest time to compile it, in s."""

ABOUT = {
    PLANT: "A plant with its sensors, in fixed steps. Its outputs do not follow its inputs before "
    "the next step.",
    CONTROLLER: "A controller with its references. At each time it steps before the plant, whose "
    "step then takes its control.",
}


@checked(ModelError)
def export_fmu(
    loop: ClosedLoop | Diagram,
    context: Context,
    name: str,
    folder: str | Path,
    config: SimulatorConfig | None = None,
) -> Export:
    """Writes name_controller.fmu and name_plant.fmu, for co-simulation by FMI 3.0.

    The FMUs contain names, units and start values of all variables, sources in C99, and a binary
    for this machine. The controller's inputs have the names of the plant's outputs. A part that
    cannot be exported is left out; without a C compiler, the binaries are left out.

    Args:
        loop: The closed loop, or any diagram with one `Plant`.
        context: Its context at the start; not changed.
        name: The name of the files.
        folder: The folder to write to; created if it does not exist.
        config: Drake's settings with the fixed steps of the plant. If they have error control, or
            for None, the steps are at most 1 ms by `runge_kutta5`.

    Raises:
        ModelError: No part can be exported, or the fixed steps are of an implicit method.
        OSError: A file cannot be written.
    """
    parts, left_out = parts_of_loop(loop, context, (CONTROLLER, PLANT))
    files, folder = [], Path(folder)
    for kind, part in parts.items():
        with tempfile.TemporaryDirectory() as temporary:
            content = Path(temporary)
            sources = content / "sources"
            if kind == CONTROLLER:
                source = write_controller(part, context, name, sources)
            else:
                source = write_integrated(part, kind, context, name, sources, config)
            _write_fmu(source, name, content)
            try:
                _compile(source, name, content)
            except MachineCodeError as error:
                left_out.append(f"a binary of the {kind}, of which there are sources: {error}")
            folder.mkdir(parents=True, exist_ok=True)
            files.append(_packed(content, folder / f"{file_of(name)}_{kind}.fmu"))
    return Export(files, left_out)


def _write_fmu(part: WrittenPart, name: str, content: Path) -> None:
    """Writes fmi3.c, both descriptions and the license."""
    kind, groups = part.kind, groups_of(part)
    identifier = f"{prefix_of(name)}_{kind}"
    text = part.files[1].read_text(encoding="utf-8")
    token = str(uuid.uuid5(uuid.NAMESPACE_OID, f"{groups}{text}"))
    words = common_words(name) | {
        "kind": kind,
        "token": token,
        "floats": ranges(groups, "Float64"),
        "integers": ranges(groups, "Int32"),
        "options": "-ffp-contract=off",
        "identifier": identifier,
    }
    for key, template in (("own", f"{kind}.c"), ("functions", f"{kind}_functions.c")):
        template_text = Template((TEMPLATES / template).read_text(encoding="utf-8"))
        words[key] = template_text.substitute(words)
    written(TEMPLATES, content / "sources", {"fmi3.c": _glue(name, kind)}, words)
    names = {"buildDescription.xml": "buildDescription.xml"}
    words["source"] = part.files[1].name
    words["glue"] = _glue(name, kind)
    written(TEMPLATES, content / "sources", names, words)
    terms = content / "documentation" / "licenses"
    written(COMMON, terms, {"LICENSE.txt": "license.txt"}, words)
    step = part.longest or part.part.ticks.period
    about = model_description(groups, f"{name}_{kind}", identifier, token, step, ABOUT[kind])
    (content / "modelDescription.xml").write_text(about, encoding="utf-8")


def _compile(part: WrittenPart, name: str, content: Path) -> None:
    """Compiles the binary for this machine.

    Raises:
        MachineCodeError: There is no compiler, or it fails.
    """
    system = {"Linux": "linux", "Darwin": "darwin", "Windows": "windows"}.get(platform.system())
    machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
    suffix = {"linux": ".so", "darwin": ".dylib", "windows": ".dll"}.get(system or "")
    if suffix is None:
        raise MachineCodeError(f"FMI has no name for binaries of {platform.system()}")
    folder = content / "binaries" / f"{machine}-{system}"
    folder.mkdir(parents=True)
    sources = [part.files[1], content / "sources" / _glue(name, part.kind)]
    library = folder / f"{prefix_of(name)}_{part.kind}{suffix}"
    find_compiler().link(sources, library, LEVEL, PATIENCE)


def _packed(content: Path, target: Path) -> Path:
    """Packs a folder into a zip file; equal files give equal bytes."""
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(path for path in content.rglob("*") if path.is_file()):
            entry = zipfile.ZipInfo(path.relative_to(content).as_posix())
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, path.read_bytes())
    return target


def _glue(name: str, kind: str) -> str:
    return f"{file_of(name)}_{kind}_fmi3.c"
