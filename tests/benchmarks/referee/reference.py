"""The reference values as CSV: `python -m referee.reference` derives them anew, in some minutes.

`states.csv` has, for each mechanism in its stated state, the positions and rates of all joints and
the forces of its closures to 40 digits.
"""

import csv
from pathlib import Path

from mpmath import mp, mpf

from referee.derive import State, state
from referee.description import Mechanism
from referee.spatial import MECHANISMS

STATES = Path(__file__).with_name("states.csv")

Lines = dict[str, dict[str, str]]
"""Mechanism -> "q0", "v0", ... or the name of a force -> its digits."""


def lines_of(mechanism: Mechanism, found: State) -> list[tuple[str, str, str]]:
    """The lines of one mechanism in one state."""
    values = [(f"q{i}", value) for i, value in enumerate(found.q)]
    values += [(f"v{i}", value) for i, value in enumerate(found.v)]
    values += list(found.forces.items())
    return [(mechanism.name, name, digits(value)) for name, value in values]


def digits(value: object) -> str:
    """40 digits; what is zero to the working precision is zero."""
    if abs(value) < mpf(10) ** -42:
        return "0"
    return mp.nstr(value, 40, strip_zeros=False, min_fixed=-5, max_fixed=5)


def load(path: Path) -> Lines:
    """The lines of a file by mechanism and name."""
    found: Lines = {}
    with path.open(newline="") as file:
        for line in csv.DictReader(file):
            found.setdefault(line["mechanism"], {})[line["name"]] = line["value"]
    return found


def main() -> None:
    """Derives the states, and writes the file."""
    lines = (line for each in MECHANISMS.values() for line in lines_of(each, state(each)))
    with STATES.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("mechanism", "name", "value"))
        writer.writerows(lines)


if __name__ == "__main__":
    main()
