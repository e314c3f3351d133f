"""What the theory says about one system: the findings, as text, Markdown and data."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.analysis.tables import Part, Table, digits, to_markdown, to_text
from drake_dae.arrays import FloatArray
from drake_dae.dae.signals import Signal
from drake_dae.dae.states.margins import SINGULAR, Margin
from drake_dae.dae.states.samples import traced
from drake_dae.dae.structure import Structure
from drake_dae.dae.system import DaeSystem
from drake_dae.dae.zero_dynamics.pinned_motion import PinnedMotion
from drake_dae.dae.zero_dynamics.zero_dynamics import ComplexArray, Stability, Verdict


class Finding(StrEnum):
    """What became of an assumption."""

    SATISFIED = "satisfied"
    VIOLATED = "violated"
    UNDECIDED = "undecided"
    NOT_EXAMINED = "not examined"
    FAILS = "does not hold"


@dataclass(frozen=True, eq=False)
class Assumption:
    """One of Assumptions (1)-(5) and what was found of it.

    Attributes:
        number: In the paper.
        statement: What it asks for.
        finding: Whether it holds at the examined states and between them.
        margin: Of A(x) for (2), of B(x) for (5), or for (1) and (4) where a row of these vanishes;
            else None.
        reason: How it is violated and what to change, or why it was not examined; else empty.
    """

    number: int
    statement: str
    finding: Finding
    margin: Margin | None
    reason: str


@dataclass(frozen=True, eq=False)
class Analysis:
    """What the theory says about one system; made by `analyze`, printed by `print`.

    What is not known, because an assumption fails before, is None.

    Attributes:
        system: The system.
        where: Which states were examined, in words.
        states: The states, consistent where the constraints have degrees, shape (samples, n).
        assumptions: (1), ..., (5).
        constraint_degrees: r_1, ..., r_m.
        output_degrees: mu_1, ..., mu_p in the order of the system's outputs.
        output_order: The outputs in the paper's order (15).
        independence: Margin of the gradients of all chains, which are linearly independent by
            Theorem 2.1; None also where there are no chains.
        zero_dynamics: Assumption 2.2, by linearization at an equilibrium.
        motion: Along the reference; None also without one.
        structure: For laws and blocks; None where A(x) or B(x) is singular at an examined state
            itself. One that is singular only between them violates its assumption, no more.
    """

    system: DaeSystem
    where: str
    states: FloatArray
    assumptions: tuple[Assumption, ...]
    constraint_degrees: tuple[int, ...] | None = None
    output_degrees: tuple[int, ...] | None = None
    output_order: tuple[int, ...] | None = None
    independence: Margin | None = None
    zero_dynamics: Stability | None = None
    motion: PinnedMotion | None = None
    structure: Structure | None = None

    @property
    def index(self) -> int | None:
        """max r_i + 1, the index of the DAE; 0 without constraints."""
        degrees = self._degrees_of_manifold
        return None if degrees is None else max(degrees, default=-1) + 1

    @property
    def _degrees_of_manifold(self) -> tuple[int, ...] | None:
        """r_1, ..., r_m, unless Assumption (2) fails, so that they do not add up."""
        violated = self.assumptions[1].finding is Finding.VIOLATED
        return None if violated else self.constraint_degrees

    @property
    def manifold_dimension(self) -> int | None:
        """dim N* = n - sum r_i, Theorem 1.1."""
        degrees = self._degrees_of_manifold
        return None if degrees is None else self.system.num_states - sum(degrees)

    @property
    def zero_dynamics_dimension(self) -> int | None:
        """dim xi of (22): n - sum r_i - sum mu_i."""
        known, degrees = self.manifold_dimension, self.output_degrees
        return None if known is None or degrees is None else known - sum(degrees)

    @property
    def problems(self) -> tuple[str, ...]:
        """What is violated, one text each; empty if nothing is."""
        found = [a.reason for a in self.assumptions if a.finding is Finding.VIOLATED]
        # Where an assumption fails, the theorem may as well, and says nothing new.
        if not found and self.independence is not None and self.independence.is_singular:
            found.append(
                "Theorem 2.1: the gradients of the constraints, the outputs and their derivatives "
                f"depend on each other at {self._named(self.independence.state)}"
            )
        if self.zero_dynamics is not None and self.zero_dynamics.verdict is Verdict.UNSTABLE:
            found.append(f"Assumption 2.2: {self.zero_dynamics.reason}")
        if self.motion is not None and self.motion.failure:
            found.append(self.motion.failure)
        return tuple(found)

    def __repr__(self) -> str:
        found = count_of(len(self.problems), "problem") if self.problems else "no problem found"
        return f"Analysis('{self.system.name}': {found})"

    def __str__(self) -> str:
        return to_text([*self.parts(), *([problem] for problem in self.problems)])

    def to_markdown(self) -> str:
        """The same with Markdown tables."""
        return to_markdown([*self.parts(), *([problem] for problem in self.problems)])

    def _repr_markdown_(self) -> str:
        """For notebooks."""
        return self.to_markdown()

    def to_dict(self) -> dict[str, Any]:
        """What is printed as plain numbers, lists and texts, with the states of the margins."""
        system = self.system
        zero, motion = self.zero_dynamics, self.motion
        return {
            "name": system.name,
            "num_states": system.num_states,
            "num_constraints": system.num_constraints,
            "num_controls": system.num_controls,
            "states": [signal.name for signal in system.state_signals],
            "examined_at": self.where,
            "constraint_degrees": _by_name(
                system.constraint_output_signals, self.constraint_degrees
            ),
            "index": self.index,
            "manifold_dimension": self.manifold_dimension,
            "output_degrees": _by_name(system.output_signals, self.output_degrees),
            "output_order": None
            if self.output_order is None
            else [system.output_signals[i].name for i in self.output_order],
            "zero_dynamics_dimension": self.zero_dynamics_dimension,
            "assumptions": [
                {
                    "number": a.number,
                    "statement": a.statement,
                    "finding": str(a.finding),
                    "margin": _margin(a.margin),
                    "reason": a.reason,
                }
                for a in self.assumptions
            ],
            "independence": _margin(self.independence),
            "zero_dynamics": None
            if zero is None
            else {
                "verdict": str(zero.verdict),
                "eigenvalues": [[float(e.real), float(e.imag)] for e in zero.eigenvalues],
                "state": None if zero.state is None else zero.state.tolist(),
                "reason": zero.reason,
            },
            "reference": None if motion is None else _motion(motion),
            "problems": list(self.problems),
        }

    def parts(self) -> list[Part]:
        """Paragraphs and tables, without the problems."""
        system = self.system
        counts = (
            count_of(system.num_states, "state"),
            count_of(system.num_constraints, "constraint"),
            count_of(system.num_controls, "control"),
        )
        parts: list[Part] = [[f"{system.name}: {', '.join(counts)}", f"examined at {self.where}"]]
        if system.num_constraints:
            rows = [
                [signal.name, _known(self.constraint_degrees, i)]
                for i, signal in enumerate(system.constraint_output_signals)
            ]
            parts.append(Table(["constraint", "r"], rows))
        order = self.output_order
        rows = [
            [
                signal.name,
                _known(self.output_degrees, i),
                "?" if order is None else str(order.index(i) + 1),
            ]
            for i, signal in enumerate(system.output_signals)
        ]
        parts.append(Table(["output", "mu", "order in (15)"], rows))
        index, manifold, zero = (
            "?" if number is None else str(number)
            for number in (self.index, self.manifold_dimension, self.zero_dynamics_dimension)
        )
        parts.append(
            [f"index {index}, N* of dimension {manifold}, zero dynamics of dimension {zero}"]
        )
        parts.append(self._findings())
        margins = [a.margin for a in self.assumptions if a.margin] + [self.independence]
        if any(margins):
            parts.append(
                [
                    "margin: smallest singular value after rows and columns are scaled to about "
                    f"length one; below {SINGULAR:.0e} it counts as singular."
                ]
            )
        parts += self._places()
        if self.motion is not None and self.motion.times.size:
            parts.append(_along(self.motion))
        return parts

    def _findings(self) -> Table:
        free = "" if self.system.num_constraints else ": m = 0"
        rows = [
            [
                f"({a.number})  {a.statement}{free if a.number <= 3 else ''}",
                str(a.finding),
                *_figures(a.margin),
            ]
            for a in self.assumptions
        ]
        chains, zero = Finding.NOT_EXAMINED, Finding.NOT_EXAMINED
        if self.output_degrees is not None:
            singular = self.independence is not None and self.independence.is_singular
            chains = Finding.FAILS if singular else Finding.SATISFIED
        if self.zero_dynamics is not None:
            zero = _FINDINGS[self.zero_dynamics.verdict]
        none = ": there are none" if self.zero_dynamics_dimension == 0 else ""
        rows += [
            [
                "2.1  theorem: gradients of all chains are independent",
                chains,
                *_figures(self.independence),
            ],
            [f"2.2  zero dynamics are stable{none}", zero, "", ""],
        ]
        return Table(["assumption", "finding", "margin", "singular value"], rows, left=2)

    def _places(self) -> list[Part]:
        """Where the margins are smallest, and what the zero dynamics do."""
        lines = []
        found = self.structure
        if found is not None:
            matrices = {2: found.elimination.constraint_matrix, 5: found.control_matrix}
            lines = [
                self._nearest(a.number, matrices[a.number], a.margin)
                for a in self.assumptions
                if a.margin is not None and a.finding is Finding.SATISFIED
            ]
        zero = self.zero_dynamics
        if zero is not None and zero.eigenvalues.size:
            lines.append(f"Zero dynamics: eigenvalues {_complex(zero.eigenvalues)} 1/s.")
        if zero is not None and self.zero_dynamics_dimension and zero.verdict != Verdict.UNSTABLE:
            lines.append(f"Zero dynamics {zero.verdict}: {zero.reason}.")
        return [lines] if lines else []

    def _nearest(self, number: int, matrix: ca.SX, margin: Margin) -> str:
        """Where A(x) or B(x) is nearest to singular, in the states that it depends on."""
        letter, system = "A" if number == 2 else "B", self.system
        used = ca.which_depends(ca.vec(matrix), system.state, 1, False)
        if not any(used):
            return f"{letter}(x) is the same at all states."
        value = traced(system, value=matrix)
        values = np.array(
            [
                value(state, system.parameter_values)[0]
                for state in np.vstack([self.states, margin.state])
            ]
        )
        if np.all(np.ptp(values, axis=0) <= 1e-9 * np.abs(values).max()):
            return f"{letter}(x) is the same at all examined states."
        return f"{letter}(x) is nearest to singular at {self._named(margin.state, used)}."

    def _named(self, state: FloatArray, chosen: Sequence[bool] | None = None) -> str:
        """A state, or what is chosen of it, as name=value with unit, ..."""
        return ", ".join(
            f"{signal.name}={digits(value)} {signal.unit}".rstrip()
            for i, (signal, value) in enumerate(zip(self.system.state_signals, state, strict=True))
            if chosen is None or chosen[i]
        )


_FINDINGS = {
    Verdict.STABLE: Finding.SATISFIED,
    Verdict.UNSTABLE: Finding.VIOLATED,
    Verdict.UNDECIDED: Finding.UNDECIDED,
}


def count_of(number: int, noun: str) -> str:
    """As in 1 state, 2 states."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _known(values: Sequence[int] | None, index: int) -> str:
    return "?" if values is None else str(values[index])


def _figures(margin: Margin | None) -> list[str]:
    return (
        ["", ""] if margin is None else [f"{margin.relative:.2g}", f"{margin.singular_value:.4g}"]
    )


def _along(motion: PinnedMotion) -> Table:
    """The margins along the reference."""
    rows = [
        [letter, f"{smallest:.4g}", f"{time:.4g} s"]
        for letter, (smallest, time) in _worst(motion).items()
    ]
    title = f"along the reference, {motion.times[0]:g} to {motion.times[-1]:g} s"
    return Table([title, "smallest singular value", "at"], rows)


def _worst(motion: PinnedMotion) -> dict[str, tuple[float, float]]:
    """The smallest margins of A(x) and B(x), and when."""
    found = {}
    for letter, margins in (("A", motion.constraint_margins), ("B", motion.control_margins)):
        if margins.size and np.all(np.isfinite(margins)):
            worst = int(np.argmin(margins))
            found[f"{letter}(x)"] = (float(margins[worst]), float(motion.times[worst]))
    return found


def _complex(values: ComplexArray) -> str:
    """A conjugate pair as one."""
    size = np.abs(values).max(initial=0.0)
    texts = []
    for value in values:
        real = 0.0 if abs(value.real) < 1e-9 * size else value.real
        if value.imag > 0.0:
            texts.append(f"{real:.4g} ± {value.imag:.4g}i")
        elif value.imag == 0.0:
            texts.append(f"{real:.4g}")
    return ", ".join(texts)


def _by_name(signals: Sequence[Signal], values: Sequence[int] | None) -> dict[str, int] | None:
    if values is None:
        return None
    return {signal.name: value for signal, value in zip(signals, values, strict=True)}


def _margin(margin: Margin | None) -> dict[str, Any] | None:
    if margin is None:
        return None
    return {
        "singular_value": float(margin.singular_value),
        "relative": float(margin.relative),
        "state": margin.state.tolist(),
    }


def _motion(motion: PinnedMotion) -> dict[str, Any]:
    return {
        "times": [float(time) for time in motion.times[[0, -1]]] if motion.times.size else [],
        "failure": motion.failure,
        "failure_time": None if motion.failure_time is None else float(motion.failure_time),
        "margins": {
            letter: {"smallest": smallest, "time": time}
            for letter, (smallest, time) in _worst(motion).items()
        },
    }
