"""The folder of a run, and its record."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from drake_dae.errors import ModelError
from drake_dae.pictures.plots import PLOTS
from drake_dae.pictures.run_pictures import ANIMATION
from drake_dae.simulation.records.record import Record

SCENARIO, SUMMARY, RECORD = "scenario.yaml", "summary.txt", "record.npz"
PART = "record.part"
"""The record during a run; it remains if the run is killed."""

FILES = (SCENARIO, SUMMARY, RECORD, *PLOTS, ANIMATION)
"""The files of a run in its folder."""


def load_run(path: Path) -> Record:
    """Reads the record of a run: of its folder, or a file.

    Raises:
        ModelError: There is no record.
    """
    names = [name for name in (RECORD, PART) if (path / name).is_file()]
    if path.is_dir() and not names:
        raise ModelError(f"'{path}' is no folder of a run: it has no {RECORD}")
    return Record.load(path / names[0] if names else path)


def runs_by_name(paths: Sequence[Path]) -> dict[str, Path]:
    """Name -> path of several runs; the whole path is the name where the last part is ambiguous.

    Raises:
        ModelError: A run is named twice.
    """
    if len(set(paths)) < len(paths):
        raise ModelError("a run is named twice; name each run once")
    names = Counter(path.name for path in paths)
    return {path.name if path.name and names[path.name] == 1 else str(path): path for path in paths}
