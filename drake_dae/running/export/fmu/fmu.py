"""A controller and its plant as FMUs (FMI 3.0, co-simulation)."""

import platform
import tempfile
import uuid
import zipfile
from importlib.metadata import version
from pathlib import Path
from string import Template

import casadi as ca
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
from drake_dae.running.export.steps.words import file_of, prefix_of
from drake_dae.running.export.text import comment, written
from drake_dae.trace.compiler import find_compiler

TEMPLATES = Path(__file__).parent / "c99"

LEVEL, PATIENCE = "-O1", 600.0
"""How the binary is compiled, and how long at most, in s."""

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

    They have names, units and start values of all variables, their sources in C99, and a binary for
    this machine. Outputs of the plant have the names of the controller's inputs. A part that cannot
    be exported is left out, and without a C compiler the binary.

    Args:
        loop: The closed loop, or any diagram with one `Plant`.
        context: Its context at the start; not changed.
        name: What the files are called.
        folder: Where to write; made if there is none.
        config: Drake's settings, whose fixed steps the plant takes; where they have error control,
            and for None, steps of at most 1 ms by `runge_kutta5`.

    Raises:
        ModelError: No part can be exported, or the fixed steps are of an implicit method.
        OSError: A file cannot be written.
    """
    parts, left_out = parts_of_loop(loop, context, (CONTROLLER, PLANT))
    files, folder = [], Path(folder)
    for kind, part in parts.items():
        with tempfile.TemporaryDirectory() as place:
            sources = Path(place) / "sources"
            if kind == CONTROLLER:
                found = write_controller(part, context, name, sources)
            else:
                found = write_integrated(part, kind, context, name, sources, config)
            _write_fmu(found, name, Path(place))
            try:
                _compile(found, name, Path(place))
            except MachineCodeError as error:
                left_out.append(f"a binary of the {kind}, of which there are sources: {error}")
            folder.mkdir(parents=True, exist_ok=True)
            files.append(_packed(Path(place), folder / f"{file_of(name)}_{kind}.fmu"))
    return Export(files, left_out)


def _write_fmu(found: WrittenPart, name: str, place: Path) -> None:
    """Writes the glue, both descriptions and the terms."""
    prefix, file, kind = prefix_of(name), file_of(name), found.kind
    groups, identifier = groups_of(found), f"{prefix}_{found.kind}"
    text = found.files[1].read_text(encoding="utf-8")
    token = str(uuid.uuid5(uuid.NAMESPACE_OID, f"{groups}{text}"))
    words = {
        "title": comment(name),
        "name": file,
        "kind": kind,
        "version": version("drake_dae"),
        "casadi": ca.__version__,
        "prefix": prefix,
        "guard": prefix.upper(),
        "token": token,
        "floats": ranges(groups, "Float64"),
        "integers": ranges(groups, "Int32"),
        "options": "-ffp-contract=off",
        "identifier": identifier,
    }
    for key, template in (("own", f"{kind}.c"), ("functions", f"{kind}_functions.c")):
        given = Template((TEMPLATES / template).read_text(encoding="utf-8"))
        words[key] = given.substitute(words)
    written(TEMPLATES, place / "sources", {"fmi3.c": _glue(name, kind)}, words)
    names = {"buildDescription.xml": "buildDescription.xml"}
    words["source"] = found.files[1].name
    words["glue"] = _glue(name, kind)
    written(TEMPLATES, place / "sources", names, words)
    terms = place / "documentation" / "licenses"
    written(COMMON, terms, {"LICENSE.txt": "license.txt"}, words)
    step = found.longest or found.part.ticks.period
    about = model_description(groups, f"{name}_{kind}", identifier, token, step, ABOUT[kind])
    (place / "modelDescription.xml").write_text(about, encoding="utf-8")


def _compile(found: WrittenPart, name: str, place: Path) -> None:
    """Makes the binary for this machine.

    Raises:
        MachineCodeError: There is no compiler, or it fails.
    """
    system = {"Linux": "linux", "Darwin": "darwin", "Windows": "windows"}.get(platform.system())
    machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
    suffix = {"linux": ".so", "darwin": ".dylib", "windows": ".dll"}.get(system or "")
    if suffix is None:
        raise MachineCodeError(f"FMI has no name for binaries of {platform.system()}")
    folder = place / "binaries" / f"{machine}-{system}"
    folder.mkdir(parents=True)
    sources = [found.files[1], place / "sources" / _glue(name, found.kind)]
    library = folder / f"{prefix_of(name)}_{found.kind}{suffix}"
    find_compiler().link(sources, library, LEVEL, PATIENCE)


def _packed(place: Path, target: Path) -> Path:
    """All files of a folder as a zip file, to the bit the same for the same files."""
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(path for path in place.rglob("*") if path.is_file()):
            entry = zipfile.ZipInfo(path.relative_to(place).as_posix())
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, path.read_bytes())
    return target


def _glue(name: str, kind: str) -> str:
    return f"{file_of(name)}_{kind}_fmi3.c"
