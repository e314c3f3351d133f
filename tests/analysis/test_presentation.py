"""An analysis as text, Markdown, JSON and one line; arguments that make no sense."""

import json

import pytest
from problems import PROBLEMS, redundant
from problems.found import findings
from runs import some

from drake_dae.analysis import Finding, analyze


@pytest.mark.slow
@pytest.mark.parametrize("name", some(PROBLEMS, of=6))
def test_text_is_aligned_and_not_too_wide(name):
    lines = str(analyze(PROBLEMS[name]().system, count=3)).splitlines()
    assert max(map(len, lines)) <= 100
    assert all(line == line.rstrip() for line in lines)
    start = next(i for i, line in enumerate(lines) if line.startswith("assumption"))
    rows = lines[start : start + 7]
    for row in rows[1:]:
        assert row[rows[0].index("finding") - 1] == " "
        assert row[rows[0].index("finding") :].startswith(tuple(map(str, Finding)))


def test_text_says_where_the_matrices_are_nearest_to_singular():
    """On x^2 + y^2 = 1 the pendulum's A(x) is the same everywhere, and its B(x) is not."""
    text = str(analyze(PROBLEMS["pendulum"]().system, count=3))
    assert "A(x) is the same at all examined states." in text
    assert "B(x) is nearest to singular at x=" in text


@pytest.mark.slow
@pytest.mark.parametrize("name", some(["redundant", *PROBLEMS], of=6))
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
