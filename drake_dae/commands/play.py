"""`drake-dae play`: opens the animation of a run in the browser."""

import argparse
import webbrowser
from pathlib import Path

from drake_dae.commands.run_folder import ANIMATION, load_run, run_label, stage
from drake_dae.errors import ModelError
from drake_dae.pictures.side_by_side import side_by_side


def run_command(options: argparse.Namespace) -> int:
    """Opens the animations of the folders that the options name; returns the exit code."""
    if options.out is None and len(options.runs) == 1:
        show(options.runs[0])
        return 0
    page = options.out or Path("compare.html")
    if page.suffix != ".html":
        raise ModelError(f"a page is an .html, got '{page}'")
    if len(set(options.runs)) < len(options.runs):
        raise ModelError("a run is named twice; name each run once")
    pages = {run_label(run, options.runs): _animation(run) for run in options.runs}
    times = [load_run(run).time for run in options.runs]
    duration = max(float(each[-1] - each[0]) for each in times)
    with stage(page.parent, page.name) as place:
        text = side_by_side(pages, duration, page.parent)
        (place / page.name).write_text(text, encoding="utf-8")
    _open(page)
    return 0


def _animation(folder: Path) -> Path:
    page = folder / ANIMATION
    if not page.is_file():
        raise ModelError(_missing(folder))
    return page


def show(folder: Path) -> None:
    """Opens the animation of a run in the browser, and says which file that is.

    Raises:
        ModelError: There is none, or no browser.
    """
    _open(_animation(folder))


def _open(page: Path) -> None:
    address = page.resolve().as_uri()
    try:
        opened = webbrowser.open(address)
    except webbrowser.Error:
        opened = False
    if not opened:
        raise ModelError(f"found no browser here; open {address} in one")
    print(f"opened {address}")


def _missing(folder: Path) -> str:
    """The message for a folder without animation."""
    if folder.is_file():
        return f"'{folder}' is a file; name the folder of a run"
    if not folder.is_dir():
        runs = sorted(path.parent for path in folder.parent.glob(f"*/{ANIMATION}"))
        there = f"; there is {', '.join(map(str, runs))}" if runs else ""
        return f"no folder '{folder}'{there}"
    if not (folder / "scenario.yaml").is_file():
        return f"'{folder}' is no folder of a run: `drake-dae simulate --out FOLDER` makes one"
    pictures = sorted(path.name for path in folder.glob("*.png"))
    there = f"; it has the pictures {', '.join(pictures)}" if pictures else ""
    return (
        f"'{folder}' has no {ANIMATION}{there}. A run writes it at its end, unless "
        "write.animation is false; to repeat the run, call `drake-dae simulate` with its "
        "scenario.yaml"
    )
