"""The codes of errors with their remedies, for `drake-dae explain` and a page of the book."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files

import yaml  # type: ignore[import-untyped]

_HEAD = """# Error codes

On the command line the message of an error ends with a code, as `[E12]`. `drake-dae explain E12`
prints the entry of this page. A code belongs to a kind of message, or else to an exception class.

```python
import numpy as np
import drake_dae as dd
```

"""


@dataclass(frozen=True)
class Remedy:
    """The remedy for one kind of error, with an example that raises it.

    Attributes:
        title: The problem in a few words.
        remedy: The steps that solve it.
        words: The words that each such message contains, where "..." matches any text; empty if
            the code belongs to a class.
        kind: The name of the class that the code belongs to; empty if `words` is set.
        command: Arguments of `drake-dae` that raise this error; empty if the example is in Python.
        python: Python code that raises it, after the imports of the page.
        files: Name -> text of each file that the example needs in its folder.
        environment: Environment variables of the command.
    """

    title: str
    remedy: str
    words: str = ""
    kind: str = ""
    command: str = ""
    python: str = ""
    files: Mapping[str, str] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=dict)


@cache
def remedies() -> dict[str, Remedy]:
    """Returns code -> remedy, in the order of the page."""
    text = (files(__package__) / "errors.yaml").read_text("utf-8")
    return {code: Remedy(**keys) for code, keys in yaml.safe_load(text).items()}


def code_of(message: str, error: type[BaseException]) -> str:
    """Returns the code of an error from its message and class; "" if there is none."""
    for code, remedy in remedies().items():
        if remedy.words and _pattern(remedy.words).search(message):
            return code
    classes = {remedy.kind: code for code, remedy in remedies().items() if remedy.kind}
    return next((classes[kind.__name__] for kind in error.__mro__ if kind.__name__ in classes), "")


def remedy_section(code: str) -> str:
    """Returns the entry of a code, in Markdown."""
    remedy = remedies()[code]
    message = f"`{remedy.words}`" if remedy.words else f"Any other `{remedy.kind}`."
    example = f"```python\n{remedy.python}```" if remedy.python else _commands(remedy)
    shown = "".join(f"`{name}`:\n\n```text\n{text}```\n\n" for name, text in remedy.files.items())
    return (
        f"## {code}: {remedy.title}\n\n*Message*: {message}\n\n*Remedy*: {remedy.remedy}\n\n"
        f"*Example*:\n\n{shown}{example}\n"
    )


def remedies_page() -> str:
    """Returns the entries of all codes, in Markdown."""
    return _HEAD + "\n".join(map(remedy_section, remedies()))


def _commands(remedy: Remedy) -> str:
    variables = "".join(f"{name}={value} " for name, value in remedy.environment.items())
    return f"```sh\n{variables}drake-dae {remedy.command}\n```"


@cache
def _pattern(words: str) -> re.Pattern[str]:
    return re.compile(".*?".join(map(re.escape, words.split("..."))), re.DOTALL)
