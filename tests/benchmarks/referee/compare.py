"""Engines beside the reference, as correct digits."""

import importlib
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np

from referee.derive import balance, exact, frames
from referee.description import Mechanism, force_names
from referee.reference import STATES, Lines, load
from referee.spatial import MECHANISMS

ENGINES = ("ours", "drake_joints", "mujoco_engine", "pinocchio_engine")
"""The modules of `engines`: NAME, NOTE and `forces`; of a soft one also `mass_matrix`."""

SAME_MODEL = 1e-12
"""The largest relative difference of a mass matrix from the reference's."""

HEAD = """# Constraint forces of mechanisms: correct digits

Made by `make table NAME=referee`. Each number is -log10 of the largest error of all
constraint forces of the mechanism, in the size of the largest one, rounded down; doubles
hold 15 or 16.
What each engine solves, at the best settings found:
"""

Cell = float | str
"""The correct digits of an engine's forces, 0 to 16, or why it cannot tell."""


def correct_digits(found: Sequence[float], wanted: Sequence[float]) -> float:
    """-log10 of the largest error in the size of the largest value; 0 to 16."""
    error = np.max(np.abs(np.subtract(found, wanted))) / np.max(np.abs(wanted))
    return float(np.clip(-np.log10(max(error, 1e-300)), 0.0, 16.0)) if np.isfinite(error) else 0.0


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


def find_engines(names: Sequence[str]) -> tuple[list[ModuleType], list[str]]:
    """The engines that are installed, and a sentence for each that is not."""
    found, missing = [], []
    for name in names:
        try:
            found.append(importlib.import_module(f"referee.engines.{name}"))
        except ImportError as error:
            missing.append(f"{name}: left out, since {error}.")
    return found, missing


def compare_state(engine: ModuleType, mechanism: Mechanism, lines: Lines) -> Cell:
    """An engine's forces at the stated state."""
    q, v = state_of(mechanism, lines)
    try:
        found = stacked(mechanism, engine.forces(mechanism, q, v))
    except NotImplementedError as error:
        return str(error)
    if hasattr(engine, "mass_matrix"):
        M, _ = balance(mechanism, frames(mechanism, exact(q), exact(0 * v)))
        wanted = np.array(M, dtype=float)
        apart = np.max(np.abs(engine.mass_matrix(mechanism, q, v) - wanted))
        if apart > SAME_MODEL * np.max(np.abs(wanted)):
            return f"its mass matrix differs by {apart:.1g}: another model"
    return correct_digits(found, wanted_forces(mechanism, lines))


def table(title: str, heads: Sequence[str], cells: dict[str, dict[str, Cell]]) -> str:
    """One table of digits, and why there is a '-', in Markdown."""
    rows = [[title, *heads], ["---"] * (len(heads) + 1)]
    reasons: dict[tuple[str, str], list[str]] = {}
    for name, row in cells.items():
        rows.append([name, *("-" if isinstance(c, str) else str(int(c)) for c in row.values())])
        for head, cell in row.items():
            if isinstance(cell, str):
                reasons.setdefault((head, cell), []).append(name)
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    lines += ["", "Why there is a '-':", ""] if reasons else []
    lines += [f"- {head}, {', '.join(who)}: {why}." for (head, why), who in reasons.items()]
    return "\n".join([*lines, ""])


def main(names: Sequence[str]) -> None:
    """Compares some mechanisms, or all; then the page is written."""
    if unknown := [name for name in names if name not in MECHANISMS]:
        raise SystemExit(f"no mechanism {', '.join(unknown)}; there are {', '.join(MECHANISMS)}")
    engines, missing = find_engines(ENGINES)
    lines, states = load(STATES), {}
    for name in names or MECHANISMS:
        mechanism = MECHANISMS[name]
        states[name] = {e.NAME: compare_state(e, mechanism, lines) for e in engines}
        print(name, "is compared", flush=True)
    notes = [f"- **{engine.NAME}**: {engine.NOTE}." for engine in engines]
    heads = [engine.NAME for engine in engines]
    found = "## At the stated state\n\n" + table("mechanism", heads, states)
    text = "\n".join([HEAD, *notes, *(f"- {sentence}" for sentence in missing), "", found])
    print("\n" + text)
    if not names:
        Path(__file__).with_name("table.md").write_text(text)
