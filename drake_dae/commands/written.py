"""`drake-dae page` and `export`: a loop as one HTML file, and as C99."""

import argparse
from pathlib import Path

from drake_dae.commands.folder import open_page
from drake_dae.commands.parser import Parser, waiting
from drake_dae.errors import ModelError
from drake_dae.files import check_folder, check_unwritten, complete
from drake_dae.running.bench.page import write_page
from drake_dae.running.export.export import export_code
from drake_dae.running.export.steps.controller import export_controller
from drake_dae.scenario.build import build_scenario
from drake_dae.scenario.commanded import build_commanded
from drake_dae.scenario.scenario import load_scenario
from drake_dae.scenario.shipped import DEFAULT_SCENARIO, find_scenario


def _page_options(parser: Parser) -> None:
    parser.scenario(DEFAULT_SCENARIO)
    parser.out("FILE", "the page (default: <scenario>.html)")
    parser.flag("--open", "open the page in a browser")


def _page(options: argparse.Namespace) -> int:
    """Writes a scenario as one HTML file in which it runs, without server and network.

    There are sliders, a target and surfaces that are dragged, links that are pushed, and plots of
    force and error with the prediction. It needs drake_dae[compiler].
    """
    path = find_scenario(options.scenario)
    scenario = load_scenario(path, options.settings)
    file = options.out or Path(f"{path.stem}.html")
    check_unwritten([file], options.force)
    with waiting(f"compiling {path.stem} for a page"):
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
    """Writes the law, the plant and the projection of a scenario as plain C99.

    There are no dependencies; sizes, names and units stand in the code. Of a sampled law the whole
    controller is written as one step, with a class of C++ over it. `make` in the folder compiles
    programs that compare all with Python and with a run of Drake's Simulator.
    """
    path = find_scenario(options.scenario)
    folder = options.out or Path(f"{path.stem}_c99")
    check_folder(folder)
    scenario, missing = load_scenario(path, options.settings), ""
    with waiting(f"exporting {path.stem}"), complete(folder) as place:
        made = *build_scenario(scenario), path.stem, place
        run = scenario.integrator, scenario.duration
        if scenario.task is not None:
            files = export_controller(*made, *run)
            missing = "functions of law and plant: a task has two laws"
        else:
            files = export_code(*made)
            try:
                files += export_controller(*made, *run)
            except ModelError as error:
                missing = f"the whole controller as one step: {error}"
        names = list(dict.fromkeys(file.name for file in files))
        check_unwritten((folder / name for name in names), options.force)
    print(f"written to {folder}/: {', '.join(names)}")
    if missing:
        print(f"not among them: {missing}")
    return 0


COMMANDS = {"page": (_page_options, _page), "export": (_export_options, _export)}
