"""All scenarios on one page: picture, motion, idea, figures, files. `make gallery` writes it.

    python examples/gallery [--out FOLDER] [NAME or FILE ...]

Without names: the shipped scenarios and those of examples/tasks. A run is made again only if its
scenario, or the library, has changed.
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
from pathlib import Path

import drake_dae
from drake_dae import load_scenario
from drake_dae.cli import main as command
from drake_dae.scenario.shipped import find_scenario, shipped_scenarios

HERE = Path(__file__).parent


def main(arguments: Sequence[str] | None = None) -> int:
    """Writes the page; returns 1 if a run failed or missed its task without meaning to."""
    parser = argparse.ArgumentParser(prog="python examples/gallery", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/gallery"), help="the folder")
    parser.add_argument("names", nargs="*", help="names of shipped scenarios, or files")
    options = parser.parse_args(arguments)
    names = options.names or [*shipped_scenarios(), *sorted(HERE.parent.glob("tasks/*.yaml"))]
    options.out.mkdir(parents=True, exist_ok=True)
    cards = []
    for name in names:
        path = find_scenario(str(name))
        cards.append(_card(path, options.out / path.stem, _run(path, options.out / path.stem)))
    page = (HERE / "page.html").read_text("utf-8").replace("<!-- cards -->", "\n".join(cards))
    (options.out / "index.html").write_text(page, "utf-8")
    print(f"open {options.out / 'index.html'}")
    return 0


def _run(path: Path, folder: Path) -> dict:
    """What `simulate --json` tells of a run; made if there is none of this scenario yet."""
    stamp = folder.with_suffix(".json")
    state = _digest(path, *sorted(Path(drake_dae.__file__).parent.rglob("*.py")))
    if stamp.exists() and (found := json.loads(stamp.read_text("utf-8")))["state"] == state:
        return found["told"]
    print(f"runs {path.stem}", flush=True)
    shutil.rmtree(folder, ignore_errors=True)
    told = json.loads(_printed("simulate", path, "--out", folder, "--json"))
    _printed("render", folder, "--out", folder / "strip.png")
    stamp.write_text(json.dumps({"state": state, "told": told}), "utf-8")
    return told


def _card(path: Path, folder: Path, told: dict) -> str:
    """A scenario as HTML; all that comes from its file is text."""
    scenario = load_scenario(path)
    job = told["job"]
    said = "; ".join([*job["problems"], *job["remarks"]][:1])
    figures = f"simulated {told['simulated_time']:g} s in {told['wall_time']:.2g} s"
    if told["off_prediction"] is not None:
        figures += f", off prediction by {told['off_prediction']:.1e} {told['unit']}"
    name, at = html.escape(path.stem), html.escape(folder.name)
    return (
        f'<article id="{name}"><h2>{name}</h2>\n'
        f"<p>{html.escape(scenario.description)}</p>\n"
        f'<a href="{at}/animation.html"><img src="{at}/strip.png" loading="lazy" '
        f'alt="{name} at four moments of its run"></a>\n'
        f'<p><b class="{job["outcome"]}">{job["outcome"]}</b>: {html.escape(said)}</p>\n'
        f"<p>{html.escape(figures)}</p>\n"
        f'<p><a href="{at}/animation.html">animation</a> <a href="{at}/outputs.png">outputs</a> '
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
