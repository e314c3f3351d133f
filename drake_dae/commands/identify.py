"""`drake-dae identify` and `excite`: parameters of a plant from records, and motions for these."""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from drake_dae.arrays import number_in
from drake_dae.commands.run.folder import MARK, load_run, stage
from drake_dae.errors import ModelError
from drake_dae.files import read_text
from drake_dae.scenario.files import load_scenario, save_scenario
from drake_dae.scenario.forms.typed_yaml import load_yaml
from drake_dae.scenario.scenario import Scenario
from drake_dae.scenario.shipped import find_scenario
from drake_dae.simulation.records.record import Record
from drake_dae.studies.variations import parse_ranges

if TYPE_CHECKING:
    from drake_dae.studies.excitation.excitation import Excitation
    from drake_dae.studies.identification.identified import Identified


def run_command(options: argparse.Namespace) -> int:
    """Identifies or excites what the options name; returns the exit code."""
    return _excite(options) if options.command == "excite" else _identify(options)


def _identify(options: argparse.Namespace) -> int:
    """Identifies parameters from records; returns the exit code."""
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
    result, identified = identify_scenario(scenario, records, _listed(options.free))
    _report(result, identified, options)
    return 0


def _excite(options: argparse.Namespace) -> int:
    """Finds the best motion and force; returns the exit code."""
    # It loads SciPy's optimizers.
    from drake_dae.studies.excitation.excite import excite

    scenario = load_scenario(find_scenario(options.scenario), options.settings)
    result = excite(
        scenario,
        parse_ranges(options.vary, scenario),
        _listed(options.free),
        noise=_noise(options.noise),
        criterion=options.criterion,
        runs=options.runs,
        seed=options.seed,
        progress=True,
    )
    _report(result, result.scenario, options)
    return 0 if result.interrupted is None else 128 + result.interrupted


def _report(
    result: "Identified | Excitation", scenario: Scenario, options: argparse.Namespace
) -> None:
    """Writes the scenario and prints the result."""
    path: Path | None = options.out
    if path is not None:
        with stage(path.parent, path.name) as temporary:
            save_scenario(scenario, temporary / path.name, MARK)
    if options.json:
        print(json.dumps(result.to_dict(), indent=2))
        return
    print(result.text())
    if path is not None:
        print(f"the scenario with these values is written to {path}")


def _listed(texts: list[str]) -> list[str]:
    """Splits texts at commas."""
    return [name for text in texts for name in text.split(",") if name]


def _noise(texts: list[str]) -> dict[str, float]:
    """Kind of sensor -> the deviation of its noise, from options such as "position=1e-5".

    Raises:
        ModelError: An option is no name with a number.
    """
    deviations = dict[str, float]()
    for text in _listed(texts):
        name, _, number = text.partition("=")
        value = number_in(number)
        if value is None:
            raise ModelError(f"--noise takes position=1e-5,force=0.3, got '{text}'")
        deviations[name] = value
    return deviations


def _load(path: Path, columns: dict[str, str] | None) -> Record:
    """Reads the record of a run, or a log in CSV."""
    if path.suffix == ".csv":
        return Record.from_csv(path, columns)
    if columns is not None:
        raise ModelError(f"--columns names those of a .csv, and '{path}' is none")
    return load_run(path)


def _columns(path: Path) -> dict[str, str]:
    """Reads the names of columns from a YAML file.

    Raises:
        ModelError: The file cannot be read, or is no mapping of names to names.
    """
    try:
        data = load_yaml(read_text(path, 10**6), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ModelError(f"{path} cannot be read: {getattr(error, 'strerror', error)}") from None
    if not isinstance(data, dict) or not all(isinstance(v, str) for v in data.values()):
        raise ModelError(
            f"{path} must name columns line by line, such as 'tau1: control.joint1_motor'"
        )
    return {str(name): target for name, target in data.items()}
