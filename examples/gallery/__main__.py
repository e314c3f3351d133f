"""All scenarios on one page: picture, motion, bench, idea, figures. `make gallery` writes it.

    python examples/gallery [--out FOLDER] [NAME or FILE ...]

Without names: the shipped scenarios, those of examples/tasks, and robots of three vendors, for
which `drake-dae new` writes the scenario. A run is made again only if its scenario, or the library,
has changed.
"""

import argparse
import contextlib
import hashlib
import html
import io
import json
import shutil
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import drake_dae
from drake_dae import load_scenario
from drake_dae.cli import main as command
from drake_dae.scenario.shipped import find_scenario, shipped_scenarios

HERE = Path(__file__).parent

VENDORS = {
    "panda": "panda_description/urdf/panda.urdf",  # Franka Emika
    "ur5": "ur_description/urdf/ur5_robot.urdf",  # Universal Robots
    "kinova": "kinova_description/robots/kinova.urdf",  # Kinova
}
"""Name -> file of a robot in the package example-robot-data."""

SLOW = "its C takes minutes to compile; drake-dae live runs it here"
"""Why a robot with a dozen contact forces has no page."""

MISSING = """<article><h2>{name}</h2>
<p>This robot is in the package example-robot-data, which is not installed:
<code>pip install example-robot-data</code>, then <code>make gallery</code> again.</p></article>"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Writes the page; returns 1 if a run failed or missed its task without meaning to."""
    parser = argparse.ArgumentParser(prog="python examples/gallery", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/gallery"), help="the folder")
    parser.add_argument("names", nargs="*", help="names of shipped scenarios, or files")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    names = options.names or [*shipped_scenarios(), *sorted(HERE.parent.glob("tasks/*.yaml"))]
    cards, data = [], robot_data()
    for name in names:
        path = find_scenario(str(name))
        settings = []
        if "package://example-robot-data/" in path.read_text("utf-8"):
            settings = [f"robot.packages={{example-robot-data: '{data}'}}"]
        if settings and data is None:
            cards.append(MISSING.format(name=path.stem))
        else:
            cards.append(_made(path, options.out, settings))
    for name, file in {} if options.names else VENDORS.items():
        if data is None:
            cards.append(MISSING.format(name=name))
            continue
        path = options.out / "vendors" / f"{name}.yaml"
        path.parent.mkdir(exist_ok=True)
        path.unlink(missing_ok=True)
        _printed("new", data / "robots" / file, "--out", path)
        cards.append(_made(path, options.out, []))
    page = (HERE / "page.html").read_text("utf-8").replace("<!-- cards -->", "\n".join(cards))
    (options.out / "index.html").write_text(page, "utf-8")
    print(f"open {options.out / 'index.html'}")
    return 0


def robot_data() -> Path | None:
    """The folder of the package example-robot-data; None where it is not installed."""
    try:
        package = distribution("example-robot-data")
    except PackageNotFoundError:
        return None
    return Path(str(package.locate_file("cmeel.prefix/share/example-robot-data")))


def _made(path: Path, out: Path, settings: list[str]) -> str:
    """The card of a scenario, with its run and its bench."""
    options = [option for setting in settings for option in ("--set", setting)]
    told = _run(path, out / path.stem, options)
    told["bench"] = SLOW if options else _bench(path, out / path.stem)
    return _card(path, out / path.stem, told)


def _run(path: Path, folder: Path, options: list[str]) -> dict:
    """What `simulate --json` tells of a run; made if there is none of this scenario yet."""
    stamp = folder.with_suffix(".json")
    state = _digest(path, *sorted(Path(drake_dae.__file__).parent.rglob("*.py")))
    if stamp.exists() and (found := json.loads(stamp.read_text("utf-8")))["state"] == state:
        return found["told"]
    print(f"runs {path.stem}", flush=True)
    shutil.rmtree(folder, ignore_errors=True)
    told = json.loads(_printed("simulate", path, "--out", folder, "--json", *options))
    _printed("render", folder, "--out", folder / "strip.png")
    stamp.write_text(json.dumps({"state": state, "told": told}), "utf-8")
    return told


def _bench(path: Path, folder: Path) -> str:
    """Writes the scenario as a page, where it can be steered; returns why it cannot, or nothing."""
    if (folder / "bench.html").exists():
        return ""
    bundle = folder.parent / "meshcat.js"
    error = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(error):
        page = ("page", path, "--out", folder / "bench.html", "--shared-bundle", bundle)
        code = command([str(word) for word in page])
    lines = [line for line in error.getvalue().splitlines() if line.startswith("error: ")]
    return lines[-1].removeprefix("error: ") if code else ""


def _card(path: Path, folder: Path, told: dict) -> str:
    """A scenario as HTML; all that comes from its file is text."""
    scenario = load_scenario(path)
    job = told["job"]
    said = "; ".join([*job["problems"], *job["remarks"]][:1])
    figures = f"simulated {told['simulated_time']:g} s in {told['wall_time']:.2g} s"
    if told["off_prediction"] is not None:
        figures += f", off prediction by {told['off_prediction']:.1e} {told['unit']}"
    bench = html.escape(told["bench"] and f"No page to steer it: {told['bench']}")
    name, at = html.escape(path.stem), html.escape(folder.name)
    link = "" if bench else f'<a href="{at}/bench.html">steer it</a> '
    return (
        f'<article id="{name}"><h2>{name}</h2>\n'
        f"<p>{html.escape(scenario.description)}</p>\n"
        f'<a href="{at}/animation.html"><img src="{at}/strip.png" loading="lazy" '
        f'alt="{name} at four moments of its run"></a>\n'
        f'<p><b class="{job["outcome"]}">{job["outcome"]}</b>: {html.escape(said)}</p>\n'
        f"<p>{html.escape(figures)}</p>\n"
        f"<p>{bench}</p>\n"
        f'<p>{link}<a href="{at}/animation.html">animation</a> '
        f'<a href="{at}/outputs.png">outputs</a> '
        f'<a href="{at}/errors.png">errors</a> <a href="{at}/summary.txt">summary</a></p>\n'
        f"<details><summary>scenario</summary>\n<pre>{html.escape(path.read_text('utf-8'))}</pre>"
        "</details></article>"
    )


def _printed(*arguments: object) -> str:
    """What a command of `drake-dae` prints to standard output."""
    out, error = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        code = command([str(argument) for argument in arguments])
    if code:
        sys.exit(f"{' '.join(map(str, arguments))}:\n{error.getvalue()}")
    return out.getvalue()


def _digest(*files: Path) -> str:
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()


if __name__ == "__main__":
    sys.exit(main())
