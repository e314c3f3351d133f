"""The page of all keys and the schema for editors say what scenarios may hold, and no more."""

import contextlib
import json
import re

import jsonschema
import pytest

from drake_dae import scenario_schema
from drake_dae.errors import ScenarioError
from drake_dae.scenario.forms.docstrings import attribute_texts, introduction
from drake_dae.scenario.forms.typed_yaml import TAG, load_yaml
from drake_dae.scenario.manual.entries import EXAMPLES, NOTHING, OWN, entries, unit_of
from drake_dae.scenario.manual.page import keys_page
from drake_dae.scenario.manual.schema import custom_tags, editor_schema
from drake_dae.scenario.scenario import read_scenario, scenario_data
from drake_dae.scenario.shipped import shipped_scenarios

PURE = {
    ("Observer", "largest_friction"),
    ("Scenario", "control_weights"),
    ("Scenario", "compliances"),
    ("Scenario", "parameters"),  # Each has its own.
    ("Scenario", "plant_parameters"),  # Likewise.
    ("!ImplicitSurface", "parameters"),  # Likewise.
    ("!Plane", "normal"),
    ("!Plate", "normal"),
    ("Peg", "axis"),
    ("!Sphere", "axis"),
    ("!Cylinder", "axis"),
    ("!Cylinder", "zero"),
    ("!Torus", "axis"),
    ("!HeightMap", "normal"),
    ("!MeshSurface", "normal"),
    ("!PointOnSurface", "friction"),
    ("!JointCoupler", "ratio"),
    ("!AxisNormalToSurface", "axis"),
    ("!Blade", "axis"),
    ("Peg", "axis"),
    ("!RollingWheel", "axle"),
    ("!RollingWheel", "normal"),
    ("!RollingBall", "along"),
    ("!ForceCombination", "weights"),
    ("!Circle", "turns"),
    ("!Csv", "tolerance"),
    ("!DcMotors", "gear_ratio"),
    ("!SpringCascade", "damping"),
    ("!Impedance", "damping_ratio"),
    ("!MeasuredForce", "gain"),
    ("Sampling", "loss"),
    ("Packets", "late"),
    ("Packets", "loss"),
    ("!CompliantContact", "friction"),
    ("!MultibodyPlant", "friction"),
    ("!Unilateral", "restitution"),
    ("ScenarioTask", "pace"),
    ("WithinLimits", "efforts"),
    ("WithinLimits", "joint_speeds"),
    ("FrictionCone", "friction"),
    ("Presliding", "static_ratio"),
    ("SimulatorConfig", "accuracy"),
    ("SimulatorConfig", "target_realtime_rate"),
}
"""Keys with numbers that have no unit: directions, ratios, weights."""

GONE_SOON = {"publish_every_time_step"}
"""Drake 1.51 has it, Drake 1.58 has not: no example of it."""


def forms(schema):
    """The title and the properties of each form, found without the code of the page."""
    if isinstance(schema, list):
        for one in schema:
            yield from forms(one)
    elif isinstance(schema, dict):
        if isinstance(schema.get("properties"), dict):
            properties = dict(schema["properties"])
            tag = properties.pop(TAG, {}).get("const", schema["title"])
            yield tag, properties
        for value in schema.values():
            yield from forms(value)


def test_every_key_is_on_the_page_with_an_example():
    """A new form takes an example in drake_dae/scenario/manual/examples.yaml, and a docstring."""
    known, found = dict(forms(scenario_schema())), {entry.title: entry for entry in entries()}
    assert set(found) == set(known)
    page = keys_page()
    for title, properties in known.items():
        entry = found[title]
        assert [key.name for key in entry.keys] == list(properties), title
        shown = {name for example in entry.examples for name in example} - {TAG}
        assert shown == set(properties) - GONE_SOON, (
            f"{title}: its example lacks keys, or has others"
        )
        (section,) = re.findall(rf"^## {title}$(.*?)(?=^## |\Z)", page, re.DOTALL | re.MULTILINE)
        assert all(f"\n| `{name}` | " in section for name in properties)
        assert entry.text
        for key in entry.keys:
            assert key.text, f"{title}.{key.name} has no docstring"
            assert key.unit or not key.is_number or (title, key.name) in PURE, (title, key.name)


def read(data):
    return read_scenario(data, EXAMPLES.parent)


@pytest.mark.slow
def test_examples_are_scenarios():
    """Each example stands in a scenario that is read, and is written so that it reads back."""
    for entry in entries():
        for example in entry.examples:
            scenario = read(entry.scenario(dict(example)))
            assert read_scenario(scenario_data(scenario)) == scenario


def test_defaults_are_those_that_hold():
    """What the page calls the default, written out, is what holds without the key."""
    found = {(entry.title, key.name): key.default for entry in entries() for key in entry.keys}
    assert found["Scenario", "duration"] == 10.0
    assert found["Scenario", "robot"] is NOTHING
    assert found["Scenario", "start"] is OWN
    assert found["Scenario", "gains"] is None
    assert found["SimulatorConfig", "accuracy"] == 1e-6
    assert found["!PointOnSurface", "stiction_tolerance"] == 1e-3
    tried = 0
    for entry in entries():
        for key in entry.keys:
            if key.default in (NOTHING, OWN):
                continue
            example = {name: one for name, one in entry.examples[0].items() if name != key.name}
            with contextlib.suppress(ScenarioError):  # It may need what another key has.
                without = read(entry.scenario(example))
                assert read(entry.scenario(example | {key.name: key.default})) == without
                tried += 1
    assert tried > 100


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("A point of the plane, m, shape (3,).", "m"),
        ("D in N m s/rad (N s/m), not negative.", "N m s/rad (N s/m)"),
        ("Its position in rad or m where it stays.", "rad or m"),
        ("The mean, in the output's unit.", "output's unit"),
        ("How it moves in many ways, more or less.", ""),
        ("The gear ratio, named m here.", ""),
    ],
)
def test_units_are_found_in_docstrings(text, unit):
    assert unit_of(text) == unit


def test_docstrings_are_read_with_those_of_bases():
    class Base:
        """A base.

        Attributes:
            first, second: Both of them,
                on two lines.
        """

    class Derived(Base):
        """A class: it
        derives.

        Attributes:
            third: With a colon: here.

        Raises:
            ValueError: Never.
        """

    assert attribute_texts(Derived) == {
        "first": "Both of them, on two lines.",
        "second": "Both of them, on two lines.",
        "third": "With a colon: here.",
    }
    assert introduction(Derived.__doc__) == "A class: it\nderives."


def plain(data):
    """What an editor sees behind tags."""
    if isinstance(data, dict):
        return {key: plain(value) for key, value in data.items() if key != TAG}
    return [plain(one) for one in data] if isinstance(data, list) else data


@pytest.mark.slow
def test_editors_accept_shipped_scenarios_and_no_wrong_keys():
    schema = json.loads(json.dumps(editor_schema()))
    validator = jsonschema.Draft202012Validator(schema)
    jsonschema.Draft202012Validator.check_schema(schema)
    used = set()
    for path in shipped_scenarios().values():
        text = path.read_text()
        used |= set(re.findall(r"(?<= )![A-Z]\w+", text))
        data = plain(load_yaml(text, path.name))
        assert not list(validator.iter_errors(data)), path.stem
        assert list(validator.iter_errors({**data, "duratoin": 5}))
    assert validator.is_valid({"robot": {"file": "a"}, "references": {}, "_anchors": 1})
    assert not validator.is_valid({"robot": {"file": "a", "bsae": {}}, "references": {}})
    assert used <= {tag.split()[0] for tag in custom_tags()}
    about = schema["properties"]["robot"]["properties"]["file"]["description"]
    assert about.startswith("A URDF")
