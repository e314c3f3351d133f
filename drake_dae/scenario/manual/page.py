"""The page of all keys of a scenario, in Markdown."""

import re
from dataclasses import replace
from difflib import get_close_matches
from typing import Any

from drake_dae.errors import ScenarioError
from drake_dae.scenario.forms.typed_yaml import dump_yaml
from drake_dae.scenario.manual.entries import NOTHING, OWN, ManualEntry, ManualKey, entries
from drake_dae.scenario.manual.schema import custom_tags

_HEAD = """# The keys of a scenario

A scenario is a YAML file. `drake-dae print NAME` prints one to begin with, and all wrong keys and
values of a file are reported together. Where several forms fit, a tag chooses one, as in
`surface: !Sphere`; the first in a list of tags is meant without a tag.

An editor with a YAML language server completes the keys: write `drake-dae schema > scenario.json`,
put `# yaml-language-server: $schema=scenario.json` at the top of a scenario, and name the tags in
its settings, which in Visual Studio Code are

```json
"yaml.customTags": [{tags}]
```
"""


def keys_page() -> str:
    """All keys of a scenario with types, units, defaults, meaning and an example each."""
    tags = ", ".join(f'"{tag}"' for tag in custom_tags())
    return "\n".join([_HEAD.replace("{tags}", tags), *map(_section, entries())])


def named_keys(name: str) -> str:
    """The section of a form, such as "Plane"; or the row of a key, such as "gains", in each form.

    Raises:
        ScenarioError: No form and no key has that name.
    """
    forms = {entry.title.removeprefix("!"): entry for entry in entries()}
    if (wanted := name.removeprefix("!")) in forms:
        return _section(forms[wanted])
    keys = [
        replace(entry, keys=tuple(key for key in entry.keys if key.name == name), examples=())
        for entry in entries()
        if any(key.name == name for key in entry.keys)
    ]
    if not keys:
        known = {*forms, *(key.name for entry in entries() for key in entry.keys)}
        near = get_close_matches(wanted, sorted(known), n=3)
        hint = f"did you mean {' or '.join(map(repr, near))}? " if near else ""
        raise ScenarioError(("", f"no key '{name}'; {hint}`drake-dae keys` prints all"))
    return "\n".join(map(_section, keys))


def _section(entry: ManualEntry) -> str:
    where = f"At `{entry.where}`. " if entry.where else ""
    paragraphs = entry.text.split("\n\n")
    # Formulas are for readers of the code.
    end = next(
        (i for i, paragraph in enumerate(paragraphs) if paragraph.endswith((":", ","))), None
    )
    text = _one_line(" ".join(paragraphs if end is None else paragraphs[: max(end, 1)]))
    text = text.rstrip(":,.") + "."
    if not entry.keys:
        return f"## {entry.title}\n\n{where}{text} It has no keys.\n"
    rows = ["| Key | Takes | Unit | Default | Meaning |", "|---|---|---|---|---|"]
    rows += [_row(key) for key in entry.keys]
    shown = "---\n".join(dump_yaml(dict(example)) for example in entry.examples)
    example = [f"\n```yaml\n{shown}```"] if shown else []
    return "\n".join([f"## {entry.title}\n\n{where}{text}\n", *rows, *example, ""])


def _row(key: ManualKey) -> str:
    text = _one_line(key.text.split("\n\n")[0])
    cells = f"`{key.name}`", key.takes, key.unit, _default(key.default), text
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _default(value: Any) -> str:
    if value is NOTHING:
        return "must be given"
    if value is OWN:
        return "all of its defaults"
    if value is None or value == "":
        return "nothing"
    value = list(value) if isinstance(value, tuple) else value
    text = dump_yaml(value, on_one_line=True).removesuffix("...\n")
    return f"`{text.strip()}`"


def _one_line(text: str) -> str:
    """A text of a docstring on one line, in the words of YAML."""
    return re.sub(r"\bNone\b", "nothing", " ".join(text.split()))
