"""The codes of errors, and what to do about each: `drake-dae explain`, and a page of the book."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files

import yaml  # type: ignore[import-untyped]

_HEAD = """# Error codes

The command ends the message of an error with a code, as `[E12]`; `drake-dae explain E12` prints the
entry of this page. The code is that of the kind of message, or else that of the exception's class.

```python
import numpy as np
import drake_dae as dd
```

"""


@dataclass(frozen=True)
class Remedy:
    """What to do about one kind of error.

    Attributes:
        title: What is wrong, in a few words.
        remedy: What to do.
        words: The words that stand in each such message, "..." for anything; empty if the code is
            that of a class.
        kind: The name of the class of which this is the code; empty if words decide.
        command: Arguments of `drake-dae` that make this error; empty if Python does.
        python: Python code that makes it, after the imports of the page.
        files: Name -> text of what the example needs, in the folder where it runs.
        environment: Variables of the shell in which the command runs.
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
    """Code -> remedy, in the order of the page."""
    text = (files(__package__) / "errors.yaml").read_text("utf-8")
    return {code: Remedy(**keys) for code, keys in yaml.safe_load(text).items()}


def code_of(message: str, error: type[BaseException]) -> str:
    """The code of a message of an error; "" if its class has none."""
    for code, remedy in remedies().items():
        if remedy.words and _pattern(remedy.words).search(message):
            return code
    classes = {remedy.kind: code for code, remedy in remedies().items() if remedy.kind}
    return next((classes[kind.__name__] for kind in error.__mro__ if kind.__name__ in classes), "")


def remedy_section(code: str) -> str:
    """The entry of a code, in Markdown."""
    remedy = remedies()[code]
    said = f"`{remedy.words}`" if remedy.words else f"Any other `{remedy.kind}`."
    example = f"```python\n{remedy.python}```" if remedy.python else _commands(remedy)
    written = "".join(f"`{name}`:\n\n```text\n{text}```\n\n" for name, text in remedy.files.items())
    return (
        f"## {code}: {remedy.title}\n\n*Message*: {said}\n\n*Remedy*: {remedy.remedy}\n\n"
        f"*Example*:\n\n{written}{example}\n"
    )


def remedies_page() -> str:
    """The entries of all codes, in Markdown."""
    return _HEAD + "\n".join(map(remedy_section, remedies()))


def _commands(remedy: Remedy) -> str:
    variables = "".join(f"{name}={value} " for name, value in remedy.environment.items())
    return f"```sh\n{variables}drake-dae {remedy.command}\n```"


@cache
def _pattern(words: str) -> re.Pattern[str]:
    return re.compile(".*?".join(map(re.escape, words.split("..."))), re.DOTALL)
