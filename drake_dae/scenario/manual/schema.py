"""The JSON Schema of a scenario for editors, which see keys but not tags."""

from collections.abc import Iterator, Mapping
from typing import Any

from drake_dae.scenario.forms.typed_yaml import TAG
from drake_dae.scenario.scenario import scenario_schema


def editor_schema() -> dict[str, Any]:
    """`scenario_schema` without the entries "_tag", so that editors complete and check keys.

    An editor passes the value after a tag, so any form fits where a tag chooses.
    """
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$comment": f"Tags, for an editor: {', '.join(custom_tags())}",
        **scenario_schema(tags=False),
        "patternProperties": {"^_": True},
    }


def custom_tags() -> list[str]:
    """All tags, as the YAML language server takes them: "!Sphere mapping"."""
    return [f"{tag} mapping" for tag in dict.fromkeys(_tags(scenario_schema()))]


def _tags(schema: Mapping[str, Any]) -> Iterator[str]:
    for value in schema.values():
        for part in value if isinstance(value, list) else [value]:
            if isinstance(part, dict):
                if TAG in part:
                    yield part[TAG]["const"]
                yield from _tags(part)
