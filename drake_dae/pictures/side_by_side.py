"""A page with the animations of several runs side by side, at the same time."""

import html
import json
import os
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote

_TEMPLATE = Path(__file__).with_name("side_by_side.html")


def side_by_side(pages: Mapping[str, Path], duration: float, folder: Path) -> str:
    """Returns a page that shows the animations of runs side by side, all at the same run time.

    The page refers to the files of the animations, and does not contain them.

    Args:
        pages: Name of a run -> the file of its animation.
        duration: The duration of the longest run, in s.
        folder: The folder that the page will be written to.
    """
    runs = [
        (name, quote(os.path.relpath(page.resolve(), folder.resolve()).replace(os.sep, "/")))
        for name, page in pages.items()
    ]
    data = json.dumps({"runs": runs, "duration": max(duration, 1e-9)}).replace("<", "\\u003c")
    page = _TEMPLATE.read_text("utf-8").replace("TITLE", html.escape(" | ".join(pages)), 1)
    return page.replace('"DATA"', data, 1)
