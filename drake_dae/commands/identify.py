"""`drake-dae identify`: parameters of a plant from records."""

import argparse
import json
from pathlib import Path

from drake_dae.commands.run_folder import MARK, load_run, stage
from drake_dae.errors import ModelError
from drake_dae.files import read_text
from drake_dae.scenario.files import load_scenario, save_scenario
from drake_dae.scenario.forms.typed_yaml import load_yaml
from drake_dae.scenario.shipped import find_scenario
from drake_dae.simulation.records.record import Record


def run_command(options: argparse.Namespace) -> int:
    """Identifies what the options name; returns the exit code."""
    # SciPy's splines take a fifth of a second to load.
    from drake_dae.studies.identification.of_scenario import identify_scenario, recorded_scenario

    columns = None if options.columns is None else _columns(options.columns)
    if len(set(options.records)) < len(options.records):
        raise ModelError("a record is named twice; name each record once")
    records = {str(path): _load(path, columns) for path in options.records}
    if options.scenario is None:
        if options.settings:
            raise ModelError("--set changes the scenario that --scenario names; name one")
        scenario = recorded_scenario(records)
    else:
        scenario = load_scenario(find_scenario(options.scenario), options.settings)
    free = [name for text in options.free for name in text.split(",") if name]
    found, identified = identify_scenario(scenario, records, free)
    path: Path | None = options.out
    if path is not None:
        with stage(path.parent, path.name) as place:
            save_scenario(identified, place / path.name, MARK)
    if options.json:
        print(json.dumps(found.to_dict(), indent=2))
        return 0
    print(found.text())
    if path is not None:
        print(f"the scenario with these values is written to {path}")
    return 0


def _load(path: Path, columns: dict[str, str] | None) -> Record:
    """The record of a run, or a log in CSV."""
    if path.suffix == ".csv":
        return Record.from_csv(path, columns)
    if columns is not None:
        raise ModelError(f"--columns names those of a .csv, and '{path}' is none")
    return load_run(path)


def _columns(path: Path) -> dict[str, str]:
    """The names of columns from a YAML file.

    Raises:
        ModelError: The file cannot be read, or is no mapping of names to names.
    """
    try:
        found = load_yaml(read_text(path, 10**6), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ModelError(f"{path} cannot be read: {getattr(error, 'strerror', error)}") from None
    if not isinstance(found, dict) or not all(isinstance(v, str) for v in found.values()):
        raise ModelError(
            f"{path} must name columns line by line, such as 'tau1: control.joint1_motor'"
        )
    return {str(name): meant for name, meant in found.items()}
