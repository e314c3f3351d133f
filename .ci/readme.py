"""The README for a package index, where relative links and pictures lead nowhere.

With the address `Source` under `[project.urls]` they lead to the files of this version there;
without it, they become text with the name of the file in the source distribution.
"""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|mailto:|#)([^)\s]+)\)")


def readme(text: str, source: str = "", version: str = "") -> str:
    """Returns the text with all relative links and pictures replaced."""

    def replaced(match: re.Match[str]) -> str:
        mark, words, path = match.groups()
        if source:
            kind = "raw" if mark else "blob"
            return f"{mark}[{words}]({source.rstrip('/')}/{kind}/v{version}/{path})"
        return f"`{path}`" if words == path else f"{words} (`{path}`)"

    note = "" if source else "\nThe files that are named here are in the source distribution.\n"
    return _LINK.sub(replaced, text) + note


class Readme(MetadataHookInterface):
    """The hook that hatchling calls."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Adds the README to the metadata."""
        text = Path(self.root, "README.md").read_text("utf-8")
        source = metadata.get("urls", {}).get("Source", "")
        text = readme(text, source, metadata["version"])
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
