"""`drake-dae export`: writes controller, plant and loop as C99 or WebAssembly."""

import argparse
import json
from pathlib import Path

from pydrake.systems.framework import Context

from drake_dae.commands.run.folder import stage
from drake_dae.diagrams.closed_loop import ClosedLoop
from drake_dae.errors import ModelError
from drake_dae.files import check_folder, check_unwritten
from drake_dae.running.export.export import export_code
from drake_dae.running.export.parts import parts_of
from drake_dae.running.export.steps.controller import export_controller
from drake_dae.running.export.steps.parts import Export
from drake_dae.scenario.build import build_scenario
from drake_dae.scenario.files import load_scenario
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.shipped import find_scenario


def run_command(options: argparse.Namespace) -> int:
    """Writes the code of the scenario that the options name; returns the exit code."""
    path = find_scenario(options.scenario)
    folder = options.out or Path(
        f"{path.stem}_{'c99' if options.format == 'c' else options.format}"
    )
    check_folder(folder)
    scenario = load_scenario(path, options.settings)
    loop, context = build_scenario(scenario)
    folder.mkdir(parents=True, exist_ok=True)
    with stage(folder) as temporary:
        files, missing = WRITERS[options.format](scenario, loop, context, path.stem, temporary)
        names = list(dict.fromkeys(file.name for file in files))
        check_unwritten((folder / name for name in names), options.force)
    if options.json:
        print(json.dumps({"folder": str(folder), "files": names, "left_out": missing}, indent=2))
        return 0
    print(f"written to {folder}/: {', '.join(names)}")
    if options.format == "wasm":
        print(f"{names[0]} has {(folder / names[0]).stat().st_size / 1000:.0f} kB")
    if missing:
        print(f"not among them: {'; '.join(missing)}")
    return 0


def _write_c(
    scenario: Scenario, loop: ClosedLoop, context: Context, name: str, folder: Path
) -> Export:
    run = scenario.integrator, scenario.duration
    if scenario.task is not None:
        files = export_controller(loop, context, name, folder, *run)
        return Export(files, ["functions of law and plant: a task has two laws"])
    files, missing = export_code(loop, context, name, folder), _left_out(scenario, loop)
    try:
        files += export_controller(loop, context, name, folder, *run)
    except ModelError as error:
        missing.append(f"the whole controller as one step: {error}")
    return Export(files, missing)


def _write_wasm(
    scenario: Scenario, loop: ClosedLoop, context: Context, name: str, folder: Path
) -> Export:
    from drake_dae.running.export.wasm.wasm import export_wasm

    return export_wasm(loop, context, name, folder, scenario.integrator)


def _left_out(scenario: Scenario, loop: ClosedLoop) -> list[str]:
    """The parts of the scenario that the exported functions lack; none if the loop is exported."""
    if parts_of(loop).compiled is not None:
        return []
    closed = "the functions have the plant with all contacts closed"
    parts = {
        "the limits of the drives, except in the controller": scenario.saturation,
        f"Drake's own contact: {closed}, and ideal": not loop.plant.is_ideal,
    }
    return [text for text, is_run in parts.items() if is_run]


WRITERS = {"c": _write_c, "wasm": _write_wasm}
"""Format -> the function that writes it."""
