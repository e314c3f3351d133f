"""Tables and paragraphs as plain text."""

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill

from drake_dae.arrays import FloatArray
from drake_dae.dae import Signal

_WIDTH = 100
"""The width of a paragraph, in characters."""


@dataclass(frozen=True)
class Table:
    """A table of texts. The first `left` columns and those without a head are left-aligned."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    left: int = 1

    def __str__(self) -> str:
        rows = [self.head, *self.rows]
        widths = [max(len(row[i]) for row in rows) for i in range(len(self.head))]
        lines = []
        for row in rows:
            cells = enumerate(zip(row, widths, self.head, strict=True))
            aligned = [
                t.ljust(w) if i < self.left or not h else t.rjust(w) for i, (t, w, h) in cells
            ]
            lines.append("  ".join(aligned).rstrip())
        return "\n".join(lines)


def digits(value: float) -> str:
    """Formats a number with four digits; round-off is 0."""
    return f"{value:.4g}" if abs(value) > 1e-12 else "0"


Part = Table | Sequence[str]
"""A table, or the lines of a paragraph."""


def to_text(parts: Sequence[Part]) -> str:
    """Joins parts to plain text; long lines of paragraphs are wrapped."""

    def text(part: Part) -> str:
        if isinstance(part, Table):
            return str(part)
        return "\n".join(
            fill(line, _WIDTH, subsequent_indent="  ", break_on_hyphens=False) for line in part
        )

    return "\n\n".join(map(text, parts))


def count_of(number: int, noun: str) -> str:
    """Formats a number with its noun, as in "1 state" and "2 states"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def named_values(
    signals: Sequence[Signal], values: FloatArray, chosen: Sequence[bool] | None = None
) -> str:
    """Formats values, all or selected ones, as "name=value unit, ..."."""
    return ", ".join(
        f"{signal.name}={digits(value)} {signal.unit}".rstrip()
        for i, (signal, value) in enumerate(zip(signals, values, strict=True))
        if chosen is None or chosen[i]
    )
