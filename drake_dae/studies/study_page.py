"""The page of a study: a sortable table, parallel coordinates, and its runs side by side."""

import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drake_dae.studies.results import Outcome

_TEMPLATE = Path(__file__).with_name("page.html")


@dataclass(frozen=True)
class PageText:
    """The texts of a study's page besides its table.

    Attributes:
        title: The title of the page.
        outcomes: The number of runs with each outcome, as text.
        names: The text that distinguishes each run from the others.
        commands: For each run the command that writes its folder; empty if these are unknown.
        duration: The duration of the runs, in s.
    """

    title: str
    outcomes: str
    names: Sequence[str]
    commands: Sequence[str]
    duration: float


def study_page(
    table: Mapping[str, Sequence[Any]], keys: Sequence[str], figures: Sequence[str], text: PageText
) -> str:
    """Returns a self-contained HTML page, as text.

    It shows the pictures of a run if its own folder has a folder "run<number>" with them.

    Args:
        table: The columns that `Study.table` returns.
        keys: The varied keys.
        figures: The names of the figures.
        text: The other texts of the page.
    """
    columns = [
        *({"name": key, "kind": "key", "values": table[key]} for key in keys),
        {"name": "outcome", "kind": "end", "values": table["outcome"]},
        *({"name": name, "kind": "figure", "values": table[name]} for name in figures),
    ]
    endings = list(zip(table["outcome"], table["reason"], strict=True))
    data = {
        "title": text.title,
        "said": text.outcomes,
        "columns": columns,
        "names": list(text.names),
        "bad": [outcome != Outcome.FINISHED for outcome, _ in endings],
        "ends": [f"{outcome}: {reason}" if reason else outcome for outcome, reason in endings],
        "again": list(text.commands),
        "duration": text.duration,
    }
    # A name may contain text that ends a script.
    script = json.dumps(data).replace("<", "\\u003c")
    page = _TEMPLATE.read_text("utf-8").replace("TITLE", html.escape(text.title), 1)
    return page.replace('"DATA"', script, 1)
