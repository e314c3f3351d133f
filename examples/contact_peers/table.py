"""All runs, as figures, and the figures as a table in Markdown."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from tqdm import tqdm

from contact_peers.laws import LAWS
from contact_peers.measure import Figures, run_law, run_ours
from contact_peers.plants import CONDITIONS, DURATION, FRICTION, Condition
from contact_peers.search import DESCENT, FIRST_RATE, GAINS, NOISY, QUIET, SPREAD, load_gains

FIGURES = Path(__file__).with_name("figures.json")

OURS, VERSION_0_1 = "drake_dae, as shipped", "drake_dae 0.1, poles -8"

WITHOUT = (
    "gains=!Poles {all: [-8.0]}",
    "constraint_damping=null",
    "integral=[]",
    "force_feedback=!ModelForce {}",
)
"""What makes our law that of version 0.1, which knew no friction either."""

ROWS = (
    (VERSION_0_1, False),
    *((name, known) for known in (True, False) for name in (*LAWS, OURS)),
)
"""Law, and whether it knows the friction, in the order of the table."""


@dataclass(frozen=True)
class Row:
    """A law, whether it knows the friction, and its figures by the title of a condition."""

    law: str
    knows: bool
    figures: dict[str, Figures]


def measure(law: str, knows: bool, condition: Condition) -> Figures:
    """One run."""
    friction = FRICTION if knows else 0.0
    if law in LAWS:
        return run_law(condition, LAWS[law], load_gains()[law], friction)
    return run_ours(condition, friction, WITHOUT if law == VERSION_0_1 else ())


def measure_all(known: Iterable[Row] = ()) -> list[Row]:
    """All rows but those that are known; the figures are kept in a file."""
    rows = {(row.law, row.knows): row for row in known}
    for law, knows in tqdm([row for row in ROWS if row not in rows], desc="laws"):
        found = {one.title: measure(law, knows, one) for one in CONDITIONS}
        rows[law, knows] = Row(law, knows, found)
    ordered = [rows[row] for row in ROWS]
    FIGURES.write_text(json.dumps([asdict(row) for row in ordered], indent=1) + "\n")
    return ordered


def load_rows() -> list[Row]:
    """The rows that `measure_all` left."""
    read = json.loads(FIGURES.read_text())
    return [
        Row(one["law"], one["knows"], {k: Figures(**v) for k, v in one["figures"].items()})
        for one in read
    ]


def short(value: float) -> str:
    """Two digits."""
    return f"{value:.0f}" if value >= 9.95 else f"{value:.2g}"


def _best(rows: Iterable[Row], title: str) -> dict[str, float]:
    found = [row.figures[title] for row in rows if not row.figures[title].is_lost]
    return {
        name: min((getattr(one, name) for one in found), default=0.0)
        for name in ("position", "force")
    }


def _cell(figures: Figures, best: dict[str, float]) -> str:
    if figures.is_lost:
        return "lost"
    values = {name: getattr(figures, name) for name in best}
    shown = [
        f"**{short(value)}**" if short(value) == short(best[name]) else short(value)
        for name, value in values.items()
    ]
    return " / ".join(shown)


def table(rows: list[Row]) -> str:
    """The table in Markdown: one for laws that know the friction, and one for those that do not."""
    titles = [condition.title for condition in CONDITIONS]
    lines = []
    for knows in (True, False):
        group = [row for row in rows if row.knows is knows]
        best = {title: _best(group, title) for title in titles}
        word = "known" if knows else "unknown"
        lines += [
            f"| friction {word} | {' | '.join(titles)} | roughness |",
            f"|{'---|' * (len(titles) + 2)}",
        ]
        for row in group:
            cells = [_cell(row.figures[title], best[title]) for title in titles]
            rough = row.figures["noise"]
            last = "" if rough.is_lost else short(rough.roughness)
            lines.append(f"| {row.law} | {' | '.join(cells)} | {last} |")
        lines.append("")
    return "\n".join(lines)


def better(rows: list[Row]) -> list[str]:
    """Where another law is better than ours, in a sentence each."""
    lines = []
    for knows in (True, False):
        group = {row.law: row for row in rows if row.knows is knows}
        ours = group.pop(OURS)
        for name, row in group.items():
            for figure in ("position", "force"):
                ahead = [
                    f"{title} ({short(getattr(row.figures[title], figure))} against "
                    f"{short(getattr(one, figure))})"
                    for title, one in ours.figures.items()
                    if not row.figures[title].is_lost
                    and getattr(row.figures[title], figure) < 0.95 * getattr(one, figure)
                ]
                if ahead:
                    word = "known" if knows else "unknown"
                    lines.append(f"- {name}, friction {word}, {figure}: {'; '.join(ahead)}.")
    return lines


def gains_table() -> str:
    """The gains that were found, and the cost that they reached."""
    lines = ["| law | gains | cost |", "|---|---|---|"]
    for name, one in json.loads(GAINS.read_text()).items():
        gains = [f"{key.replace('_', ' ')} {value:.3g}" for key, value in one["gains"].items()]
        lines.append(f"| {name} | {', '.join(gains)} | {one['cost']:.3g} |")
    return "\n".join(lines)


def page(rows: list[Row]) -> str:
    """The whole page: the table, where others are better, gains, and how it was done."""
    note = Path(__file__).with_name("note.md").read_text()
    places = {
        "TABLE": table(rows),
        "BETTER": "\n".join(better(rows)) or "Nowhere.",
        "GAINS": gains_table(),
        "RATE": f"{FIRST_RATE:g}",
        "DURATION": f"{DURATION:.2f}",
        "POINTS": f"{SPREAD} + {DESCENT}",
        "RUNS": f"{QUIET[0]:g} s without noise and {NOISY[0]:g} s with it",
    }
    for name, text in places.items():
        note = note.replace(f"<{name}>", text)
    return note
