"""Where each equation of the paper is computed, and which test proves it.

The number of an equation stands as a comment at the line that computes it, `# (13), (14)`, and as
the mark `@pytest.mark.equation(13, 14)` at the test that holds that line against another source.
"""

import ast
import io
import re
import tokenize
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]
LAST = 83

_NUMBERS = re.compile(r"# \(\d+\)(?:(?:, |-)\(\d+\))*$")

_ROBOT = dict.fromkeys((46, 47, 48, 49), "(9)-(12)") | dict.fromkeys((50, 51, 52, 53), "(21)")
_ROBOT |= {42: "(4) with r = 2", 54: "(26)", 55: "(26)", 56: "(26)", 57: "(25)"}

WITHOUT_LINE = {
    5: "the form of a feedback; (28) is the one that is used",
    6: "the closed loop: Drake's Diagram of law and plant is that system",
    7: "see (6)",
    8: "see (6)",
    17: "follows from (9) and (13); nothing computes it",
    18: "follows from (9) and (13); nothing computes it",
    19: "follows from (10) and (14); nothing computes it",
    23: "the derivative of (20) along (1); (26) is what is left of it on N*",
    33: "follows from (30) and (32)",
    **{k: f"for the robot (43)-(45) a special case of {what}" for k, what in _ROBOT.items()},
    61: "what (59) leaves of the force error; nothing computes it",
    62: "(29) of the positions",
    63: "(29) of the forces",
    **dict.fromkeys((66, 67, 68, 76, 77, 78), "(38)-(40), whatever drives the joints"),
    **dict.fromkeys((69, 70, 79, 80), "(28) and ubar of the chain of joints, springs and motors"),
}
"""Why no line computes an equation."""


def lines() -> dict[int, list[str]]:
    """Number of an equation -> the lines of the library that compute it, "file:line"."""
    found = defaultdict(list)
    for path in sorted((ROOT / "drake_dae").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if "# (" not in text:
            continue
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT and _NUMBERS.match(token.string):
                for number in _listed(token.string):
                    found[number].append(f"{path.relative_to(ROOT)}:{token.start[0]}")
    return found


def proofs() -> dict[int, list[str]]:
    """Number of an equation -> the tests that prove it, "file::test"."""
    found = defaultdict(list)
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        text = path.read_text(encoding="utf-8")
        if "mark.equation" not in text:
            continue
        for test in ast.parse(text).body:
            for mark in getattr(test, "decorator_list", ()):
                if ast.unparse(mark).startswith("pytest.mark.equation("):
                    for number in mark.args:
                        found[number.value].append(f"{path.relative_to(ROOT)}::{test.name}")
    return found


def _listed(comment: str) -> list[int]:
    """The numbers of "# (9), (17)-(19)"."""
    numbers = []
    for part in comment.removeprefix("# ").split(", "):
        ends = [int(number) for number in re.findall(r"\d+", part)]
        numbers += range(ends[0], ends[-1] + 1)
    return numbers


def table() -> str:
    """The table in Markdown: number, line or the reason why there is none, test."""
    places, tests = lines(), proofs()
    rows = ["| equation | line | test |", "|---|---|---|"]
    for number in range(1, LAST + 1):
        place = "<br>".join(places.get(number, [WITHOUT_LINE.get(number, "")]))
        rows.append(f"| ({number}) | {place} | {'<br>'.join(tests.get(number, ['']))} |")
    return "\n".join(rows)


if __name__ == "__main__":
    print(table())
