"""`drake-dae play` and `page`: animations, and loops that run in a browser."""

import argparse
import json
import webbrowser
from pathlib import Path

from drake_dae.commands.run.folder import ANIMATION, load_run, runs_by_name, stage
from drake_dae.errors import ModelError
from drake_dae.files import check_unwritten
from drake_dae.pictures.side_by_side import side_by_side


def run_command(options: argparse.Namespace) -> int:
    """Runs the command that the options name; returns the exit code."""
    return {"play": _play, "page": _page}[options.command](options)


def _play(options: argparse.Namespace) -> int:
    """Opens the animations of the folders that the options name."""
    if options.out is None and len(options.runs) == 1:
        show(options.runs[0])
        return 0
    page = options.out or Path("compare.html")
    if page.suffix != ".html":
        raise ModelError(f"a page is an .html, got '{page}'")
    check_unwritten([page], options.force)
    pages = {name: _animation(run) for name, run in runs_by_name(options.runs).items()}
    times = [load_run(run).time for run in options.runs]
    duration = max(float(time[-1] - time[0]) for time in times)
    with stage(page.parent, page.name) as temporary:
        text = side_by_side(pages, duration, page.parent)
        (temporary / page.name).write_text(text, encoding="utf-8")
    _open(page)
    return 0


def _animation(folder: Path) -> Path:
    page = folder / ANIMATION
    if not page.is_file():
        raise ModelError(_missing(folder))
    return page


def show(folder: Path) -> None:
    """Opens the animation of a run in the browser, and prints its file.

    Raises:
        ModelError: There is none, or no browser.
    """
    _open(_animation(folder))


def _open(page: Path) -> None:
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


def _page(options: argparse.Namespace) -> int:
    """Writes a scenario as a page."""
    from drake_dae.running.bench.page import write_page
    from drake_dae.scenario.commanded import build_commanded
    from drake_dae.scenario.files import load_scenario
    from drake_dae.scenario.shipped import find_scenario

    path = find_scenario(options.scenario)
    name, scenario = path.stem, load_scenario(path, options.settings)
    file, bundle = options.out or Path(f"{name}.html"), options.shared_bundle
    check_unwritten([file], options.force)
    built = build_commanded(scenario)
    title = scenario.description or name
    try:
        files = write_page(
            built.loop, built.context, file, None, title, built.left_out, shared_bundle=bundle
        )
    except ModelError as error:
        raise ModelError(f"{name} cannot be a page: {error}") from error
    sizes = {str(path): path.stat().st_size for path in files}
    if options.json:
        print(json.dumps({"files": sizes, "left_out": list(built.left_out)}, indent=2))
        return 0
    print(f"written: {', '.join(f'{path} ({size / 1e6:.2f} MB)' for path, size in sizes.items())}")
    for note in built.left_out:
        print(f"not in it: {note}")
    if options.open:
        _open(file)
    return 0


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
