"""The page of a study: a table to sort, parallel coordinates, and its runs side by side."""

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
    """What a page says of a study besides its table.

    Attributes:
        title: The title.
        said: How many runs ended how, in words.
        names: What is special about each run.
        again: For each run the command that makes its folder; none where nothing is known.
        duration: The duration of the runs, in s.
    """

    title: str
    said: str
    names: Sequence[str]
    again: Sequence[str]
    duration: float


def study_page(
    table: Mapping[str, Sequence[Any]], keys: Sequence[str], figures: Sequence[str], text: PageText
) -> str:
    """One HTML page without anything from outside, as text.

    It shows the pictures of a run where the page's folder has a folder "run<number>" of it.

    Args:
        table: What `Study.table` returns.
        keys: The keys that vary.
        figures: The names of the figures.
        text: What the page says besides.
    """
    columns = [
        *({"name": key, "kind": "key", "values": table[key]} for key in keys),
        {"name": "outcome", "kind": "end", "values": table["outcome"]},
        *({"name": name, "kind": "figure", "values": table[name]} for name in figures),
    ]
    ends = list(zip(table["outcome"], table["reason"], strict=True))
    data = {
        "title": text.title,
        "said": text.said,
        "columns": columns,
        "names": list(text.names),
        "bad": [outcome != Outcome.FINISHED for outcome, _ in ends],
        "ends": [f"{outcome}: {reason}" if reason else outcome for outcome, reason in ends],
        "again": list(text.again),
        "duration": text.duration,
    }
    # A name may contain text that ends a script.
    script = json.dumps(data).replace("<", "\\u003c")
    page = _TEMPLATE.read_text("utf-8").replace("TITLE", html.escape(text.title), 1)
    return page.replace('"DATA"', script, 1)
