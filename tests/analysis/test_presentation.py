"""An analysis as text, Markdown, JSON and one line; arguments that make no sense."""

import json
import re

import pytest
from problems import (
    PROBLEMS,
    double_integrator,
    redundant,
)
from problems.found import findings
from runs import some

from drake_dae.analysis.analyze import analyze
from drake_dae.analysis.report import Finding
from drake_dae.errors import ModelError


@pytest.mark.slow
def test_text_is_aligned_and_not_too_wide(problem):
    lines = str(analyze(problem.system, count=3)).splitlines()
    assert max(map(len, lines)) <= 100
    assert all(line == line.rstrip() for line in lines)
    start = next(i for i, line in enumerate(lines) if line.startswith("assumption"))
    rows = lines[start : start + 8]
    for row in rows[1:]:
        assert row[rows[0].index("finding") - 1] == " "
        assert row[rows[0].index("finding") :].startswith(tuple(map(str, Finding)))


@pytest.mark.slow
@pytest.mark.parametrize("problem", some(PROBLEMS, of=3, first=1), indirect=True)
def test_markdown_has_the_same_words(problem):
    analysis = analyze(problem.system, count=3)
    markdown = analysis._repr_markdown_()
    assert markdown == analysis.to_markdown()
    words = re.findall(r"[^\s|]+", re.sub(r"(:--|--:)", "", markdown.replace("\\|", "|")))
    assert words == str(analysis).replace("|", " ").split()
    tables = [block for block in markdown.split("\n\n") if block.startswith("|")]
    for table in tables:
        assert len({line.count("|") for line in table.splitlines()}) == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", some([*PROBLEMS, "redundant"], of=3))
def test_the_dictionary_is_json(name):
    twice = redundant(lambda x: [x[0], x[0]])
    system = twice if name == "redundant" else PROBLEMS[name]().system
    analysis = analyze(system, count=3)
    found = json.loads(json.dumps(analysis.to_dict(), allow_nan=False))
    assert found == analysis.to_dict()
    names = [signal.name for signal in system.constraint_output_signals]
    assert found["constraint_degrees"] == dict(zip(names, analysis.constraint_degrees, strict=True))
    assert found["index"] == analysis.index
    assert [a["finding"] for a in found["assumptions"]] == findings(analysis)
    assert found["problems"] == list(analysis.problems)
    margin = found["assumptions"][1]["margin"]
    if margin:
        assert margin["relative"] == analysis.assumptions[1].margin.relative
        assert len(margin["state"]) == system.num_states


BAD_ARGUMENTS = {
    "a list as region": ({"region": [(0, 1)]}, "region"),
    "text as seed": ({"seed": "a"}, "seed.*'a'"),
    "no function": ({"reference": [0.0] * 3, "times": [0, 1]}, "reference"),
    "no value": ({"reference": lambda t: None, "times": [0, 1]}, "3 .*None"),
    "text": ({"reference": lambda t: "a", "times": [0, 1]}, r"reference\(0\)"),
}


@pytest.mark.parametrize("what", BAD_ARGUMENTS)
def test_arguments_of_a_wrong_kind_are_refused(what):
    arguments, message = BAD_ARGUMENTS[what]
    with pytest.raises(ModelError, match=message):
        analyze(double_integrator(), **arguments)


def test_what_is_no_system_is_refused():
    with pytest.raises(ModelError, match=r"system.*None"):
        analyze(None)


def test_one_line_at_the_prompt():
    assert repr(analyze(double_integrator())) == "Analysis('double integrator': no problem found)"
    constant = double_integrator(l=lambda x: 3.0)
    assert repr(analyze(constant)) == "Analysis('double integrator': 1 problem)"
