"""What the theory says about one system, as a report: `analyze`."""

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from enum import StrEnum
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.dae.manifold import CONSISTENT, Manifold
from drake_dae.dae.region import Region
from drake_dae.dae.samples import SINGULAR, Margin, Samples
from drake_dae.dae.structure import (
    Constrained,
    Structure,
    check_system,
    constraint_violation,
    control_violation,
    examine_constraints,
    examine_outputs,
)
from drake_dae.dae.system import DaeSystem, Signal
from drake_dae.dae.tables import Part, Table, digits, to_markdown, to_text
from drake_dae.dae.zero_dynamics import ComplexArray, PinnedMotion, Stability, Verdict, ZeroDynamics
from drake_dae.errors import AssumptionError, FloatArray, InconsistentStateError, ModelError

STATEMENTS = (
    "v acts on y_i first in derivative r_i",
    "A(x) has rank m, so v can keep all constraints",
    "u does not act on y_i before derivative r_i",
    "u acts on z_i first in derivative mu_i",
    "B(x) has rank p, so u can steer all outputs",
)
"""Assumptions (1) to (5) in a line each."""

_SPREAD = 0.1
"""Of states that no region bounds, around the nominal one, as in `find_structure`."""


class Finding(StrEnum):
    """What became of an assumption."""

    SATISFIED = "satisfied"
    VIOLATED = "violated"
    UNDECIDED = "undecided"
    NOT_EXAMINED = "not examined"


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
        degrees = self.constraint_degrees
        return None if degrees is None else max(degrees, default=-1) + 1

    @property
    def manifold_dimension(self) -> int | None:
        """dim N* = n - sum r_i, Theorem 1.1."""
        degrees = self.constraint_degrees
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
        if self.independence is not None and self.independence.is_singular:
            found.append(
                "Theorem 2.1: the gradients of the constraints, the outputs and their derivatives "
                f"depend on each other at {self._named(self.independence.state)}"
            )
        if self.zero_dynamics is not None and self.zero_dynamics.verdict is Verdict.UNSTABLE:
            found.append(f"Assumption 2.2: {self.zero_dynamics.reason}")
        if self.motion is not None and self.motion.failure:
            found.append(self.motion.failure)
        return tuple(found)

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
            _count(system.num_states, "state"),
            _count(system.num_constraints, "constraint"),
            _count(system.num_controls, "control"),
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
        rows = [
            [f"({a.number})  {a.statement}", str(a.finding), *_figures(a.margin)]
            for a in self.assumptions
        ]
        chains, zero = Finding.NOT_EXAMINED, Finding.NOT_EXAMINED
        if self.output_degrees is not None:
            singular = self.independence is not None and self.independence.is_singular
            chains = Finding.VIOLATED if singular else Finding.SATISFIED
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
        places = [
            f"{signal.name}={digits(value)}"
            for signal, value, needed in zip(system.state_signals, margin.state, used, strict=True)
            if needed
        ]
        if not places:
            return f"{letter}(x) is the same at all states."
        return f"{letter}(x) is nearest to singular at {', '.join(places)}."

    def _named(self, state: FloatArray) -> str:
        """A state as name=value, ..."""
        pairs = zip(self.system.state_signals, state, strict=True)
        return ", ".join(f"{signal.name}={digits(value)}" for signal, value in pairs)


_FINDINGS = {
    Verdict.STABLE: Finding.SATISFIED,
    Verdict.UNSTABLE: Finding.VIOLATED,
    Verdict.UNDECIDED: Finding.UNDECIDED,
}


def analyze(
    system: DaeSystem,
    *,
    region: Mapping[str, tuple[float, float]] | None = None,
    states: ArrayLike | None = None,
    reference: Callable[[float], FloatArray] | None = None,
    times: ArrayLike | None = None,
    start: ArrayLike | None = None,
    count: int = 50,
    seed: int = 0,
) -> Analysis:
    """Examines relative degrees, index, Assumptions (1)-(5) and 2.2, and the way along a reference.

    Numbers are decided at consistent states with the default parameters: at those given, or at
    random ones in a region or around `system.nominal_state`. A determinant that changes its sign
    between the first of them and another is zero on the way. From the worst of the random ones the
    smallest singular values of A(x) and B(x) are also followed downhill, inside the region or the
    box that the random states span, so that a singular state between them is found as a rule.
    There is no proof that none was missed.

    Args:
        system: (1)-(3).
        region: State name -> (lowest, highest); other states are drawn around the nominal one.
        states: Consistent states to examine instead, shape (k, n).
        reference: t -> R(t), output-major as for `TrackingLaw`; the margins are also taken along
            the motion that it commands.
        times: In s, increasing, shape (k,); where on the reference.
        start: State near which the motion along the reference starts, shape (n,); the first
            examined state if None.
        count: How many random states are drawn.
        seed: Of the random numbers.

    Returns:
        The report. An assumption that is violated is part of it, with what is known before.

    Raises:
        InconsistentStateError: No consistent state in the region or around the nominal state, or
            given states that are not consistent.
        ModelError: Arguments that make no sense; a system without controls, with a function that
            is not finite, or a mass matrix that is not symmetric and positive definite.
    """
    if region is not None and states is not None:
        raise ModelError(f"{system.name}: give a region or states, not both")
    if (reference is None) != (times is None):
        raise ModelError(f"{system.name}: a reference needs times, and times need a reference")
    if isinstance(count, bool) or not isinstance(count, int) or count < 0:
        raise ModelError(f"{system.name}: count must be a whole number from 0, got {count!r}")
    box = None if region is None else _box(system, region)
    random = np.random.default_rng(seed)
    guesses = _guesses(system, box, count, random) if states is None else _given(system, states)
    try:
        check_system(system)
        constrained = examine_constraints(system, guesses, box)
    except AssumptionError as error:
        where = _where(len(guesses), "state", region, states)
        return Analysis(system, where, guesses, _assumptions((), [error]))
    except InconsistentStateError as error:
        if region is None:
            raise
        raise InconsistentStateError(
            f"{system.name}: no consistent state found with {_bounds(region)}; choose another "
            "region",
            error.residual,
        ) from error
    samples = constrained.samples
    if states is not None:
        _check_consistent(samples.manifold, guesses, samples.states)
    where = _where(len(samples.states), "consistent state", region, states)
    analysis, dynamics = _examined(constrained, where, search=states is None)
    if reference is None or times is None or dynamics is None:
        return analysis
    motion = dynamics.motion(reference, times, samples.states[0] if start is None else start)
    return replace(analysis, motion=motion)


def _examined(
    constrained: Constrained, where: str, search: bool
) -> tuple[Analysis, ZeroDynamics | None]:
    """From the constraints on."""
    samples, elimination = constrained.samples, constrained.elimination
    system = samples.system
    known: dict[str, Any] = {"constraint_degrees": constrained.degrees}
    margins: dict[int, Margin] = {}
    errors: list[AssumptionError] = []
    satisfied, regular = {1, 2, 3}, True
    dynamics = None

    def judge(margin: Margin, violation: AssumptionError | None, number: int) -> None:
        if violation:
            errors.append(violation)
            satisfied.difference_update({violation.assumption, number})
        margins[violation.assumption if violation else number] = margin

    if constrained.margin is not None:
        matrix = elimination.constraint_matrix
        margin = samples.margin(matrix, search=True) if search else constrained.margin
        judge(margin, constraint_violation(system, margin), 2)
        regular = samples.is_regular(matrix)
    if regular:
        try:
            structure = examine_outputs(constrained)
        except AssumptionError as error:
            errors.append(error)
        else:
            matrix = structure.control_matrix
            satisfied |= {4, 5}
            margin = samples.margin(matrix, search)
            judge(margin, control_violation(system, margin), 5)
            known |= {
                "output_degrees": structure.output_degrees,
                "output_order": structure.output_order,
                "independence": _independence(structure, samples),
            }
            if samples.is_regular(matrix):
                dynamics = ZeroDynamics(structure)
                stability = dynamics.stability(samples.states[0])
                known |= {"zero_dynamics": stability, "structure": structure}
    assumptions = _assumptions(satisfied, errors, margins)
    return Analysis(system, where, samples.states, assumptions, **known), dynamics


def _assumptions(
    satisfied: Container[int],
    errors: Sequence[AssumptionError],
    margins: Mapping[int, Margin] | None = None,
) -> tuple[Assumption, ...]:
    """(1), ..., (5); what is neither satisfied nor in an error was not examined."""
    reasons = {error.assumption: str(error) for error in errors}
    before = f"Assumption ({errors[0].assumption}) is violated" if errors else ""
    result = []
    for number, statement in enumerate(STATEMENTS, start=1):
        if number in reasons:
            finding, reason = Finding.VIOLATED, reasons[number]
        elif number in satisfied:
            finding, reason = Finding.SATISFIED, ""
        else:
            finding, reason = Finding.NOT_EXAMINED, before
        margin = (margins or {}).get(number)
        result.append(Assumption(number, statement, finding, margin, reason))
    return tuple(result)


def _independence(structure: Structure, samples: Samples) -> Margin | None:
    """Of the row vectors of Theorem 2.1."""
    chains = [ca.vertcat(*chain) for chain in structure.output_chains if chain]
    functions = ca.vertcat(structure.manifold.residual_expression, *chains)
    if not functions.numel():
        return None
    return samples.margin(ca.jacobian(functions, structure.system.state))


def _box(system: DaeSystem, region: Mapping[str, tuple[float, float]]) -> Region:
    low, high = np.full(system.num_states, -np.inf), np.full(system.num_states, np.inf)
    names = [signal.name for signal in system.state_signals]
    for name, bounds in region.items():
        if name not in names:
            near = get_close_matches(str(name), names, n=1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            raise ModelError(
                f"{system.name}: region: no state '{name}'; {hint}states: {', '.join(names)}"
            )
        try:
            pair = np.array(bounds, dtype=float)
        except (TypeError, ValueError):
            pair = np.zeros(0)
        if pair.shape != (2,) or not np.all(np.isfinite(pair)) or pair[0] > pair[1]:
            raise ModelError(
                f"{system.name}: region: '{name}' needs two finite numbers, the lowest and the "
                f"highest value, got {bounds!r}"
            )
        low[names.index(name)], high[names.index(name)] = pair
    return Region(low, high)


def _guesses(
    system: DaeSystem, box: Region | None, count: int, random: np.random.Generator
) -> FloatArray:
    """The nominal state first, then random ones."""
    nominal = system.nominal_state
    drawn = nominal + _SPREAD * random.standard_normal((count, nominal.size))
    if box is None:
        return np.vstack([nominal, drawn])
    named = np.isfinite(box.low)
    low, high = box.low[named], box.high[named]
    drawn[:, named] = random.uniform(low, high, (count, low.size))
    return np.vstack([np.clip(nominal, box.low, box.high), drawn])


def _given(system: DaeSystem, states: ArrayLike) -> FloatArray:
    try:
        given = np.array(states, dtype=float)
    except (TypeError, ValueError):
        given = np.zeros(0)
    if (
        given.ndim != 2
        or given.shape[1] != system.num_states
        or not given.size
        or not np.all(np.isfinite(given))
    ):
        raise ModelError(
            f"{system.name}: states must be finite numbers of shape (k, {system.num_states}), got "
            f"{states!r}"
        )
    return given


def _check_consistent(manifold: Manifold, given: FloatArray, taken: FloatArray) -> None:
    """That each given state was taken but for round-off."""
    name = manifold.system.name
    for number, state in enumerate(given):
        residual = manifold.residual(state)
        worst = int(np.argmax(np.abs(residual))) if residual.size else 0
        if residual.size and not np.abs(residual[worst]) <= CONSISTENT:
            raise InconsistentStateError(
                f"{name}: states[{number}] is not consistent: "
                f"{manifold.residual_signals[worst].name} = {residual[worst]:.3g}; project it, for "
                "example with `find_structure(system).manifold.project`",
                residual,
            )
        if not np.any(np.all(np.isclose(taken, state, rtol=0.0, atol=1e-4), axis=1)):
            raise ModelError(
                f"{name}: states[{number}] is outside the domain: functions of (1)-(3) are not "
                "finite there"
            )


def _where(
    count: int,
    noun: str,
    region: Mapping[str, tuple[float, float]] | None,
    states: ArrayLike | None,
) -> str:
    place = "as given"
    if states is None:
        place = f"with {_bounds(region)}" if region else "around the nominal one"
    return f"{_count(count, noun)} {place}"


def _bounds(region: Mapping[str, tuple[float, float]]) -> str:
    return ", ".join(f"{name} in [{low:g}, {high:g}]" for name, (low, high) in region.items())


def _count(number: int, noun: str) -> str:
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
