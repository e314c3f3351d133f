"""The gallery of all that is here: `drake-dae gallery`, and more cards; see `make gallery`.

    python examples/gallery [--out FOLDER]

Added are the tasks in examples/tasks, robots of three manufacturers, for which `drake-dae new`
writes the scenario, and systems of the book that are no robots.
"""

import argparse
import contextlib
import io
import os
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from book.pages import BOOK, blocks

from drake_dae import write_page
from drake_dae.cli import main as command
from drake_dae.commands.gallery import BENCH, Card, scenario_card, write_gallery
from drake_dae.errors import DrakeDaeError
from drake_dae.pictures.plots import save_plots
from drake_dae.scenario.shipped import shipped_scenarios
from drake_dae.simulation.verdict import TrackingResult, in_words, judge

TASKS = Path(__file__).parents[1] / "tasks"

VENDORS = {
    "panda": "panda_description/urdf/panda.urdf",  # Franka Emika
    "ur5": "ur_description/urdf/ur5_robot.urdf",  # Universal Robots
    "kinova": "kinova_description/robots/kinova.urdf",  # Kinova
}
"""Name of a robot -> its file in the package example-robot-data."""

SYSTEMS = {"circuit": "A circuit", "process": "A process"}
"""Name of a card -> the section of the book's page whose code makes the card's loop and record."""

PAGE = BOOK / "explanations" / "not_robots.md"


def main(arguments: Sequence[str] | None = None) -> int:
    """Writes the gallery; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python examples/gallery", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/gallery"), help="the folder")
    out: Path = parser.parse_args(arguments).out
    paths = [*shipped_scenarios().values(), *sorted(TASKS.glob("*.yaml"))]
    if (data := robot_data()) is None:
        print("no robots of manufacturers: pip install example-robot-data, then again")
    else:
        # Where scenarios find the package, as those of a user of ROS do.
        os.environ["ROS_PACKAGE_PATH"] = str(data.parent)
        paths += _vendor_scenarios(data, out / "vendors")
    entries = [(path.stem, path, scenario_card) for path in paths]
    return write_gallery(out, [*entries, *((name, PAGE, system_card) for name in SYSTEMS)])


def robot_data() -> Path | None:
    """Returns the folder of the package example-robot-data; None if it is not installed."""
    try:
        package = distribution("example-robot-data")
    except PackageNotFoundError:
        return None
    return Path(str(package.locate_file("cmeel.prefix/share/example-robot-data")))


def _vendor_scenarios(data: Path, folder: Path) -> list[Path]:
    """Writes scenarios for the robots of manufacturers, and returns their files."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.yaml" for name in VENDORS]
    for path, file in zip(paths, VENDORS.values(), strict=True):
        path.unlink(missing_ok=True)
        words = ["new", str(data / "robots" / file), "--out", str(path)]
        with contextlib.redirect_stdout(io.StringIO()):
            if command(words):
                sys.exit(1)
    return paths


def system_card(page: Path, folder: Path) -> Card:
    """Runs the code of a page up to the end of a section; returns the card of its loop."""
    section = page.read_text("utf-8").split(f"## {SYSTEMS[folder.name]}\n")[1].split("\n## ")[0]
    code = [block.text for block in blocks(page) if block.language == "python"]
    last = max(number for number, text in enumerate(code) if text in section)
    names: dict[str, Any] = {}
    with contextlib.redirect_stdout(io.StringIO()):
        exec("\n".join(code[: last + 1]), names)
    loop, record = names["loop"], names["record"]
    predicted = loop.predicted_error(record)
    save_plots(record, predicted, None, folder)
    start = loop.diagram.CreateDefaultContext()
    loop.set_state(start, record["state"][0])
    bundle = folder.parent / "meshcat.js"
    notes, files = [], [("outputs", "outputs.png"), ("errors", "errors.png")]
    try:
        write_page(loop.diagram, start, folder / BENCH, title=folder.name, shared_bundle=bundle)
        files.append(("steer it", BENCH))
    except DrakeDaeError as error:
        notes = [f"No page to steer it: {error}"]
    residual = np.max(np.abs(record["constraint_residual"]), initial=0.0)
    return Card(
        " ".join(section.split("\n\n")[0].split()).replace("$", ""),
        "\n".join(text for text in code if text in section),
        "good" if judge(record, predicted).tracking is TrackingResult.AS_PREDICTED else "bad",
        in_words(judge(record, predicted)),
        f"Constraint residual {residual:.1e} at most",
        notes,
        "outputs.png",
        files,
    )


if __name__ == "__main__":
    sys.exit(main())
