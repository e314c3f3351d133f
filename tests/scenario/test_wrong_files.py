"""Shipped scenarios with one mistake each: it is told in one line, with its place.

`make campaign` builds and runs such files; here they are only read.
"""

import random
import re

import pytest

from drake_dae import load_scenario
from drake_dae.errors import ScenarioError
from drake_dae.scenario import scenario_schema
from drake_dae.scenario.shipped import shipped_scenarios

KINDS = {"key": 90, "value": 90, "tag": 60, "text": 60}
PIECES = (":", "- ", "[", "]", "{", "}", "&a ", "*a", "!X ", '"', "'", "#", "\t", "\n", "\0", "?")
WRONG = {  # By what the value was.
    r"\[.*\]|-?[\d.]+(e-?\d+)?": ("abc", "true", "{a: 1}", "[[]]", ".nan", "1_000"),
    r"true|false": ("3", "maybe", "[]"),
    r"[\w/:.]+": ("3", "true", "[[a]]", "{a: b}"),
}


def mistakes(kind):
    draw, texts = random.Random(50), [path.read_text() for path in shipped_scenarios().values()]
    known = {key for form in scenario_schema()["$defs"].values() for key in form["properties"]}
    for _ in range(KINDS[kind]):
        lines = draw.choice(texts).splitlines()
        if kind == "text":
            row = draw.randrange(len(lines))
            at = draw.randrange(len(lines[row]) + 1)
            lines[row] = lines[row][:at] + draw.choice(PIECES) + lines[row][at:]
        else:
            row, lines[row] = draw.choice(list(changed(kind, lines, known, draw)))
        yield "\n".join(lines), row + 1


def changed(kind, lines, known, draw):
    """Each line that can have such a mistake, and the line with it."""
    free, above = False, ""
    for row, line in enumerate(lines):
        match = re.fullmatch(r"([- ]*)([a-z_]+): *(\S.*)?", line.split("  #")[0])
        if re.match(r"\w", line):
            above = line.split(":")[0]
        free = above in ("references", "exogenous", "parameters", "bounds")
        if kind == "tag" and (tag := re.search(r"![A-Z]\w+", line)):
            yield row, line.replace(tag[0], tag[0][:-1] + "x")
        if match is None or free or match[2] not in known or above == "description":
            continue
        if kind == "key":
            yield row, line.replace(f"{match[2]}:", f"{match[2]}x:", 1)
        found = [w for form, w in WRONG.items() if re.fullmatch(form, match[3] or "")]
        if kind == "value" and found:
            yield row, f"{match[1]}{match[2]}: {draw.choice(found[0])}"


@pytest.mark.parametrize("kind", KINDS)
def test_a_mistake_is_told_in_one_line_with_its_place(kind, tmp_path):
    file = tmp_path / "wrong.yaml"
    for text, line in mistakes(kind):
        file.write_text(text)
        try:
            load_scenario(file)
        except ScenarioError as error:
            problems = error.problems
        else:
            assert kind == "text", f"nothing is wrong in line {line}: {text}"
            continue
        assert problems == tuple(dict.fromkeys(problems))
        assert all(key and told and "\n" not in key + told for key, told in problems)
        if kind != "text":
            assert any(f"[wrong.yaml:{line}]" in told for _, told in problems), text
