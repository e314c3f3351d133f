"""`drake-dae plot`: draws signals of runs over each other."""

import argparse
from pathlib import Path

from drake_dae.commands.run_folder import PART, RECORD, stage
from drake_dae.errors import ModelError
from drake_dae.pictures.runs import plot_runs
from drake_dae.simulation.records.record import Record

SUFFIXES = (".png", ".pdf", ".svg")


def run_command(options: argparse.Namespace) -> int:
    """Draws the runs that the options name; returns the exit code."""
    if options.out.suffix not in SUFFIXES:
        raise ModelError(f"a plot is a .png, .pdf or .svg, got '{options.out}'")
    records = {_label(path, options.runs): load_run(path) for path in options.runs}
    names = [name for text in options.signals for name in text.split(",") if name]
    figure = plot_runs(records, names, options.errors)
    with stage(options.out.parent, options.out.name) as place:
        figure.savefig(place / options.out.name, dpi=110)
    print(f"written to {options.out}")
    return 0


def load_run(path: Path) -> Record:
    """The record of a run.

    Args:
        path: Its folder, or the file of the record.

    Raises:
        ModelError: There is none.
    """
    if not path.is_dir():
        return Record.load(path)
    for name in (RECORD, PART):
        if (path / name).is_file():
            return Record.load(path / name)
    raise ModelError(f"'{path}' is no folder of a run: it has no {RECORD}")


def _label(path: Path, paths: list[Path]) -> str:
    """The name of a run: that of its folder if no other one is named alike."""
    alike = [other for other in paths if other.name == path.name]
    return path.name if len(alike) == 1 and path.name else str(path)
