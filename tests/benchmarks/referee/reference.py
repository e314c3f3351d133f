"""The reference values as CSV: `python -m referee.reference` derives them anew, in some minutes.

`states.csv` has, for each mechanism in its stated state, the positions and rates of all joints and
the forces of its closures; `motions.csv` has the same after the motion. 40 digits are written; in
`motions.csv` 30 are right, as a second run with another order of the integrator shows.

Motions are integrated in the fewest coordinates. The midpoint rule of Gragg with 2, 4, ..., 2 K
substeps is extrapolated to substeps of zero in powers of their squares (Bulirsch and Stoer), which
gives order 2 K. Steps are chosen so that the two last columns differ by less than `TOLERANCE`.
"""

import csv
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from mpmath import mp, mpf

from referee.derive import Array, State, closed, state
from referee.description import Mechanism
from referee.spatial import MECHANISMS

HERE = Path(__file__).parent
STATES, MOTIONS = HERE / "states.csv", HERE / "motions.csv"
COLUMNS, TOLERANCE = 15, mpf(10) ** -35

Lines = dict[str, dict[str, str]]
"""Mechanism -> "q0", "v0", ... or the name of a force -> its digits."""

Rate = Callable[[Array], Array]


def after(mechanism: Mechanism, duration: object, columns: int = COLUMNS) -> State:
    """The state after a while.

    The positions of the joints that are not free follow from their rates T v_free; they stay closed
    to the accuracy of the integrator, and to round-off in the end.
    """
    size, free, first = mechanism.size, list(mechanism.free), state(mechanism)

    def rate(y: Array) -> Array:
        found = state(mechanism, y[:size], y[size:])
        return np.concatenate([found.v, found.acceleration[free]])

    start = np.concatenate([first.q, first.v[free]])
    y = integrated(rate, start, mpf(repr(duration)), columns)
    return state(mechanism, closed(mechanism, y[:size]), y[size:])


def integrated(rate: Rate, y: Array, duration: object, columns: int) -> Array:
    """The solution of y' = rate(y) after a while."""
    done, step = mpf(0), duration / 8
    while done < duration:
        step = min(step, duration - done)
        found, error = extrapolated(rate, y, step, columns)
        ratio = error / (max(1, np.abs(found).max()) * TOLERANCE)
        if ratio <= 1:
            y, done = found, done + step
        factor = mpf("0.9") * ratio ** (mpf(-1) / (2 * columns - 1)) if ratio else mpf(2)
        step *= min(mpf(2), max(mpf("0.2"), factor))
    return y


def extrapolated(rate: Rate, y: Array, step: object, columns: int) -> tuple[Array, object]:
    """One step, and the difference of its last two columns."""
    first, row = rate(y), list[Array]()
    for j in range(columns):
        before, row = row, [midpoint(rate, y, first, step, 2 * (j + 1))]
        for m in range(1, j + 1):
            weight = 1 / ((mpf(j + 1) / (j + 1 - m)) ** 2 - 1)
            row.append(row[-1] + (row[-1] - before[m - 1]) * weight)
    return row[-1], np.abs(row[-1] - row[-2]).max()


def midpoint(rate: Rate, y: Array, first: Array, step: object, count: int) -> Array:
    """Gragg's modified midpoint rule."""
    h = step / count
    before, now = y, y + first * h
    for _ in range(count - 1):
        before, now = now, before + rate(now) * (2 * h)
    return (before + now + rate(now) * h) / 2


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


def save(path: Path, lines: Iterable[tuple[str, str, str]]) -> None:
    """Writes a file."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("mechanism", "name", "value"))
        writer.writerows(lines)


def main(names: Iterable[str] = ()) -> None:
    """Derives states, and the motions of the named mechanisms (of all if none is named)."""
    save(STATES, [line for m in MECHANISMS.values() for line in lines_of(m, state(m))])
    known = load(MOTIONS) if MOTIONS.exists() else {}
    for mechanism in MECHANISMS.values():
        if not mechanism.duration or (names and mechanism.name not in names):
            continue
        found, other = (after(mechanism, mechanism.duration, COLUMNS + k) for k in (0, 3))
        a, b = (np.array([*each.q, *each.v, *each.forces.values()]) for each in (found, other))
        apart = max(abs(a - b) / np.maximum(1, abs(a)))
        print(f"{mechanism.name}: two orders differ by {mp.nstr(apart, 3)}", flush=True)
        known[mechanism.name] = {name: value for _, name, value in lines_of(mechanism, found)}
        kept = ((n, *item) for n in MECHANISMS for item in known.get(n, {}).items())
        save(MOTIONS, kept)


if __name__ == "__main__":
    main(sys.argv[1:])
