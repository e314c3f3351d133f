"""Dataclasses from outside the package as forms, and the schema of scenarios for editors."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest
from book.keys import forms, keys_page
from numpy.typing import ArrayLike
from runs import scenario_validator

from drake_dae.errors import ModelError, ScenarioError
from drake_dae.scenario import scenario_schema
from drake_dae.scenario.form import Family, Key, Reader, dump_yaml, keys_of, load_lines, load_yaml
from drake_dae.scenario.shipped import shipped_scenarios


class Surface:
    """A type that is no data."""


@dataclass(frozen=True)
class Cone(Surface):
    apex: tuple[float, float, float]
    angle: float
    height: float = field(init=False)

    def __post_init__(self):
        if not 0 < self.angle < 90:
            raise ModelError(f"angle must be between 0 and 90 degrees,\n  got {self.angle}")
        object.__setattr__(self, "height", 1.0)


@dataclass(frozen=True)
class Bowl(Surface):
    depth: float = 2.0


@dataclass(frozen=True, eq=False)
class Spring:
    stiffness: ArrayLike
    inertia: ArrayLike | None = None
    geometry: Callable[[float], float] | ArrayLike = 1.0


@dataclass(frozen=True)
class Contact:
    surface: Surface
    names: Sequence[str] = ()


class Config:
    """No dataclass, as of Drake."""

    def __init__(self, accuracy=0.25, step=0.1):
        self.accuracy, self.step = accuracy, step


@dataclass(frozen=True, eq=False)
class Everything:
    contact: Contact
    spring: Spring = field(default_factory=lambda: Spring(1.0))
    config: Config = field(default_factory=Config)
    free: dict[str, dict[str, int]] = field(default_factory=dict)


READER = Reader(
    Everything,
    {Surface: Family({"!Bowl": Bowl, "!Funnel": Cone})},
    {
        Config: {"accuracy": Key(float, 0.25, "How well."), "step": Key(float, 0.1, "How far.")},
        Cone: {**keys_of(Cone), "angle": Key(float, 30.0, "")},
    },
)


def read(text, *settings):
    data, line_of = load_lines(text, "text")
    for setting in settings:
        key, _, value = setting.partition("=")
        READER.put(data, key, load_yaml(value, key))
    return READER.read(data, place_of=lambda key: f"[{line_of(key)}]")


def problems(text, *settings):
    with pytest.raises(ScenarioError) as caught:
        read(text, *settings)
    return dict(caught.value.problems)


def test_a_member_has_a_tag_and_defaults_of_its_own():
    cone = read("contact: {surface: !Funnel {apex: [1, 2, 3]}}").contact.surface
    assert cone == Cone((1.0, 2.0, 3.0), 30.0)
    assert cone.height == 1.0
    assert read("contact: {surface: {depth: 3}}").contact.surface == Bowl(3.0)
    found = problems("contact: {surface: !Cone {}}")["contact.surface"]
    assert all(tag in found for tag in ("!Bowl", "!Funnel", "!Cone"))
    assert "!Funnel" in problems("contact: !Funnel {surface: {}}")["contact"]


def test_all_problems_are_told_at_once_with_their_lines():
    found = problems(
        "contact:\n"
        "  surface: !Funnel {apex: [0, 0, 0],\n"
        "    angle: 90}\n"
        "  naems: []\n"
        "spring: {inertia: abc}\n"
        "config:\n"
        "  accuracy: high\n"
    )
    assert {key: text[-3:] for key, text in found.items()} == {
        "contact.surface": "[2]",
        "contact": "[4]",
        "spring": "[5]",
        "spring.inertia": "[5]",
        "config.accuracy": "[7]",
    }
    assert "'names'" in found["contact"]
    assert not any("\n" in text for text in found.values())


def test_what_differs_from_the_defaults_is_written_and_reads_back():
    made = read(
        "contact: {surface: !Funnel {apex: [1, 2, 3]}, names: [a, 'on', '1e5', 'é: 1']}\n"
        "spring: {stiffness: [[1, 2], [3, 4]]}\nfree: {x: {y: 1}}\nconfig: {step: 2}"
    )
    text = dump_yaml(READER.write(made))
    assert text.splitlines()[0:2] == ["contact:", "  surface: !Funnel"]
    assert not {"angle", "inertia", "accuracy"} & set(text.replace(":", " ").split())
    again = read(text)
    assert (again.contact, again.free, again.config.step) == (made.contact, made.free, 2.0)
    np.testing.assert_array_equal(again.spring.stiffness, made.spring.stiffness)
    arrays = Everything(Contact(Bowl()), Spring(np.eye(2), geometry=np.array([1.0, 2.0])))
    assert READER.write(arrays)["spring"] == {"stiffness": [[1, 0], [0, 1]], "geometry": [1, 2]}


def test_every_form_and_key_is_on_the_page_of_keys_with_its_meaning():
    """They come from docstrings."""
    page = keys_page()
    for title, form in forms(scenario_schema()):
        assert form["description"], title
        (section,) = re.findall(rf"^## {title}$(.*?)(?=^## |\Z)", page, re.DOTALL | re.MULTILINE)
        for name, key in form["properties"].items():
            assert key["description"], f"{title}.{name} has no docstring"
            assert f"\n| `{name}` | " in section, f"{title}.{name}"


def test_editors_are_told_of_wrong_keys_and_of_all_tags():
    """That shipped scenarios are accepted is tested with their runs."""
    used = set()
    for path in shipped_scenarios().values():
        used |= set(re.findall(r"(?<= )![A-Z]\w+", path.read_text()))
    assert all(f"{tag} mapping" in scenario_schema()["$comment"] for tag in used)
    validator = scenario_validator()
    assert validator.is_valid({"robot": {"file": "a"}, "references": {}, "_anchors": 1})
    assert not validator.is_valid({"robot": {"file": "a", "bsae": {}}, "references": {}})
