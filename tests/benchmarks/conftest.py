"""One table of all figures, printed at the end, and the same in Markdown."""

import re
from collections.abc import Callable

import pytest

from drake_dae.analysis import Table

LINES = pytest.StashKey[list[list[str]]]()
OTHERS = pytest.StashKey[list[list[str]]]()
HEAD = ["", "ours", "counterpart", "ratio", "wanted"]


@pytest.fixture
def compare(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Adds a line of the table: compare("law", 1e-6, "interpreted", 4e-5, wanted=0.1), in s."""
    lines = request.config.stash.setdefault(LINES, [])

    def add(
        figure: str,
        ours: float,
        peer: str = "",
        theirs: float | None = None,
        wanted: float | str = "",
    ) -> None:
        cells = [figure, duration(ours), peer, ""]
        if theirs is not None:
            cells[2:] = [f"{peer}: {duration(theirs)}", f"{ours / theirs:.2g}"]
        lines.append([*cells, f"< {wanted:g}" if isinstance(wanted, float) else wanted])

    return add


@pytest.fixture
def report(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Adds figures of one thing: report("two_link, rigid", {"law [us]": "12.3 (<20)"})."""
    lines = request.config.stash.setdefault(OTHERS, [])

    def add(row: str, figures: dict[str, str]) -> None:
        for column, text in figures.items():
            ours, wanted = re.fullmatch(r"(.*?)(?: \(([<>].*)\))?", text).groups("")
            first, _, faster = ours.partition(", x ")
            ratio = ""
            if faster and not first.startswith("x "):
                ours, ratio = first, f"1 / {faster}"
            lines.append([f"{row}: {column}", ours, "", ratio, wanted])

    return add


def duration(seconds: float) -> str:
    """A time in the unit that fits it."""
    units = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
    unit = next((unit for unit, size in units.items() if seconds >= size), "us")
    return f"{seconds / units[unit]:.3g} {unit}"


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    compared, others = config.stash.get(LINES, []), config.stash.get(OTHERS, [])
    terminalreporter.section("speed: ratios of ours to the counterpart, in one run and alternating")
    terminalreporter.write_line(str(Table(HEAD, [*compared, *others])))
    if compared:
        terminalreporter.section("the lines with a counterpart in Markdown")
        terminalreporter.write_line(Table(HEAD, compared).to_markdown())
