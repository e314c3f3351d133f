"""`drake-dae render`: renders the run in a folder."""

import argparse

from drake_dae.commands.plot import load_run
from drake_dae.commands.run_folder import FILM, SCENARIO, stage
from drake_dae.errors import ModelError
from drake_dae.pictures.film import save_film
from drake_dae.scenario.build import build_scenario
from drake_dae.scenario.files import load_scenario


def run_command(options: argparse.Namespace) -> int:
    """Films the run in the folder that the options name; returns the exit code."""
    folder = options.folder
    if not (folder / SCENARIO).is_file():
        raise ModelError(f"'{folder}' is no folder of a run: it has no {SCENARIO}")
    record = load_run(folder)
    loop, context = build_scenario(load_scenario(folder / SCENARIO, []))
    path = options.out or folder / FILM
    with stage(path.parent, path.name) as place:
        save_film(loop, record, context, place / path.name)
    print(f"written to {path}")
    return 0
