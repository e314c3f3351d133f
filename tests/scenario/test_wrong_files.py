"""Shipped scenarios with one mistake each: it is told in one line, with its place.

`make campaign` builds and runs such files; here they are only read.
"""

import random
import re

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


def mistakes():
    draw, texts = random.Random(50), [path.read_text() for path in shipped_scenarios().values()]
    known = {key for form in scenario_schema()["$defs"].values() for key in form["properties"]}
    for kind, count in KINDS.items():
        for number in range(count):
            lines = draw.choice(texts).splitlines()
            if kind == "text":
                row = draw.randrange(len(lines))
                at = draw.randrange(len(lines[row]) + 1)
                lines[row] = lines[row][:at] + draw.choice(PIECES) + lines[row][at:]
            else:
                row, lines[row] = draw.choice(list(changed(kind, lines, known, draw)))
            yield f"{kind}{number}", "\n".join(lines), row + 1, kind


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


def test_each_of_300_mistakes_is_told_in_one_line_with_its_place(tmp_path):
    file, wrong = tmp_path / "wrong.yaml", []
    for name, text, line, kind in mistakes():
        file.write_text(text)
        try:
            load_scenario(file)
        except ScenarioError as error:
            problems = error.problems
        else:
            wrong += [] if kind == "text" else [(name, "nothing is wrong")]
            continue
        told = [text for _, text in problems]
        is_clear = all(key and text and "\n" not in key + text for key, text in problems)
        is_placed = kind == "text" or any(f"[wrong.yaml:{line}]" in text for text in told)
        if not (is_clear and is_placed and len({*problems}) == len(problems)):
            wrong.append((name, told))
    assert not wrong
