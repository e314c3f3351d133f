"""One table of all figures, printed at the end."""

from collections.abc import Callable

import pytest

from drake_dae.analysis.tables import Table

ROWS = pytest.StashKey[dict[str, dict[str, str]]]()


@pytest.fixture
def report(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Adds figures to a row: report("two_link, rigid", {"law [us]": "12.3"})."""
    rows = request.config.stash.setdefault(ROWS, {})

    def add(row: str, figures: dict[str, str]) -> None:
        rows.setdefault(row, {}).update(figures)

    return add


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    rows = config.stash.get(ROWS, {})
    columns = list(dict.fromkeys(column for figures in rows.values() for column in figures))
    cells = [[row, *(figures.get(c, "") for c in columns)] for row, figures in rows.items()]
    terminalreporter.section("speed; in brackets what is wanted")
    terminalreporter.write_line(str(Table(["", *columns], cells)))
