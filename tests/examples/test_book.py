"""Every page of the book runs and prints what it shows."""

import json
import os
import re
import subprocess
from pathlib import Path

import pytest
from book.generated import public_names, uses
from book.notebooks import has_code, notebook
from book.pages import BOOK, PageError, blocks, compare, pages, run_page
from browser import CHROMIUM, low_contrast

SLOW = {
    "explanations/force.md",
    "how_to/data.md",
    "how_to/real_arm.md",
    "how_to/surfaces.md",
    "how_to/theory_tools.md",
    "how_to/wrong_model.md",
    "tutorials/a_study.md",
    "tutorials/a_task.md",
    "tutorials/real_contact.md",
    "tutorials/your_diagram.md",
}
"""Pages that take long, of what tests of its own show: left to `make campaign` and to
`make docs`.
"""


def named(page: Path) -> str:
    return str(page.relative_to(BOOK))


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=named(page), marks=[pytest.mark.thorough] * (named(page) in SLOW))
        for page in pages()
    ],
)
def test_page_runs_as_shown(page, tmp_path):
    run_page(page, tmp_path / page.stem, pictures=False)


def test_a_page_is_compared_to_the_digits_that_it_shows():
    for shown, printed in (("0.35 m", "0.354 m"), ("1.2e-3", "0.0012"), ("a ... b", "a 1\n2 b")):
        compare(shown, printed)
    for shown, printed in (("0.35 m", "0.362 m"), ("12 steps", "12.5 steps"), ("a ... b", "a 1")):
        with pytest.raises(PageError):
            compare(shown, printed)


def test_links_lead_to_pages_files_and_headings():
    written = ("names", "keys", "commands", "equations")
    made = {BOOK / "gallery.md", *(BOOK / "reference" / f"{name}.md" for name in written)}
    for page in pages():
        text = re.sub(r"^```.*?^```$", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
        for target in re.findall(r"(?<!!)\[[^\]]*\]\(([^)\s]+)\)", text):
            if target.startswith(("http://", "https://", "mailto:")):
                continue
            path, _, heading = target.partition("#")
            file = (page.parent / path).resolve() if path else page
            assert file in made or file.exists(), f"{named(page)}: {target}"
            if heading and file not in made:
                titles = re.findall(r"^#+ (.*)$", file.read_text("utf-8"), flags=re.MULTILINE)
                slugs = {re.sub(r"[^\w\- ]", "", t.lower()).replace(" ", "-") for t in titles}
                assert heading in slugs, f"{named(page)}: {target}"


def test_pages_are_in_the_contents():
    listed = set()
    for page in pages():
        for contents in re.findall(r"```{toctree}\n(.*?)```", page.read_text("utf-8"), re.DOTALL):
            names = [line for line in contents.splitlines() if line and not line.startswith(":")]
            listed |= {named((page.parent / f"{name}.md").resolve()) for name in names}
    assert {named(page) for page in pages()[1:]} <= listed


def test_a_notebook_has_the_code_of_its_page_in_its_order():
    for page in filter(has_code, pages()):
        cells = json.loads(notebook(page))["cells"]
        code = iter("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
        for block in blocks(page):
            if block.language == "python":
                assert block.text.rstrip("\n") in code, page  # Which goes on from there.


def test_every_public_name_is_used_in_a_page_or_an_example_that_runs():
    assert sorted(set(public_names()) - set(uses())) == []


@pytest.mark.thorough
def test_site_is_made_and_loads_nothing_from_outside(tmp_path):
    pytest.importorskip("furo", reason="pip install -e '.[docs]'")
    made = subprocess.run(["make", "docs", f"BOOK={tmp_path}"], cwd=BOOK.parents[1], env=os.environ)
    assert made.returncode == 0
    for html in (tmp_path / "site").rglob("*.html"):
        text = html.read_text("utf-8")
        loaded = re.findall(r"<(?:script|img|iframe)[^>]+src=\"(http[^\"]+)\"", text)
        loaded += re.findall(r"<link[^>]+rel=\"stylesheet\"[^>]+href=\"(http[^\"]+)\"", text)
        assert loaded == [], html
    assert not list((tmp_path / "site").rglob("*.doctree"))
    if CHROMIUM:
        for page in ("index", "how_to/gains", "reference/errors", "tutorials/first_contact"):
            assert low_contrast(tmp_path / "site" / f"{page}.html") == {}, page
