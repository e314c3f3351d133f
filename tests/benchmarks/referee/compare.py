"""Engines beside the reference, as correct digits."""

import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from referee.derive import balance, exact, frames
from referee.description import Mechanism, force_names
from referee.reference import Lines

ENGINES = ("ours", "drake_joints", "mujoco_engine", "pinocchio_engine")
"""The modules of `engines`: NAME, NOTE, `forces`, and where it has one `mass_matrix`, `after`."""

MOST = 16
"""The digits of a double."""

SAME_MODEL = 1e-12
"""The largest relative difference of a mass matrix from the reference's."""


@dataclass(frozen=True)
class Cell:
    """What one engine makes of one mechanism.

    Attributes:
        digits: The correct digits of its forces; None if it cannot tell.
        reason: Why not.
    """

    digits: float | None = None
    reason: str = ""

    def __str__(self) -> str:
        return "-" if self.digits is None else str(int(self.digits))


def correct_digits(found: Sequence[float], wanted: Sequence[float]) -> float:
    """-log10 of the largest error in the size of the largest value; 0 to 16."""
    error = np.max(np.abs(np.subtract(found, wanted))) / np.max(np.abs(wanted))
    if not math.isfinite(error):
        return 0.0
    return float(np.clip(-np.log10(max(error, 1e-300)), 0.0, MOST))


def state_of(mechanism: Mechanism, lines: Lines) -> tuple[np.ndarray, np.ndarray]:
    """q and v, rounded to doubles."""
    own, size = lines[mechanism.name], mechanism.size
    return tuple(np.array([float(own[f"{part}{i}"]) for i in range(size)]) for part in "qv")


def wanted_forces(mechanism: Mechanism, lines: Lines) -> np.ndarray:
    """All forces in the order of the closures."""
    own = lines[mechanism.name]
    return np.array([float(own[name]) for c in mechanism.closures for name in force_names(c)])


def stacked(mechanism: Mechanism, forces: dict[str, np.ndarray]) -> np.ndarray:
    """The forces of an engine in the same order."""
    return np.concatenate([forces[closure.name] for closure in mechanism.closures])


def find_engines(names: Sequence[str] = ENGINES) -> tuple[list[ModuleType], list[str]]:
    """The engines that are installed, and a sentence for each that is not."""
    found, missing = [], []
    for name in names:
        try:
            found.append(importlib.import_module(f"referee.engines.{name}"))
        except ImportError as error:
            missing.append(f"{name}: left out, since {error}.")
    return found, missing


def compare_state(engine: ModuleType, mechanism: Mechanism, lines: Lines) -> Cell:
    """The digits of an engine's forces at the stated state."""
    q, v = state_of(mechanism, lines)
    try:
        found = stacked(mechanism, engine.forces(mechanism, q, v))
    except NotImplementedError as error:
        return Cell(None, str(error))
    if hasattr(engine, "mass_matrix"):
        M, _ = balance(mechanism, frames(mechanism, exact(q), exact(0 * v)))
        wanted = np.array(M, dtype=float)
        apart = np.max(np.abs(engine.mass_matrix(mechanism, q, v) - wanted))
        if apart > SAME_MODEL * np.max(np.abs(wanted)):
            return Cell(None, f"its mass matrix differs by {apart:.1g}: another model")
    return Cell(correct_digits(found, wanted_forces(mechanism, lines)))


def compare_motion(engine: ModuleType, mechanism: Mechanism, start: Lines, end: Lines) -> Cell:
    """The digits of an engine's forces after the motion; the least of those of q and v, if any."""
    if not hasattr(engine, "after"):
        return Cell(None, "it has no integrator of constrained motion")
    try:
        found = engine.after(mechanism, *state_of(mechanism, start))
    except NotImplementedError as error:
        return Cell(None, str(error))
    except (RuntimeError, ValueError) as error:  # The other mechanisms go on.
        return Cell(None, f"it fails with {str(error).splitlines()[0]!r}")
    q, v = state_of(mechanism, end)
    parts = [(stacked(mechanism, found), wanted_forces(mechanism, end))]
    parts += [(found[key], value) for key, value in (("q", q), ("v", v)) if key in found]
    return Cell(min(correct_digits(*part) for part in parts))


def table(
    title: str, engines: Sequence[ModuleType], cells: dict[str, dict[str, Cell]]
) -> list[str]:
    """One table of digits, and why there is a '-', as lines of Markdown."""
    heads = [engine.NAME for engine in engines]
    lines = ["| " + " | ".join([title, *heads]) + " |", "|" + "---|" * (len(heads) + 1)]
    for name, row in cells.items():
        lines.append("| " + " | ".join([name, *(str(row[head]) for head in heads)]) + " |")
    lines += ["", "Why there is a '-':\n"]
    for head in heads:
        reasons: dict[str, list[str]] = {}
        for name, row in cells.items():
            if row[head].reason:
                reasons.setdefault(row[head].reason, []).append(name)
        lines += [f"- {head}, {', '.join(who)}: {why}." for why, who in reasons.items()]
    return [*lines, ""]


def page(
    engines: Sequence[ModuleType],
    states: dict[str, dict[str, Cell]],
    motions: dict[str, dict[str, Cell]],
    missing: Sequence[str],
) -> str:
    """The tables, and what each engine solves, in Markdown."""
    lines = [
        "# Constraint forces of mechanisms: correct digits\n",
        "Made by `make table NAME=referee`. Each number is -log10 of the largest error of all",
        "constraint forces of the mechanism, in the size of the largest one, rounded down; doubles",
        "hold 15 or 16. What each engine solves, at the best settings found:\n",
        *(f"- **{engine.NAME}**: {engine.NOTE}." for engine in engines),
        *(f"- {sentence}" for sentence in missing),
        "\n## At the stated state\n",
        *table("mechanism", engines, states),
        "## After the motion\n",
        "The digits of forces; for drake_dae the least of forces, positions and rates.\n",
        *table("mechanism, s", engines, motions),
    ]
    return "\n".join(lines)
