"""YAML as plain data and back, where a tag `!Sphere` is an entry "_tag" as Drake has it."""

import re
from collections.abc import Container
from typing import Any

import yaml  # type: ignore[import-untyped]

from drake_dae.errors import ScenarioError

TAG = "_tag"
"""The key under which a mapping holds its tag."""


class _Loader(yaml.SafeLoader):
    """YAML 1.1, but 1e-8 is a number, keys are text and stand once, and tags are kept."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[str, Any]:
        names = set()
        for key, _ in node.value:
            if key.tag not in ("tag:yaml.org,2002:str", "tag:yaml.org,2002:merge"):
                raise self._error(f"the key {key.value!r} is not text; quote it", key)
            if key.value in names:
                raise self._error(f"the key '{key.value}' is given twice", key)
            names.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_tagged(self, tag: str, node: yaml.Node) -> dict[str, Any]:
        if not isinstance(node, yaml.MappingNode):
            raise self._error(f"the tag !{tag} must be followed by keys, or by {{}}", node)
        return {TAG: f"!{tag}", **self.construct_mapping(node, deep=True)}

    @staticmethod
    def _error(problem: str, node: yaml.Node) -> yaml.MarkedYAMLError:
        return yaml.constructor.ConstructorError(problem=problem, problem_mark=node.start_mark)


_Loader.add_multi_constructor("!", _Loader.construct_tagged)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


class _Dumper(yaml.SafeDumper):
    """Keeps the order of keys, and writes tags."""

    def represent_tagged(self, data: dict[str, Any]) -> yaml.MappingNode:
        entries = [(key, value) for key, value in data.items() if key != TAG]
        return self.represent_mapping(data.get(TAG, "tag:yaml.org,2002:map"), entries)


_Dumper.add_representer(dict, _Dumper.represent_tagged)


def load_yaml(text: str, name: str) -> Any:
    """YAML as lists, dictionaries and plain values; a tag becomes the entry "_tag".

    Args:
        text: A text in YAML.
        name: What messages call the text.

    Raises:
        ScenarioError: The YAML is broken, or a key is no text or given twice; the message has the
            line.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        what = ", ".join(part for part in (error.context, error.problem) if part)
        raise ScenarioError((name, line + what)) from None
    except (yaml.YAMLError, ValueError) as error:  # Control characters; a date that is none.
        raise ScenarioError((name, str(error))) from None


def dump_yaml(data: Any) -> str:
    """The text of plain data, which `load_yaml` reads back equal."""
    text = yaml.dump(data, Dumper=_Dumper, allow_unicode=True, default_flow_style=None, width=100)
    return str(text)


def set_entry(data: Any, setting: str, names: Container[str] = ()) -> None:
    """Changes plain data by "a.b.0.c=value".

    Args:
        data: Lists and dictionaries; changed in place.
        setting: A dotted key, "=", and a value in YAML.
        names: Dotted keys of dictionaries whose names may have dots themselves.

    Raises:
        ScenarioError: There is no such place, or the YAML is broken.
    """
    key, separator, text = setting.partition("=")
    parts = key.split(".")
    if not separator or not all(parts):
        raise ScenarioError((f"--set {setting}", "expected key=value, for example duration=5"))
    value = load_yaml(text, key)
    path = ""
    while True:
        part = ".".join(parts) if path in names else parts[0]
        rest = [] if path in names else parts[1:]
        slot: str | int = part
        if isinstance(data, list):
            if not (part.isascii() and part.isdecimal() and int(part) < len(data)):
                known = ", ".join(map(str, range(len(data)))) or "none"
                raise ScenarioError((path, f"no entry '{part}'; entries: {known}"))
            slot = int(part)
        elif not isinstance(data, dict):
            raise ScenarioError((path, f"{data!r} has no entry '{part}'"))
        if not rest:
            data[slot] = value
            return
        if isinstance(data, dict):
            data.setdefault(slot, {})
        data, parts = data[slot], rest
        path = f"{path}.{part}" if path else part
