"""A page with the pictures, animations, benches and figures of scenarios; see `make gallery`.

    python examples/gallery [--out FOLDER] [NAME or FILE ...]

Without names it contains the shipped scenarios, the scenarios in examples/tasks, and robots of
three manufacturers, for which `drake-dae new` writes the scenario. A scenario runs again only if
its file or the library has changed.
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
"""Name of a robot -> its file in the package example-robot-data."""

SLOW = "its C takes minutes to compile; drake-dae live runs it here"
"""The reason why a robot with a dozen contact forces has no bench."""

MISSING = """<article><h2>{name}</h2>
<p>This robot is in the package example-robot-data, which is not installed:
<code>pip install example-robot-data</code>, then <code>make gallery</code> again.</p></article>"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Writes the page, and returns 0; exits with a message if a command fails."""
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
            cards.append(_make_card(path, options.out, settings))
    for name, file in {} if options.names else VENDORS.items():
        if data is None:
            cards.append(MISSING.format(name=name))
            continue
        path = options.out / "vendors" / f"{name}.yaml"
        path.parent.mkdir(exist_ok=True)
        path.unlink(missing_ok=True)
        _output_of("new", data / "robots" / file, "--out", path)
        cards.append(_make_card(path, options.out, []))
    page = (HERE / "page.html").read_text("utf-8").replace("<!-- cards -->", "\n".join(cards))
    (options.out / "index.html").write_text(page, "utf-8")
    print(f"open {options.out / 'index.html'}")
    return 0


def robot_data() -> Path | None:
    """Returns the folder of the package example-robot-data; None if it is not installed."""
    try:
        package = distribution("example-robot-data")
    except PackageNotFoundError:
        return None
    return Path(str(package.locate_file("cmeel.prefix/share/example-robot-data")))


def _make_card(path: Path, out: Path, settings: list[str]) -> str:
    """Runs a scenario, writes its bench, and returns its card."""
    options = [option for setting in settings for option in ("--set", setting)]
    summary = _run(path, out / path.stem, options)
    bench_problem = SLOW if options else _write_bench(path, out / path.stem)
    return _card(path, out / path.stem, summary, bench_problem)


def _run(path: Path, folder: Path, options: list[str]) -> dict:
    """Returns the summary that `simulate --json` prints; runs the scenario if something changed."""
    stamp = folder.with_suffix(".json")
    state = _digest(path, *sorted(Path(drake_dae.__file__).parent.rglob("*.py")))
    if stamp.exists() and (last := json.loads(stamp.read_text("utf-8")))["state"] == state:
        return last["summary"]
    print(f"runs {path.stem}", flush=True)
    shutil.rmtree(folder, ignore_errors=True)
    summary = json.loads(_output_of("simulate", path, "--out", folder, "--json", *options))
    _output_of("render", folder, "--out", folder / "strip.png")
    stamp.write_text(json.dumps({"state": state, "summary": summary}), "utf-8")
    return summary


def _write_bench(path: Path, folder: Path) -> str:
    """Writes the page on which users steer the scenario; returns the problem if that fails."""
    if (folder / "bench.html").exists():
        return ""
    bundle = folder.parent / "meshcat.js"
    error = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(error):
        page = ("page", path, "--out", folder / "bench.html", "--shared-bundle", bundle)
        code = command([str(word) for word in page])
    lines = [line for line in error.getvalue().splitlines() if line.startswith("error: ")]
    return lines[-1].removeprefix("error: ") if code else ""


def _card(path: Path, folder: Path, summary: dict, bench_problem: str) -> str:
    """Returns a scenario's part of the page, with all text from its file escaped."""
    scenario = load_scenario(path)
    job = summary["job"]
    remark = "; ".join([*job["problems"], *job["remarks"]][:1])
    figures = f"simulated {summary['simulated_time']:g} s in {summary['wall_time']:.2g} s"
    if summary["off_prediction"] is not None:
        figures += f", off prediction by {summary['off_prediction']:.1e} {summary['unit']}"
    bench = html.escape(bench_problem and f"No page to steer it: {bench_problem}")
    name, at = html.escape(path.stem), html.escape(folder.name)
    link = "" if bench else f'<a href="{at}/bench.html">steer it</a> '
    return (
        f'<article id="{name}"><h2>{name}</h2>\n'
        f"<p>{html.escape(scenario.description)}</p>\n"
        f'<a href="{at}/animation.html"><img src="{at}/strip.png" loading="lazy" '
        f'alt="{name} at four moments of its run"></a>\n'
        f'<p><b class="{job["outcome"]}">{job["outcome"]}</b>: {html.escape(remark)}</p>\n'
        f"<p>{html.escape(figures)}</p>\n"
        f"<p>{bench}</p>\n"
        f'<p>{link}<a href="{at}/animation.html">animation</a> '
        f'<a href="{at}/outputs.png">outputs</a> '
        f'<a href="{at}/errors.png">errors</a> <a href="{at}/summary.txt">summary</a></p>\n'
        f"<details><summary>scenario</summary>\n<pre>{html.escape(path.read_text('utf-8'))}</pre>"
        "</details></article>"
    )


def _output_of(*arguments: object) -> str:
    """Returns the standard output of a command of `drake-dae`; exits if the command fails."""
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
