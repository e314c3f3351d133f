"""The page of all keys and the schema for editors say what scenarios may hold, and no more."""

import json
import re

import jsonschema
import pytest
from book.keys import forms, keys_page

from drake_dae import scenario_schema
from drake_dae.commands.texts import custom_tags, editor_schema
from drake_dae.scenario.forms.docstrings import attribute_texts, introduction
from drake_dae.scenario.forms.typed_yaml import TAG, load_yaml
from drake_dae.scenario.shipped import shipped_scenarios


def test_every_form_and_key_is_on_the_page_of_keys_with_its_meaning():
    """They come from docstrings."""
    page = keys_page()
    for title, form in forms(scenario_schema()):
        assert form["description"], title
        (section,) = re.findall(rf"^## {title}$(.*?)(?=^## |\Z)", page, re.DOTALL | re.MULTILINE)
        for name, key in form["properties"].items():
            assert name == TAG or key["description"], f"{title}.{name} has no docstring"
            assert name == TAG or f"\n| `{name}` | " in section, f"{title}.{name}"


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
