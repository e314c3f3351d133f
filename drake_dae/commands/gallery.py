"""`drake-dae gallery`: runs scenarios, and shows them on one page with a card for each."""

import argparse
import hashlib
import html
import io
import json
import shutil
from collections.abc import Callable, Iterable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from signal import Signals

import numpy as np

import drake_dae
from drake_dae.commands import play, plot, simulate
from drake_dae.commands.options import parse_options
from drake_dae.commands.run.folder import RECORD
from drake_dae.errors import DrakeDaeError, ModelError, describe_os_error
from drake_dae.scenario.files import load_scenario
from drake_dae.scenario.shipped import find_scenario, shipped_scenarios
from drake_dae.simulation.records.interruption import end_at_once
from drake_dae.simulation.records.record import Record

TEMPLATE = Path(__file__).with_suffix(".html")

MARK = "<title>drake_dae: gallery</title>"
"""A text of the page: only such a file is replaced."""

CARD = "card.json"
"""The file with the card of a folder, and with a digest of what the card was made from."""

PICTURE, BENCH = "strip.png", "bench.html"

_COMMANDS = {
    "simulate": simulate.run_command,
    "render": plot.run_command,
    "page": play.run_command,
}


@dataclass(frozen=True)
class Card:
    """The contents of a card.

    Attributes:
        description: What the system is, and what it is to do.
        source: The text of its scenario or program.
        outcome: "good", "bad" or "undecided"; empty if it did not run.
        remark: The first remark on the outcome.
        figures: The figures of the run, in words.
        notes: Sentences on what the card does not have, and warnings.
        picture: The name of the picture in the folder of the card; empty for none.
        files: Name of a link -> file in the folder; the picture leads to the first one.
    """

    description: str
    source: str
    outcome: str = ""
    remark: str = ""
    figures: str = ""
    notes: Sequence[str] = ()
    picture: str = ""
    files: Sequence[tuple[str, str]] = ()

    def to_html(self, name: str) -> str:
        """Returns the card as HTML, with all its text escaped."""
        at, title = html.escape(name), html.escape(name.replace("_", " "))
        links = [f'<a href="{at}/{file}">{text}</a>' for text, file in self.files]
        lines = [f'<article id="{at}"><h2>{at}</h2>', f"<p>{html.escape(self.description)}</p>"]
        if self.picture:
            alt = f"{title} at four moments of its run" if self.picture == PICTURE else title
            lines += [f'<a href="{at}/{self.files[0][1]}">']
            lines += [f'<img src="{at}/{self.picture}" loading="lazy" alt="{alt}"></a>']
        if self.outcome:
            lines += [f'<p><b class="{self.outcome}">{self.outcome}</b>: ']
            lines += [f"{html.escape(self.remark)}</p>", f"<p>{html.escape(self.figures)}</p>"]
        lines += [f"<p>{html.escape(note)}</p>" for note in self.notes]
        lines += [f"<p>{' '.join(links)}</p>"] if links else []
        source = f"<pre tabindex=0>{html.escape(self.source)}</pre>"
        return "\n".join(
            [*lines, f"<details><summary>source</summary>\n{source}</details></article>"]
        )


def run_command(options: argparse.Namespace) -> int:
    """Writes the gallery of the scenarios that the options name; returns the exit code."""
    paths = [find_scenario(name) for name in options.scenarios or shipped_scenarios()]
    return write_gallery(options.out, [(path.stem, path, scenario_card) for path in paths])


def write_gallery(
    out: Path, entries: Iterable[tuple[str, Path, Callable[[Path, Path], Card]]]
) -> int:
    """Makes cards in subfolders of a folder, and the page that shows them.

    A card is made again only if its source or the library has changed. A card that fails shows the
    reason. The page is written again after each card, so that an interrupted gallery remains.

    Args:
        out: The folder.
        entries: Name of a card, the file of its source, and the function that makes the card from
            this file in a folder.

    Returns:
        The exit code: 0, or 1 if a card failed.

    Raises:
        ModelError: Two names are equal, or the folder has files that are not from a gallery.
    """
    entries = list(entries)
    names = [name for name, _, _ in entries]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ModelError(f"two scenarios are named '{min(twice)}'; name a gallery's files apart")
    page = out / "index.html"
    _check(out, page, names)
    library = sorted(Path(drake_dae.__file__).parent.rglob("*.py"))
    tools = b"zig" if find_spec("ziglang") else b""
    base = hashlib.sha256(b"".join(path.read_bytes() for path in library) + tools)
    failed = []
    for name, source, make in entries:
        folder, state = out / name, base.copy()
        state.update(source.read_bytes())
        if _stored(folder).get("state") == state.hexdigest():
            continue
        print(f"runs {name}", flush=True)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        _store(folder, "", "")
        try:
            _store(folder, state.hexdigest(), make(source, folder).to_html(name))
        except (DrakeDaeError, OSError) as error:
            text = describe_os_error(error) if isinstance(error, OSError) else str(error)
            print(f"  {text}", flush=True)
            card = Card("", source.read_text("utf-8", "replace"), notes=[f"It fails: {text}"])
            _store(folder, "", card.to_html(name))
            failed.append(name)
        _write_page(page, names)
    _write_page(page, names)
    print(f"written: {page}")
    if failed:
        print(f"failed: {', '.join(failed)}; the same command tries them again")
    return 1 if failed else 0


def scenario_card(path: Path, folder: Path) -> Card:
    """Runs a scenario, writes its strip of pictures and its bench, and returns its card.

    Raises:
        DrakeDaeError: The scenario cannot run.
        OSError: A file cannot be written.
    """
    scenario = load_scenario(path)
    writes = [f"--set=write.{what}=true" for what in ("record", "plots", "animation")]
    printed, notes = _printed("simulate", path, "--out", folder, "--json", *writes)
    _printed("render", folder, "--out", folder / PICTURE)
    files = [("animation", "animation.html"), ("outputs", "outputs.png"), ("errors", "errors.png")]
    files += [("record", RECORD), ("summary", "summary.txt")]
    bundle = ("--shared-bundle", folder.parent / "meshcat.js")
    try:
        _printed("page", path, "--out", folder / BENCH, *bundle)
        files.insert(1, ("steer it", BENCH))
    except DrakeDaeError as error:
        notes = [f"No page to steer it: {error}", *notes]
    summary, record = json.loads(printed), Record.load(folder / RECORD)
    job = summary["job"]
    remark = "; ".join([*job["problems"], *job["remarks"]][:1])
    text = path.read_text("utf-8")
    figures = f"Simulated {summary['simulated_time']:g} s in {summary['wall_time']:.2g} s"
    if reasons := summary["reasons"]:
        figures += f"; not an ideal run: {'; '.join(reasons)}"
    elif summary["off_prediction"] is not None:
        residual = np.max(np.abs(record["constraint_residual"]), initial=0.0)
        figures += f", off prediction by {summary['off_prediction']:.1e} {summary['unit']}".rstrip()
        figures += f", constraint residual {residual:.1e} at most"
    return Card(scenario.description, text, job["outcome"], remark, figures, notes, PICTURE, files)


def _printed(*words: object) -> tuple[str, list[str]]:
    """Runs a command; returns its output, and its warnings.

    Raises:
        DrakeDaeError: The command fails.
        KeyboardInterrupt: A signal ended its run.
    """
    words = tuple(word.resolve() if isinstance(word, Path) else word for word in words)
    options = parse_options([str(word) for word in words])
    out, error = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(error):
        code = _COMMANDS[options.command](options)
    if code > 128:
        end_at_once(Signals(code - 128))
    lines = error.getvalue().splitlines()
    if code:
        errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
        raise ModelError("; ".join(errors))
    return out.getvalue(), [line for line in lines if line.startswith("warning: ")]


def _check(out: Path, page: Path, names: Sequence[str]) -> None:
    """Checks that nothing would be replaced that is not from a gallery.

    Raises:
        ModelError: Something would.
    """
    is_foreign = page.exists() and MARK not in page.read_text("utf-8", "replace")
    folders = [out / name for name in names if (out / name).exists()]
    foreign = [path for path in folders if not path.is_dir() or not _stored(path)]
    for path in [*([page] if is_foreign else []), *foreign]:
        raise ModelError(f"'{path}' is not from a gallery; choose another folder with --out")


def _stored(folder: Path) -> dict[str, str]:
    """The card in a folder with the digest of its state; empty if there is none."""
    try:
        data = json.loads((folder / CARD).read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return data if isinstance(data, dict) and {"state", "card"} <= set(data) else {}


def _store(folder: Path, state: str, card: str) -> None:
    (folder / CARD).write_text(json.dumps({"state": state, "card": card}), "utf-8")


def _write_page(page: Path, names: Sequence[str]) -> None:
    """Writes the page with all cards that are there."""
    cards = "\n".join(_stored(page.parent / name).get("card", "") for name in names)
    page.write_text(TEMPLATE.read_text("utf-8").replace("<!-- cards -->", cards), "utf-8")
