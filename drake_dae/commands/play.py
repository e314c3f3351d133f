"""`drake-dae play`, `page` and `live`: animations, and loops that run in a browser."""

import argparse
import json
import webbrowser
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from drake_dae.commands.run.folder import ANIMATION, load_run, runs_by_name, stage
from drake_dae.errors import ModelError
from drake_dae.pictures.side_by_side import side_by_side

if TYPE_CHECKING:
    from drake_dae.running.bench.run import HandRun
    from drake_dae.scenario.commanded import Commanded
    from drake_dae.scenario.scenario import Scenario


def run_command(options: argparse.Namespace) -> int:
    """Runs the command that the options name; returns the exit code."""
    return {"play": _play, "page": _page, "live": _live}[options.command](options)


def _play(options: argparse.Namespace) -> int:
    """Opens the animations of the folders that the options name."""
    if options.out is None and len(options.runs) == 1:
        show(options.runs[0])
        return 0
    page = options.out or Path("compare.html")
    if page.suffix != ".html":
        raise ModelError(f"a page is an .html, got '{page}'")
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
    from drake_dae.scenario.shipped import shipped_scenarios

    name, scenario, built = _built(options)
    file, bundle = options.out or Path(f"{name}.html"), options.shared_bundle
    title = scenario.description or name
    try:
        files = write_page(
            built.loop, built.context, file, None, title, built.left_out, shared_bundle=bundle
        )
    except ModelError as error:
        is_shipped = Path(options.scenario) in shipped_scenarios().values()
        command = f"drake-dae live {name if is_shipped else options.scenario}"
        raise ModelError(f"{name} cannot be a page ({error}); `{command}` runs it") from error
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


def _live(options: argparse.Namespace) -> int:
    """Runs a live bench, or repeats the commands of an earlier one."""
    from drake_dae.running.bench.live import live
    from drake_dae.running.bench.run import Commands, replay
    from drake_dae.simulation.real_time import attainable_rate

    name, scenario, built = _built(options)
    folder = options.out or Path("live") / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
    if options.replay is not None:
        commands = Commands.load(options.replay)
        record = replay(built.loop, built.context, commands, scenario.integrator)
        folder.mkdir(parents=True, exist_ok=True)
        record.save(folder / "record.npz")
        print(f"{record.time[-1] - record.time[0]:g} s run again, to {folder}/record.npz")
        return 0
    for note in built.left_out:
        print(f"not in it: {note}")
    rate = attainable_rate(built.loop.diagram, built.context, 1.0, scenario.integrator)
    if rate is not None and rate < 1.0:
        print(
            f"this machine runs it at {rate:.2g} of real time, and so the bench will; "
            "--compiled true may help"
        )
    try:
        live(
            built.loop,
            built.context,
            scenario.integrator,
            title=scenario.description or name,
            notes=built.left_out,
            port=options.port,
            opens=not options.no_browser,
            save=_saver(scenario, folder),
        )
    except OSError as error:
        raise ModelError(error.strerror or str(error)) from error
    return 0


def _saver(scenario: "Scenario", folder: Path) -> Callable[["HandRun"], str]:
    """A function that saves a run of a live bench and returns the folder."""
    from drake_dae.scenario.files import save_scenario

    def save(run: "HandRun") -> str:
        folder.mkdir(parents=True, exist_ok=True)
        run.record().save(folder / "record.npz")
        run.commands.save(folder / "commands.json")
        save_scenario(scenario, folder / "scenario.yaml")
        line = f"drake-dae live {folder}/scenario.yaml --replay {folder}/commands.json"
        print(f"saved to {folder}/; again by `{line}`")
        return str(folder)

    return save


def _built(options: argparse.Namespace) -> "tuple[str, Scenario, Commanded]":
    """Builds the commanded loop of the scenario that the options name, and returns all three."""
    from drake_dae.scenario.commanded import build_commanded
    from drake_dae.scenario.files import load_scenario
    from drake_dae.scenario.shipped import find_scenario

    path = find_scenario(options.scenario)
    scenario = load_scenario(path, options.settings)
    return path.stem, scenario, build_commanded(scenario)


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
