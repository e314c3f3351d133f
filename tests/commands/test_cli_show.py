"""`drake-dae print` and `schema`: what one reads before a scenario runs."""

import json

import jsonschema
import pytest

from drake_dae import load_scenario
from drake_dae.cli import main
from drake_dae.scenario.shipped import DEFAULT_SCENARIO, find_scenario


def test_a_shipped_scenario_is_shown_as_it_is(tmp_path, capsys):
    """With its comments, and so that what is printed is a scenario anywhere."""
    assert main(["print", "seven_joint_dome"]) == 0
    text = capsys.readouterr().out
    assert text == find_scenario("seven_joint_dome").read_text()
    (tmp_path / "mine.yaml").write_text(text)
    assert load_scenario(tmp_path / "mine.yaml") == load_scenario(find_scenario("seven_joint_dome"))


def test_where_it_is_and_which_without_a_name(capsys):
    assert main(["print", "--path"]) == 0
    assert capsys.readouterr().out.strip() == str(find_scenario(DEFAULT_SCENARIO))


@pytest.mark.parametrize(
    ("name", "words"),
    [("two_link_wal", "'two_link_wall'"), ("binary.yaml", "binary.yaml")],
)
def test_what_cannot_be_shown(name, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe")
    assert main(["print", name]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert words in line


@pytest.mark.slow
def test_the_schema_is_printed(capsys):
    assert main(["schema"]) == 0
    jsonschema.Draft202012Validator.check_schema(json.loads(capsys.readouterr().out))
