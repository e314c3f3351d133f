"""`drake-dae view`: opens the animation of a run in the browser."""

import argparse
import webbrowser
from pathlib import Path

from drake_dae.errors import ModelError

_ANIMATION = "animation.html"


def run_command(options: argparse.Namespace) -> int:
    """Opens the animation in the folder that the options name; returns the exit code."""
    show(options.folder)
    return 0


def show(folder: Path) -> None:
    """Opens the animation of a run in the browser, and says which file that is.

    Raises:
        ModelError: There is none, or no browser.
    """
    page = folder / _ANIMATION
    if not page.is_file():
        raise ModelError(_missing(folder))
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
        runs = sorted(path.parent for path in folder.parent.glob(f"*/{_ANIMATION}"))
        there = f"; there is {', '.join(map(str, runs))}" if runs else ""
        return f"no folder '{folder}'{there}"
    if not (folder / "scenario.yaml").is_file():
        return f"'{folder}' is no folder of a run: `drake-dae simulate --out FOLDER` makes one"
    pictures = sorted(path.name for path in folder.glob("*.png"))
    there = f"; it has the pictures {', '.join(pictures)}" if pictures else ""
    return (
        f"'{folder}' has no {_ANIMATION}{there}. A run writes it at its end, unless "
        "write.animation is false; to repeat the run, call `drake-dae simulate` with its "
        "scenario.yaml"
    )
