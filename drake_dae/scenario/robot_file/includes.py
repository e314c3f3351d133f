"""Files of a robot that include themselves, on which Drake's parser would not end."""

import re
from collections.abc import Iterator
from pathlib import Path

from pydrake.multibody.parsing import PackageMap

from drake_dae.errors import ModelError
from drake_dae.files import read_bytes

_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_INCLUDED = {
    ".xml": re.compile(r"<include\b[^>]*?\bfile\s*=\s*[\"']\s*([^\"']+)"),
    ".sdf": re.compile(r"<include\b.*?<uri>\s*([^<]*?)\s*</uri>", re.DOTALL),
    ".yaml": re.compile(r"\bfile:\s*[\"']?([^\"'\s,}\]]+)"),
}
_INCLUDED[".yml"] = _INCLUDED[".yaml"]
"""Per kind of file: what it includes."""

MOST = 1000
"""The largest number of files of a robot, each counted as often as it is included."""


def check_includes(file: Path, packages: PackageMap) -> None:
    """Refuses a file that includes itself, or more than `MOST` files.

    Args:
        file: MJCF, SDFormat or model directives; others include nothing.
        packages: The packages that URLs name.

    Raises:
        ModelError: It does; the message has the chain of includes.
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
                names = " -> ".join(one.name for one in (*chain, inner))
                raise ModelError(f"'{inner.name}' includes itself: {names}")
            waiting.append((*chain, inner))


def _included(file: Path, first: Path, packages: PackageMap) -> Iterator[Path]:
    """The files that a file includes; missing ones are left to Drake's message."""
    form = _INCLUDED.get(file.suffix)
    if form is None or not file.is_file():
        return
    text = _COMMENT.sub("", read_bytes(file).decode("utf-8", errors="replace"))
    for name in form.findall(text):
        try:
            if "://" in name:
                places = [Path(packages.ResolveUrl(name))]
            else:
                places = [folder / name for folder in (file.parent, first.parent)]
        except RuntimeError:
            continue
        # A folder stands for a model of SDFormat in it.
        found = next((place for place in places if place.exists()), None)
        if found is not None and found.is_dir():
            found = next(found.glob("*.sdf"), None)
        if found is not None:
            yield found.resolve()
