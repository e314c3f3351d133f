"""A check for files that include themselves, with which Drake's parser would not terminate."""

import re
from collections.abc import Iterator
from pathlib import Path

from pydrake.multibody.parsing import PackageMap

from drake_dae.errors import ModelError
from drake_dae.files import read_bytes
from drake_dae.scenario.robot_file.readable.markup import without_comments

_INCLUDED = {
    ".xml": re.compile(r"<include\b[^>]*?\bfile\s*=\s*[\"']\s*([^\"']+)"),
    ".sdf": re.compile(r"<include\b.*?<uri>\s*([^<]*?)\s*</uri>", re.DOTALL),
    ".yaml": re.compile(r"\bfile:\s*[\"']?([^\"'\s,}\]]+)"),
}
_INCLUDED[".yml"] = _INCLUDED[".yaml"]
"""Suffix of a file -> the pattern of the files that it includes."""

MOST = 1000
"""The largest number of files of a robot, each counted as often as it is included."""


def check_includes(file: Path, packages: PackageMap) -> None:
    """Checks that a file does not include itself, and not more than `MOST` files.

    Args:
        file: MJCF, SDFormat or model directives; other files include nothing.
        packages: The packages for URLs.

    Raises:
        ModelError: The file includes itself, or too many files.
    """
    waiting: list[tuple[Path, ...]] = [(file.resolve(),)]
    count = 0
    while waiting:
        chain = waiting.pop()
        count += 1
        if count > MOST:
            raise ModelError(f"'{file.name}' includes more than {MOST} files")
        for inner in _included(chain[-1], file, packages):
            if inner in chain:
                names = " -> ".join(included.name for included in (*chain, inner))
                raise ModelError(f"'{inner.name}' includes itself: {names}")
            waiting.append((*chain, inner))


def _included(file: Path, first: Path, packages: PackageMap) -> Iterator[Path]:
    """The files that a file includes, without missing ones, which Drake reports."""
    pattern = _INCLUDED.get(file.suffix)
    if pattern is None or not file.is_file():
        return
    text = without_comments(read_bytes(file).decode("utf-8", errors="replace"))
    for name in pattern.findall(text):
        try:
            if "://" in name:
                candidates = [Path(packages.ResolveUrl(name))]
            else:
                candidates = [folder / name for folder in (file.parent, first.parent)]
        except RuntimeError:
            continue
        # A folder stands for a model of SDFormat in it.
        included = next((path for path in candidates if path.exists()), None)
        if included is not None and included.is_dir():
            included = next(included.glob("*.sdf"), None)
        if included is not None:
            yield included.resolve()
