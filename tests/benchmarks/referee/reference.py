"""The reference values as CSV: `python -m referee.reference` derives them anew, in some minutes.

`states.csv` has, for each mechanism in its stated state, the positions and rates of all joints and
the forces of its closures; `motions.csv` has the same after the motion. 40 digits are written; in
`motions.csv` 30 are right, as a second run with another order of the integrator shows.
"""

import csv
import sys
from collections.abc import Iterable
from pathlib import Path

from mpmath import mp

from referee.derive import State, state
from referee.description import Mechanism
from referee.mechanisms import MECHANISMS
from referee.motion import COLUMNS, after

HERE = Path(__file__).parent
STATES, MOTIONS = HERE / "states.csv", HERE / "motions.csv"

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
    if abs(value) < mp.mpf(10) ** -42:
        return "0"
    return mp.nstr(value, 40, strip_zeros=False, min_fixed=-5, max_fixed=5)


def load(path: Path) -> Lines:
    """The lines of a file by mechanism and name."""
    found: Lines = {}
    with path.open(newline="") as file:
        for line in csv.DictReader(file):
            found.setdefault(line["mechanism"], {})[line["name"]] = line["value"]
    return found


def save(path: Path, lines: Iterable[tuple[str, str, str]]) -> None:
    """Writes a file."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("mechanism", "name", "value"))
        writer.writerows(lines)


def main(names: Iterable[str] = ()) -> None:
    """Derives states, and the motions of the named mechanisms (of all if none is named)."""
    states = [line for m in MECHANISMS.values() for line in lines_of(m, state(m))]
    save(STATES, states)
    known = load(MOTIONS) if MOTIONS.exists() else {}
    for mechanism in MECHANISMS.values():
        if not mechanism.duration or (names and mechanism.name not in names):
            continue
        found = after(mechanism, mechanism.duration)
        other = after(mechanism, mechanism.duration, COLUMNS + 3)
        apart = max(
            abs(a - b) / max(1, abs(a))
            for a, b in zip(
                [*found.q, *found.v, *found.forces.values()],
                [*other.q, *other.v, *other.forces.values()],
                strict=True,
            )
        )
        print(f"{mechanism.name}: two orders differ by {mp.nstr(apart, 3)}", flush=True)
        known[mechanism.name] = {name: value for _, name, value in lines_of(mechanism, found)}
        save(
            MOTIONS,
            (
                (name, key, value)
                for name in MECHANISMS
                for key, value in known.get(name, {}).items()
            ),
        )


if __name__ == "__main__":
    main(sys.argv[1:])
