"""`drake-dae page` and `export`: a loop as one HTML file, and as C99."""

import argparse
from pathlib import Path

from drake_dae.commands.folder import open_page
from drake_dae.commands.parser import Parser, waiting
from drake_dae.errors import ModelError
from drake_dae.files import check_folder, check_unwritten, complete
from drake_dae.pictures.page.page import write_page
from drake_dae.running.export.controller import export_controller
from drake_dae.running.export.loop import export_loop
from drake_dae.scenario.build import build_scenario
from drake_dae.scenario.commanded import build_commanded
from drake_dae.scenario.scenario import load_scenario
from drake_dae.scenario.shipped import DEFAULT_SCENARIO, find_scenario

LONGEST = 2.0
"""The longest run to which exported code is compared, in s."""


def _page_options(parser: Parser) -> None:
    parser.scenario(DEFAULT_SCENARIO)
    parser.out("FILE", "the page (default: <scenario>.html)")
    parser.flag("--open", "open the page in a browser")


def _page(options: argparse.Namespace) -> int:
    """Writes a scenario as one HTML file in which it runs, without server and network.

    There are sliders, a target and surfaces that are dragged, links that are pushed, and plots of
    force and error with the prediction. It needs zig: pip install ziglang.
    """
    path = find_scenario(options.scenario)
    scenario = load_scenario(path, options.settings)
    file = options.out or Path(f"{path.stem}.html")
    check_unwritten([file], options.force)
    print(f"compiling {path.stem} for a page; the first page on a machine takes longer", flush=True)
    with waiting(f"compiling {path.stem}"):
        built = build_commanded(scenario)
        title, notes = scenario.description or path.stem, built.left_out
        try:
            write_page(built.loop, built.context, file, None, title, notes)
        except ModelError as error:
            raise ModelError(f"{path.stem} cannot be a page: {error}") from error
    told = f"written: {file} ({file.stat().st_size / 1e6:.2f} MB)"
    print(told, *(f"not in it: {note}" for note in notes), sep="\n")
    if options.open:
        open_page(file)
    return 0


def _export_options(parser: Parser) -> None:
    parser.scenario(DEFAULT_SCENARIO)
    parser.out("FOLDER", "folder for the files (default: <scenario>_c99)")


def _export(options: argparse.Namespace) -> int:
    """Writes a scenario as plain C99: the whole loop, and its sampled controller as one step.

    There are no dependencies; sizes, names and units stand in the code. `make` in the folder
    compiles programs that compare with runs of Drake's Simulator.
    """
    path = find_scenario(options.scenario)
    folder = options.out or Path(f"{path.stem}_c99")
    check_folder(folder)
    scenario, files, missing = load_scenario(path, options.settings), list[Path](), list[str]()
    with waiting(f"exporting {path.stem}"), complete(folder) as place:
        made = *build_scenario(scenario), path.stem, place
        for what, export in {"controller": export_controller, "loop": export_loop}.items():
            try:
                files += export(*made, scenario.integrator, min(scenario.duration, LONGEST))
            except ModelError as error:
                missing.append(f"the {what}: {error}")
        if not files:
            raise ModelError(f"{path.stem} cannot be exported; {'; '.join(missing)}")
        names = list(dict.fromkeys(file.name for file in files))
        check_unwritten((folder / name for name in names), options.force)
    print(f"written to {folder}/: {', '.join(names)}")
    for reason in missing:
        print(f"not among them: {reason}")
    return 0


COMMANDS = {"page": (_page_options, _page), "export": (_export_options, _export)}
