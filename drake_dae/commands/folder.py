"""The folder of a run: its files, its record, its animation."""

import webbrowser
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from drake_dae.diagrams.record import Record
from drake_dae.errors import ModelError
from drake_dae.pictures import ANIMATION, PLOTS

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
    record = Record.load(path / names[0] if names else path)
    if not record.time.size:
        raise ModelError(f"the record in '{path}' has no rows")
    return record


def runs_by_name(paths: Sequence[Path]) -> dict[str, Path]:
    """Name -> path of several runs; the whole path is the name where the last part is ambiguous.

    Raises:
        ModelError: A run is named twice.
    """
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise ModelError(f"the run '{twice}' is named twice; name each run once")
    names = Counter(path.name for path in paths)
    return {path.name if path.name and names[path.name] == 1 else str(path): path for path in paths}


def show(folder: Path) -> None:
    """Opens the animation of a run in the browser, and prints its file.

    Raises:
        ModelError: There is none, or no browser.
    """
    if not (folder / SCENARIO).is_file():
        runs = sorted(path.parent for path in folder.parent.glob(f"*/{ANIMATION}"))
        there = f"; there is {', '.join(map(str, runs))}" if runs else ""
        raise ModelError(f"'{folder}' is no folder of a run{there}")
    if not (folder / ANIMATION).is_file():
        raise ModelError(
            f"'{folder}' has no {ANIMATION}: a run writes it at its end, unless write.animation is "
            f"false; `drake-dae simulate {folder / SCENARIO}` repeats the run"
        )
    open_page(folder / ANIMATION)


def open_page(page: Path) -> None:
    """Opens a file in the browser.

    Raises:
        ModelError: There is no browser.
    """
    address = page.resolve().as_uri()
    try:
        opened = webbrowser.open(address)
    except webbrowser.Error:
        opened = False
    if not opened:
        raise ModelError(f"found no browser here; open {address} in one")
    print(f"opened {address}")
