"""Builds the site of the book: runs its pages, writes the reference pages, calls Sphinx."""

import argparse
import hashlib
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

BOOK = Path(__file__).parent
sys.path.insert(0, str(BOOK.parent))

import drake_dae  # noqa: E402
from book.generated import generated_pages  # noqa: E402
from book.notebooks import has_code, notebook  # noqa: E402
from book.pages import pages, run_page  # noqa: E402
from drake_dae.cli import main as command  # noqa: E402
from drake_dae.scenario.shipped import shipped_scenarios  # noqa: E402

NO_FIGURE = "<p>This figure needs zig: pip install ziglang; drake-dae page {name}</p>"
"""The replacement for the live page of a scenario that could not be written."""


def main() -> int:
    """Builds the site; a page runs again only if its file or the library has changed."""
    parser = argparse.ArgumentParser(prog="python examples/book", description=main.__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/book"), help="the folder")
    out = parser.parse_args().out
    source, site = out / "source", out / "site"
    library = _digest(*sorted(Path(drake_dae.__file__).parent.rglob("*.py")))
    texts = {page.relative_to(BOOK): page.read_text("utf-8") for page in pages()}
    texts |= {Path(name): text for name, text in generated_pages().items()}
    for old in set(source.rglob("*.md")) - {source / name for name in texts}:
        old.unlink()
    for page in pages():
        _run(page, source / page.relative_to(BOOK), library)
    for page in filter(has_code, pages()):
        name = page.relative_to(BOOK)
        (source / name).with_suffix(".ipynb").write_text(notebook(page), "utf-8")
        texts[name] += f"\n---\n{{download}}`This page as a notebook <{page.stem}.ipynb>`\n"
    for name, text in texts.items():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text(text, "utf-8")
    shutil.copy(BOOK / "conf.py", source)
    shutil.copy(BOOK / "search.js", source)
    shutil.copytree(BOOK / "_static", source / "_static", dirs_exist_ok=True)
    shutil.copytree(BOOK.parent / "pictures", out / "pictures", dirs_exist_ok=True)
    _live_figures(texts.values(), library, out)
    _gallery(library, source / "gallery")
    # Sphinx keeps an older one, with an older search.js in it.
    (site / "_static" / "searchtools.js").unlink(missing_ok=True)
    sphinx = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    sphinx += ["-d", str(out / "doctrees")]  # No part of the site.
    code = subprocess.run([*sphinx, source, site]).returncode
    if not code:
        print(f"open {site / 'index.html'}")
    return code


def _live_figures(texts: Iterable[str], library: str, out: Path) -> None:
    """Writes the live pages of scenarios that pages of the book show in a frame."""
    folder = out / "site" / "live"
    folder.mkdir(parents=True, exist_ok=True)
    names = {name for text in texts for name in re.findall(r'src="\.\./live/(\w+)\.html"', text)}
    for name in sorted(names):
        page, stamp = folder / f"{name}.html", out / f"{name}.stamp"
        if page.exists() and stamp.exists() and stamp.read_text() == library:
            continue
        print(f"makes the live figure {name}", flush=True)
        if command(["page", name, "--force", "--out", str(page)]):
            page.write_text(NO_FIGURE.format(name=name), "utf-8")
        else:
            stamp.write_text(library)


def _gallery(library: str, folder: Path) -> None:
    """Makes a picture of a run of each shipped scenario."""
    for name in shipped_scenarios():
        run, picture, stamp = (folder / f"{name}{end}" for end in ("", ".png", ".stamp"))
        if picture.exists() and stamp.exists() and stamp.read_text() == library:
            continue
        print(f"makes the picture of {name}", flush=True)
        write = "write={animation: false, plots: false}"
        command(["simulate", name, "--rollout", "--force", "--out", str(run), "--set", write])
        if command(["plot", "--film", str(run), "--force", "--out", str(picture)]) == 0:
            stamp.write_text(library)


def _run(page: Path, copy: Path, library: str) -> None:
    """Runs a page in a folder of its name, beside its copy."""
    folder, stamp = copy.with_suffix(""), copy.with_suffix(".stamp")
    state = f"{library} {_digest(page)}"
    if not (stamp.exists() and stamp.read_text() == state):
        print(f"runs {page.relative_to(BOOK)}", flush=True)
        shutil.rmtree(folder, ignore_errors=True)
        run_page(page, folder)
        stamp.write_text(state)


def _digest(*files: Path) -> str:
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()


if __name__ == "__main__":
    sys.exit(main())
