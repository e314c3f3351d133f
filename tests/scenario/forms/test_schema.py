"""The page of all keys and the schema for editors say what scenarios may hold, and no more."""

import re

from book.keys import forms, keys_page
from runs import scenario_validator

from drake_dae.scenario import scenario_schema
from drake_dae.scenario.shipped import shipped_scenarios


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
