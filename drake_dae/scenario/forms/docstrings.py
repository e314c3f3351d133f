"""Texts on classes and attributes from their docstrings, for users of scenarios."""

import inspect
import re
from collections.abc import Iterator
from functools import cache


@cache
def introduction(docstring: str) -> str:
    """A docstring up to its first section, such as "Attributes:"."""
    return re.split(r"^\w+:$", inspect.cleandoc(docstring), maxsplit=1, flags=re.MULTILINE)[
        0
    ].strip()


def attribute_texts(source: type) -> dict[str, str]:
    """Name of an attribute -> its text in the docstring of the class or of one of its bases."""
    return {
        name: text
        for cls in reversed(source.__mro__)
        for names, text in _attributes(inspect.cleandoc(cls.__doc__ or ""))
        for name in names.split(", ")
    }


def _attributes(doc: str) -> Iterator[tuple[str, str]]:
    _, _, rest = doc.partition("\nAttributes:\n")
    section = re.split(r"^\S", rest, maxsplit=1, flags=re.MULTILINE)[0]
    for entry in re.split(r"^    (?=\w)", section, flags=re.MULTILINE)[1:]:
        names, _, text = entry.partition(":")
        yield names, " ".join(text.split())
