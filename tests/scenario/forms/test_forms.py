"""Dataclasses from outside the package as forms: read, refused, written back."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import pytest
from numpy.typing import ArrayLike
from pydrake.systems.analysis import SimulatorConfig

from drake_dae.errors import ModelError, ScenarioError
from drake_dae.scenario.forms.forms import Choice, Form
from drake_dae.scenario.forms.reader import Reader
from drake_dae.scenario.forms.typed_yaml import dump_yaml, load_yaml, set_entry
from drake_dae.scenario.forms.values import Numbers, Triple
from drake_dae.scenario.scenario import scenario_reader


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


Surfaces = Annotated[
    Bowl | Annotated[Cone, Form(tag="!Funnel", defaults={"angle": 30.0})],
    Choice({tuple[float, float, float]: Triple}),
]


@dataclass(frozen=True, eq=False)
class Everything:
    contact: Annotated[Contact, Form({Surface: Surfaces})]
    spring: Annotated[Spring, Form({ArrayLike: Numbers})] = field(
        default_factory=lambda: Spring(1.0)
    )
    config: Annotated[SimulatorConfig, Form(defaults={"accuracy": 0.25})] = field(
        default_factory=SimulatorConfig
    )
    free: dict[str, dict[str, int]] = field(default_factory=dict)


READER = Reader(Everything)


def read(text, *settings):
    data = load_yaml(text, "text")
    for setting in settings:
        set_entry(data, setting, READER.free_names)
    return READER.read(data)


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


def test_what_a_class_refuses_is_reported_in_one_line_at_its_key():
    ((key, text),) = problems("contact: {surface: !Funnel {apex: [0, 0, 0], angle: 90}}").items()
    assert (key, text[:5], "\n" in text) == ("contact.surface", "angle", False)


def test_fields_that_are_not_arguments_are_no_keys():
    found = problems("contact: {surface: !Funnel {apex: [0, 0, 0], height: 2}}")
    assert all(name in found["contact.surface"] for name in ("'height'", "apex", "angle"))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2", 2.0),
        ("[2]", 2.0),
        ("[[2]]", 2.0),
        ("1e-8", 1e-8),
        ("[1, 2e3]", [1.0, 2000.0]),
        ("[[1, 2], [3, 4]]", [[1.0, 2.0], [3.0, 4.0]]),
    ],
)
def test_numbers(text, value):
    head = "contact: {surface: {}}\nspring: {stiffness: 5}"
    for key in ("stiffness", "inertia", "geometry"):
        assert getattr(read(head, f"spring.{key}={text}").spring, key) == value
    assert read(head, "spring.inertia=").spring.inertia is None


def test_a_class_of_drake_with_defaults():
    made = read("contact: {surface: {}}\nconfig: {max_step_size: 1}")
    assert (made.config.max_step_size, made.config.accuracy) == (1.0, 0.25)
    # Drake's own defaults are left to Drake, whose fields differ between versions.
    assert READER.write(made)["config"] == {"max_step_size": 1.0, "accuracy": 0.25}
    found = problems("contact: {surface: {}}\nconfig: {accuracy: high, max_step: 1}")
    assert "'high'" in found["config.accuracy"]
    assert "'max_step_size'" in found["config"]


def test_names_with_dots():
    made = read("contact: {surface: {}}", "free.a.b={c: 1}", "free.d={}")
    assert made.free == {"a.b": {"c": 1}, "d": {}}


def test_what_is_written_reads_back():
    made = read(
        "contact: {surface: !Funnel {apex: [1, 2, 3]}, names: [a, 'on', 'é: 1']}\n"
        "spring: {stiffness: [[1, 2], [3, 4]]}\nfree: {x: {y: 1}}"
    )
    text = dump_yaml(READER.write(made))
    assert text.splitlines()[0:2] == ["contact:", "  surface: !Funnel"]
    again = read(text)
    assert (again.contact, again.free) == (made.contact, made.free)
    np.testing.assert_array_equal(again.spring.stiffness, made.spring.stiffness)
    assert READER.write(again) == READER.write(made)


def test_an_array_is_written_as_lists():
    everything = Everything(Contact(Bowl()), Spring(np.eye(2), geometry=np.array([1.0, 2.0])))
    data = READER.write(everything)["spring"]
    assert data == {"stiffness": [[1, 0], [0, 1]], "inertia": None, "geometry": [1, 2]}


def test_merged_keys_and_aliases():
    text = "contact: {surface: &bowl {depth: 3}}\nfree:\n  a: &one {x: 1}\n  b: {<<: *one, y: 2}"
    assert read(text).free == {"a": {"x": 1}, "b": {"x": 1, "y": 2}}


@pytest.mark.parametrize("text", ["free: &x {a: *x}", "free: &x [*x]", "contact: &x !Y {a: *x}"])
def test_an_alias_inside_itself_is_refused(text):
    assert problems(text)


def test_the_json_schema_knows_tags():
    bowl, cone = READER.schema["properties"]["contact"]["properties"]["surface"]["oneOf"]
    assert bowl["properties"]["_tag"]["const"] == "!Bowl"
    assert "_tag" not in bowl.get("required", [])
    assert set(cone["required"]) == {"_tag", "apex"}


def test_names_are_free_where_the_json_schema_allows_any_key():
    def free(schema, path):
        if schema.get("additionalProperties"):
            yield ".".join(path)
        some = [inner for inner in schema.get("anyOf", []) if inner.get("type") != "null"]
        for inner in [*(some if len(some) == 1 else []), *schema.get("oneOf", [])]:
            yield from free(inner, path)
        if isinstance(schema.get("items"), dict):
            yield from free(schema["items"], [*path, "*"])
        for name, inner in schema.get("properties", {}).items():
            yield from free(inner, [*path, name])

    reader = scenario_reader()
    assert {"references", "task.phases.*.references"} < reader.free_names
    assert reader.free_names == set(free(reader.schema, []))


def test_a_class_at_several_places_has_the_tag_and_the_defaults_of_each():
    @dataclass
    class Places:
        plain: Cone
        steep: Annotated[Cone, Form(defaults={"angle": 80.0})]
        chosen: Surfaces

    apex = "apex: [1, 2, 3]"
    text = f"plain: {{{apex}, angle: 5}}\nsteep: {{{apex}}}\nchosen: !Funnel {{{apex}}}"
    made = Reader(Places).read(load_yaml(text, "text"))
    assert (made.plain.angle, made.steep.angle, made.chosen.angle) == (5.0, 80.0, 30.0)
    with pytest.raises(ScenarioError, match="steep: "):
        Reader(Places).read(load_yaml(text.replace("steep: ", "steep: !Funnel "), "text"))
