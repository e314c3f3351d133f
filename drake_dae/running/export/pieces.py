"""Long functions of C in pieces, since a compiler's time grows with the square of their length."""

import re
from collections.abc import Sequence

LONGEST = 2000
"""The longest function, in assignments: with 60,000 in one piece clang takes 180 s of a processor,
in pieces of 2,000 it takes 9 s, for code that is larger by two fifths."""

_NAME = re.compile(r"\ba\d+\b")
_FUNCTION = re.compile(
    r"(?P<head>static int (?P<name>casadi_f\d+)\([^\n]*\{)\n(?P<body>(?:  [^\n]*\n)*)\}"
)
_DECLARED = "  casadi_real a"
_GIVEN = "const casadi_real** arg, casadi_real** res, casadi_real* kept"


def in_pieces(source: str, longest: int = LONGEST) -> str:
    """The C source of CasADi with its long functions in pieces that are called one after the other.

    What a piece computes and a later one reads is kept in an array.

    Args:
        source: What CasADi wrote, for a compiler that knows __attribute__((noinline)).
        longest: The largest number of assignments in a piece.
    """
    return _FUNCTION.sub(lambda found: _split(found, longest), source)


def _split(function: re.Match[str], longest: int) -> str:
    rows = [row for row in function["body"].splitlines() if not row.startswith(_DECLARED)]
    rows = [row for row in rows if row.strip() != "return 0;"]
    if len(rows) <= longest:
        return function[0]
    pieces = [rows[i : i + longest] for i in range(0, len(rows), longest)]
    uses = [_uses(piece) for piece in pieces]
    # What is read from each piece on, before it is written anew.
    needed = [set[str]()]
    for read, written in reversed(uses):
        needed.insert(0, read | (needed[0] - written))
    place = {name: number for number, name in enumerate(sorted(set().union(*needed)))}
    name, text, calls = function["name"], "", ""
    for k, (piece, (read, written)) in enumerate(zip(pieces, uses, strict=True)):
        begin = [
            f"  casadi_real {one}{f' = kept[{place[one]}]' if one in read else ''};"
            for one in sorted(read | written)
        ]
        end = [f"  kept[{place[one]}] = {one};" for one in sorted(written & needed[k + 1])]
        head = f"static void __attribute__((noinline)) {name}_{k}({_GIVEN}) {{"
        text += "\n".join([head, *begin, *piece, *end, "}", "", ""])
        calls += f"  {name}_{k}(arg, res, kept);\n"
    kept = f"  casadi_real kept[{len(place) + 1}];\n"
    return f"{text}{function['head']}\n{kept}{calls}  return 0;\n}}"


def _uses(rows: Sequence[str]) -> tuple[set[str], set[str]]:
    """The variables that rows read before they write them, and those that they write."""
    read, written = set[str](), set[str]()
    for row in rows:
        target, _, value = row.partition("=")
        name = target.strip()
        if not _NAME.fullmatch(name):  # A result, or a condition.
            name, value = "", row
        read |= set(_NAME.findall(value)) - written
        written |= {name} - {""}
    return read, written
