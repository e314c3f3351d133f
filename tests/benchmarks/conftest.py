"""One table of all figures, printed at the end."""

from collections.abc import Callable

import pytest

from drake_dae.analysis import Table

LINES = pytest.StashKey[list[list[str]]]()
HEAD = ["", "ours", "counterpart", "ratio", "wanted"]


@pytest.fixture
def compare(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Adds a line of the table: compare("law", 1e-6, "interpreted", 4e-5, wanted=0.1), in s.

    What is wanted of the ratio, or in s of a figure alone, is printed and never judged.
    """
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


def duration(seconds: float) -> str:
    """A time in the unit that fits it."""
    units = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
    unit = next((unit for unit, size in units.items() if seconds >= size), "ns")
    return f"{seconds / units[unit]:.3g} {unit}"


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    terminalreporter.section("speed: ratios of ours to the counterpart, in one run and alternating")
    terminalreporter.write_line(str(Table(HEAD, config.stash.get(LINES, []))))
