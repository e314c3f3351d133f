"""YAML as plain data and back, where a tag `!Sphere` is an entry "_tag" as Drake has it."""

import re
from collections.abc import Callable, Iterable, Iterator
from typing import Any, ClassVar

import yaml  # type: ignore[import-untyped]

from drake_dae.arrays import brief, can_be_written
from drake_dae.errors import ScenarioError

TAG = "_tag"
"""The key under which a mapping holds its tag."""

MOST_VALUES, MOST_TEXT = 100_000, 1_000_000
"""The limits of a file; an alias counts as often as it is used. Shipped scenarios have 200 values
in 4,000 characters."""


def _error(problem: str, node: yaml.Node) -> yaml.MarkedYAMLError:
    return yaml.constructor.ConstructorError(problem=problem, problem_mark=node.start_mark)


class _Loader(yaml.SafeLoader):
    """YAML 1.1 with numbers as in JSON, unique text keys, and tags."""

    yaml_implicit_resolvers: ClassVar = {  # Without the types whose forms are replaced below.
        first: [
            (tag, form)
            for tag, form in resolvers
            if tag.rpartition(":")[2] not in ("int", "float", "timestamp")
        ]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()
        if node is not None:
            self._count(node, {})
        return node

    def _count(self, node: yaml.Node, counts: dict[int, int]) -> int:
        """The number of values of a node, whose keys and texts are checked."""
        if id(node) in counts:
            return counts[id(node)]
        counts[id(node)] = MOST_VALUES  # For an alias inside itself.
        parts, names = node.value, set[str]()
        if isinstance(node, yaml.ScalarNode):
            parts = []
            if not can_be_written(node.value):
                text = "the text has half of a letter (\\ud800 to \\udfff), which no file can hold"
                raise _error(text, node)
        elif isinstance(node, yaml.MappingNode):
            for key, _ in node.value:
                if key.tag not in ("tag:yaml.org,2002:str", "tag:yaml.org,2002:merge"):
                    name = brief(key.value) if isinstance(key, yaml.ScalarNode) else "of a mapping"
                    raise _error(f"the key {name} is not text; quote it", key)
                if key.value in names:
                    raise _error(f"the key '{key.value}' is given twice", key)
                names.add(key.value)
            parts = [part for pair in node.value for part in pair]
        count = counts[id(node)] = 1 + sum(self._count(part, counts) for part in parts)
        if count > MOST_VALUES:
            text = f"more than {MOST_VALUES} values, counting aliases as often as they are used"
            raise _error(text, node)
        return count

    def construct_tagged(self, tag: str, node: yaml.Node) -> dict[str, Any]:
        if not isinstance(node, yaml.MappingNode):
            raise _error(f"the tag !{tag} must be followed by keys, or by {{}}", node)
        return {TAG: f"!{tag}", **self.construct_mapping(node, deep=True)}


_Loader.add_multi_constructor("!", _Loader.construct_tagged)


class _Dumper(yaml.SafeDumper):
    """Keeps the order of keys, and writes tags."""

    def represent_tagged(self, data: dict[str, Any]) -> yaml.MappingNode:
        entries = [(key, value) for key, value in data.items() if key != TAG]
        return self.represent_mapping(data.get(TAG, "tag:yaml.org,2002:map"), entries)


_Dumper.add_representer(dict, _Dumper.represent_tagged)
# YAML 1.1 also has 1_000, 010 for eight and 1:30 for ninety. Here these are text, and 1e5 a number.
_NUMBERS = {
    "int": r"[-+]?(0|[1-9][0-9]*)$",
    "float": r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+|[0-9]+(?=[eE]))([eE][-+]?[0-9]+)?$"
    r"|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$",
}
for _kind, _form in _NUMBERS.items():
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_kind}", re.compile(_form), list("-+.0123456789")
        )


def load_yaml(text: str, name: str) -> Any:
    """YAML as lists, dictionaries and plain values; a tag becomes the entry "_tag"."""
    return load_lines(text, name)[0]


def load_lines(text: str, name: str) -> tuple[Any, Callable[[str], int | None]]:
    """What `load_yaml` returns, and the line of a dotted key; None if the text does not have it."""
    if len(text) > MOST_TEXT:
        raise ScenarioError((name, f"more than {MOST_TEXT} characters, got {len(text)}"))
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        data = None if node is None else loader.construct_document(node)
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        problem = ", ".join(part for part in (error.context, error.problem) if part)
        if "<document start>" in problem:
            problem = "more than one value; several stand in brackets, as in [[-4], [-8]]"
        raise ScenarioError((name, line + problem)) from None
    except yaml.YAMLError as error:  # Control characters.
        raise ScenarioError((name, str(error))) from None
    except RecursionError:
        raise ScenarioError((name, "too many lists or keys in each other")) from None
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
        # Of PyYAML, where a tag such as !!int or !!timestamp has a value that is none.
        raise ScenarioError((name, "a tag of YAML (!!...) does not fit its value")) from None
    return data, lambda key: dict(_lines(node, node, "")).get(key)


def _lines(place: yaml.Node, node: yaml.Node | None, key: str) -> Iterator[tuple[str, int]]:
    """The dotted keys of a node at its place in the text, and the line of each."""
    if node is None:
        return
    yield key, place.start_mark.line + 1
    parts = []
    if isinstance(node, yaml.SequenceNode):
        parts = [(str(index), part, part) for index, part in enumerate(node.value)]
    elif isinstance(node, yaml.MappingNode):
        parts = [(name.value, name, part) for name, part in node.value]
    for name, start, part in parts:
        yield from _lines(start, part, f"{key}.{name}" if key else name)


def first_name(names: Iterable[str], key: str) -> str | None:
    """The longest of some names with which a dotted key begins; None if it begins with none."""
    found = [name for name in names if f"{key}.".startswith(f"{name}.")]
    return max(found, key=len, default=None)


def dump_yaml(data: Any) -> str:
    """The text of plain data, which `load_yaml` reads back equal."""
    options = {"allow_unicode": True, "default_flow_style": None, "width": 100}
    return str(yaml.dump(data, Dumper=_Dumper, **options))
