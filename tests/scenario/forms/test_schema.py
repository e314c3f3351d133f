"""The page of all keys and the schema for editors say what scenarios may hold, and no more."""

import re

import pytest
from book.keys import forms, keys_page
from runs import scenario_validator, untagged

from drake_dae.scenario import scenario_schema
from drake_dae.scenario.shipped import shipped_scenarios
from drake_dae.scenario.typed_yaml import load_yaml


def test_every_form_and_key_is_on_the_page_of_keys_with_its_meaning():
    """They come from docstrings."""
    page = keys_page()
    for title, form in forms(scenario_schema()):
        assert form["description"], title
        (section,) = re.findall(rf"^## {title}$(.*?)(?=^## |\Z)", page, re.DOTALL | re.MULTILINE)
        for name, key in form["properties"].items():
            assert key["description"], f"{title}.{name} has no docstring"
            assert f"\n| `{name}` | " in section, f"{title}.{name}"


@pytest.mark.slow
def test_editors_accept_shipped_scenarios_and_no_wrong_keys():
    validator, used = scenario_validator(), set()
    for path in shipped_scenarios().values():
        text = path.read_text()
        used |= set(re.findall(r"(?<= )![A-Z]\w+", text))
        data = untagged(load_yaml(text, path.name))
        assert not list(validator.iter_errors(data)), path.stem
        assert list(validator.iter_errors({**data, "duratoin": 5}))
    assert validator.is_valid({"robot": {"file": "a"}, "references": {}, "_anchors": 1})
    assert not validator.is_valid({"robot": {"file": "a", "bsae": {}}, "references": {}})
    assert all(f"{tag} mapping" in scenario_schema()["$comment"] for tag in used)
