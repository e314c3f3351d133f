"""What the theory says of one system: values, problems, text and data."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.analysis.tables import Part, Table, count_of, named_values, to_text
from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.dae import (
    ComplexArray,
    ConstraintStructure,
    ContactMargin,
    DaeSystem,
    DerivativeLayout,
    PinnedMotion,
    RankMargin,
    Signal,
    Stability,
    StabilityAlong,
    Structure,
    Verdict,
    Violation,
    why_no_law,
)
from drake_dae.errors import ModelError


class Finding(StrEnum):
    """The verdicts on an assumption."""

    SATISFIED = "satisfied"
    VIOLATED = "violated"
    UNDECIDED = "not decided"
    NOT_EXAMINED = "not examined"


@dataclass(frozen=True, eq=False)
class Assumption:
    """One of Assumptions (1)-(5), with the verdict on it.

    Attributes:
        number: The number of the assumption in the paper.
        statement: The requirement, in one line.
        finding: Whether it holds at the examined states and between them.
        margin: The margin of A(x) for (2), and of B(x) for (5); for (1) and (4) where a row of
            these vanishes; else None.
        reason: The violation and its remedy, or why it was not examined; else empty.
        violation: The violation as data; None if the assumption is not violated.
    """

    number: int
    statement: str
    finding: Finding
    margin: RankMargin | None
    reason: str
    violation: Violation | None = None


@checked(ModelError)
@dataclass(frozen=True, eq=False, repr=False)
class Analysis:
    """The report of `analyze` on one system; `print` shows it as text.

    Values that are not known, since an assumption is violated, are None.

    Attributes:
        system: The system.
        where: A text that says which states were examined.
        states: The states, consistent where the constraints have degrees, shape (samples, n).
        assumptions: Assumptions (1), ..., (5), in this order.
        constraint_degrees: r_1, ..., r_m.
        output_degrees: mu_1, ..., mu_p in the order of the system's outputs.
        zero_dynamics: Assumption 2.2, by linearization at an equilibrium.
        equilibria: All equilibria of the zero dynamics with the same outputs that were found from
            the examined states.
        zero_dynamics_along: Assumption 2.2 along a periodic reference; None also without one.
        motion: The motion along the reference; None also without one.
        contact_margin: The distance of friction from the Painleve paradox; None without friction.
        contact_margin_along: That distance along the reference; None also without a reference.
        constraint_structure: The structure of the constraints alone, for `DaePlant`; None if A(x)
            is singular at an examined state, or a constraint has no degree.
        structure: The structure, for laws and blocks; None if A(x) or B(x) is singular at an
            examined state. If it is singular only between them, the assumption is violated but
            there is a structure.
    """

    system: DaeSystem
    where: str
    states: FloatArray
    assumptions: tuple[Assumption, ...]
    constraint_degrees: tuple[int, ...] | None = None
    output_degrees: tuple[int, ...] | None = None
    zero_dynamics: Stability | None = None
    equilibria: tuple[Stability, ...] = ()
    zero_dynamics_along: StabilityAlong | None = None
    motion: PinnedMotion | None = None
    contact_margin: ContactMargin | None = None
    contact_margin_along: ContactMargin | None = None
    constraint_structure: ConstraintStructure | None = None
    structure: Structure | None = None

    @property
    def output_order(self) -> tuple[int, ...] | None:
        """The outputs in the paper's order (15): those with mu_i >= 1 first."""
        if self.output_degrees is None:
            return None
        layout = DerivativeLayout(self.output_degrees)
        return (*map(int, layout.dynamic), *map(int, layout.direct))

    @property
    def _degrees_of_manifold(self) -> tuple[int, ...] | None:
        """r_1, ..., r_m, unless Assumption (2) fails, so that they do not add up."""
        violated = self.assumptions[1].finding is Finding.VIOLATED
        return None if violated else self.constraint_degrees

    @property
    def index(self) -> int | None:
        """max r_i + 1, the index of the DAE; 0 without constraints."""
        degrees = self._degrees_of_manifold
        return None if degrees is None else max(degrees, default=-1) + 1

    @property
    def manifold_dimension(self) -> int | None:
        """The dimension of N*, n - sum r_i, Theorem 1.1."""
        degrees = self._degrees_of_manifold
        return None if degrees is None else self.system.num_states - sum(degrees)

    @property
    def zero_dynamics_dimension(self) -> int | None:
        """The dimension of xi in (22), n - sum r_i - sum mu_i."""
        dimension, degrees = self.manifold_dimension, self.output_degrees
        return None if dimension is None or degrees is None else dimension - sum(degrees)

    @property
    def zero_dynamics_finding(self) -> Finding:
        """The verdict on Assumption 2.2.

        Violated if an eigenvalue at rest, or a multiplier, is unstable; otherwise decided along the
        reference if it is periodic, and at rest if not.
        """
        judged = [one.verdict for one in (self.zero_dynamics_along, self.zero_dynamics) if one]
        if not judged:
            return Finding.NOT_EXAMINED
        if Verdict.UNSTABLE in judged:
            return Finding.VIOLATED
        return Finding.SATISFIED if judged[0] is Verdict.STABLE else Finding.UNDECIDED

    @property
    def problems(self) -> tuple[str, ...]:
        """One text for each violation; empty if there are none."""
        sentences = [a.reason for a in self.assumptions if a.finding is Finding.VIOLATED]
        signals = self.system.state_signals
        # Along a reference the motion decides: elsewhere there may be no contact.
        contact = self.contact_margin_along or self.contact_margin
        if contact is not None and contact.is_paradoxical:
            when = "" if contact.time is None else f"t = {contact.time:.6g} s, "
            critical = ", ".join(f"{k} = {v:.4g}" for k, v in contact.critical_friction.items())
            sentences.append(
                f"Friction: the Painleve paradox occurs at {when}"
                f"{named_values(signals, contact.state)}: a principal "
                f"minor of A(x) is {contact.reserve:.3g} of what it is without friction, and "
                f"{critical} is critical there. Lower the friction, slide the other way, or hold "
                "the robot less steeply to the surface"
            )
        judged = ("", self.zero_dynamics), ("along the reference ", self.zero_dynamics_along)
        for place, one in judged:
            if one is not None and one.verdict is Verdict.UNSTABLE:
                sentences.append(f"Assumption 2.2: {place}{one.reason}")
        if self.motion is not None and self.motion.ending is not None:
            sentences.append(str(self.motion.ending))
        return tuple(sentences)

    @property
    def worst_along(self) -> dict[str, tuple[float, float]]:
        """The smallest singular values of A(x) and B(x) along the reference, and when in s."""
        motion, found = self.motion, dict[str, tuple[float, float]]()
        if motion is None:
            return found
        for name, margins in (
            ("A(x)", motion.constraint_margins),
            ("B(x)", motion.control_margins),
        ):
            if margins.size and np.all(np.isfinite(margins)):
                worst = int(np.argmin(margins))
                found[name] = float(margins[worst]), float(motion.times[worst])
        return found

    def __repr__(self) -> str:
        problems = count_of(len(self.problems), "problem") if self.problems else "no problem found"
        return f"Analysis('{self.system.name}': {problems})"

    def __str__(self) -> str:
        return to_text([*self.parts(), *([problem] for problem in self.problems)])

    def parts(self) -> list[Part]:
        """Returns the paragraphs and tables of the report, without the problems."""
        return [*_parts(self)]

    def to_dict(self) -> dict[str, Any]:
        """Returns the report as plain numbers, lists and texts."""
        system, motion, order = self.system, self.motion, self.output_order
        zero, along, sharing = self.zero_dynamics, self.zero_dynamics_along, system.sharing
        rows, outputs = system.constraint_output_signals, system.output_signals
        return {
            "name": system.name,
            "num_states": system.num_states,
            "num_constraints": system.num_constraints,
            "num_controls": system.num_controls,
            "num_outputs": system.num_outputs,
            "states": [signal.name for signal in system.state_signals],
            "examined_at": self.where,
            "constraint_degrees": _by_name(rows, self.constraint_degrees),
            "index": self.index,
            "manifold_dimension": self.manifold_dimension,
            "redundant": sharing
            and {
                "left_out": [signal.name for signal in sharing.left_out_signals],
                "undetermined_forces": list(sharing.undetermined),
            },
            "output_degrees": _by_name(outputs, self.output_degrees),
            "output_order": order and [outputs[i].name for i in order],
            "zero_dynamics_dimension": self.zero_dynamics_dimension,
            "assumptions": [
                {
                    "number": a.number,
                    "statement": a.statement,
                    "finding": str(a.finding),
                    "margin": a.margin
                    and {
                        "singular_value": float(a.margin.singular_value),
                        "relative": float(a.margin.relative),
                        "state": a.margin.state.tolist(),
                    },
                    "reason": a.reason,
                }
                for a in self.assumptions
            ],
            "zero_dynamics": zero and {**_stability(zero), "reason": zero.reason},
            "equilibria": [_stability(equilibrium) for equilibrium in self.equilibria],
            "zero_dynamics_along": along
            and {
                "verdict": str(along.verdict),
                "period": along.period,
                "multipliers": _pairs(along.multipliers),
                "reason": along.reason,
            },
            "contact_margin": _friction(self.contact_margin),
            "contact_margin_along": _friction(self.contact_margin_along),
            "reference": motion
            and {
                "times": motion.times[[0, -1]].tolist() if motion.times.size else [],
                "failure": "" if motion.ending is None else str(motion.ending),
                "failure_time": None if motion.ending is None else float(motion.ending.time),
                "margins": {
                    name: {"smallest": smallest, "time": time}
                    for name, (smallest, time) in self.worst_along.items()
                },
            },
            "problems": list(self.problems),
        }


def _by_name(signals: Sequence[Signal], values: Sequence[int] | None) -> dict[str, int] | None:
    names = [signal.name for signal in signals]
    return None if values is None else dict(zip(names, values, strict=True))


def _friction(margin: ContactMargin | None) -> dict[str, Any] | None:
    """The distance from the Painleve paradox; a coefficient without a critical value is None."""
    if margin is None:
        return None
    critical = margin.critical_friction.items()
    return {
        "reserve": margin.reserve,
        "critical_friction": {n: value if np.isfinite(value) else None for n, value in critical},
        "state": margin.state.tolist(),
        "time": margin.time,
    }


def _stability(stability: Stability) -> dict[str, Any]:
    return {
        "verdict": str(stability.verdict),
        "eigenvalues": _pairs(stability.eigenvalues),
        "state": None if stability.state is None else stability.state.tolist(),
    }


def _pairs(values: ComplexArray) -> list[list[float]]:
    """Complex numbers as their real and imaginary parts."""
    return np.stack([values.real, values.imag], axis=-1).tolist()


def _parts(found: Analysis) -> Iterator[Part]:
    """The paragraphs and tables of a report."""
    system = found.system
    counts = (
        count_of(system.num_states, "state"),
        count_of(system.num_constraints, "constraint"),
        count_of(system.num_controls, "control"),
        count_of(system.num_outputs, "controlled output"),
    )
    yield [f"{system.name}: {', '.join(counts)}", f"examined at {found.where}"]
    degrees, order = found.constraint_degrees or "?" * system.num_constraints, found.output_order
    names = [signal.name for signal in system.constraint_output_signals]
    if names:
        pairs = zip(names, degrees, strict=True)
        yield Table(["constraint", "r"], [[name, str(r)] for name, r in pairs])
    mu = found.output_degrees or "?" * system.num_outputs
    rows = [
        [signal.name, str(mu[i]), "?" if order is None else str(order.index(i) + 1)]
        for i, signal in enumerate(system.output_signals)
    ]
    if rows:
        yield Table(["output", "mu", "order in (15)"], rows)
    sizes = (found.index, found.manifold_dimension, found.zero_dynamics_dimension)
    index, manifold, zero = ("?" if size is None else size for size in sizes)
    ending = f", zero dynamics of dimension {zero}" if rows else ""
    yield [f"index {index}, N* of dimension {manifold}{ending}"]
    if system.sharing is not None:
        gone = ", ".join(f"'{signal.name}'" for signal in system.sharing.left_out_signals)
        yield [
            f"Left out as redundant: {gone}. The distribution of "
            f"{', '.join(system.sharing.undetermined)} is not determined by (1)-(3): it is "
            "computed by least squares, and any other gives the same motion."
        ]
    yield _table_of_assumptions(found)
    if any(a.margin for a in found.assumptions):
        yield [
            "margin: smallest singular value after rows and columns are scaled to about length "
            f"one; below {system.least_margin:.0e} it counts as singular."
        ]
    if lines := [*_places(found), *_on_zero_dynamics(found)]:
        yield lines
    motion = found.motion
    if motion is not None and motion.times.size:
        title = f"along the reference, {motion.times[0]:g} to {motion.times[-1]:g} s"
        worst = found.worst_along.items()
        rows = [[name, f"{smallest:.4g}", f"{time:.4g} s"] for name, (smallest, time) in worst]
        yield Table([title, "smallest singular value", "at"], rows)


def _table_of_assumptions(found: Analysis) -> Table:
    free = "" if found.system.num_constraints else ": m = 0"
    none = ": the system has none" if found.zero_dynamics_dimension == 0 else ""
    entries = [
        *(
            (f"({a.number})  {a.statement}{free if a.number <= 3 else ''}", a.finding, a.margin)
            for a in found.assumptions
        ),
        (f"2.2  zero dynamics are stable{none}", found.zero_dynamics_finding, None),
    ]
    rows = [
        [text, str(finding), *(("", "") if m is None else _figures(m))]
        for text, finding, m in entries
    ]
    return Table(["assumption", "finding", "margin", "singular value"], rows, left=2)


def _figures(margin: RankMargin) -> tuple[str, str]:
    return f"{margin.relative:.2g}", f"{margin.singular_value:.4g}"


def _places(found: Analysis) -> Iterator[str]:
    """Where A(x) and B(x) are nearest to singular, where friction is nearest to the paradox."""
    system, structure = found.system, found.constraint_structure
    matrices = {}
    if structure is not None:
        matrix = structure.elimination.constraint_matrix
        matrices[2] = system.frictional_contacts.without_friction(matrix)
    if found.structure is not None:
        matrices[5] = found.structure.control_matrix
    for a in found.assumptions:
        if a.margin is not None and a.finding is Finding.SATISFIED and a.number in matrices:
            yield _nearest(found, "A" if a.number == 2 else "B", matrices[a.number], a.margin)
    for where, margin in (
        ("at the examined states", found.contact_margin),
        ("along the reference", found.contact_margin_along),
    ):
        if margin is None:
            continue
        critical = margin.critical_friction
        if not np.all(np.isfinite([*critical.values()])):
            yield f"Friction: {where} no coefficient leads to the Painleve paradox."
            continue
        used = None
        if structure is not None:
            matrix = ca.vec(structure.elimination.constraint_matrix)
            used = ca.which_depends(matrix, system.state, 1, False)
        when = "" if margin.time is None else f"t = {margin.time:.4g} s, "
        place = f"{when}{named_values(system.state_signals, margin.state, used)}"
        coefficients = ", ".join(f"{name} {value:.4g}" for name, value in critical.items())
        yield (
            f"Friction: {where} at least {margin.reserve:.3g} of A(x) is left; the Painleve "
            f"paradox is at {coefficients}, nearest at {place}."
        )
    if (why := why_no_law(system)) and structure is not None:
        yield f"The rest was not examined: {why}."
    if system.control_metric is not None and found.structure is not None:
        spare = count_of(system.num_controls - system.num_outputs, "combination")
        yield (
            f"B(x) leaves {spare} of the controls undetermined: they are as close as possible to "
            "free_control in the system's control_metric."
        )


def _nearest(found: Analysis, letter: str, matrix: ca.SX, margin: RankMargin) -> str:
    """Where A(x) or B(x) is nearest to singular, in the states that it depends on."""
    system = found.system
    used = ca.which_depends(ca.vec(matrix), system.state, 1, False)
    if not any(used):
        return f"{letter}(x) is the same at all states."
    value, states = (
        system.trace("margin", {"value": matrix}, often=False),
        [*found.states, margin.state],
    )
    values = np.array([value(state, system.parameter_values)[0] for state in states])
    if np.all(np.ptp(values, axis=0) <= 1e-9 * np.abs(values).max()):
        return f"{letter}(x) is the same at all examined states."
    place = named_values(system.state_signals, margin.state, used)
    return f"{letter}(x) is nearest to singular at {place}."


def _on_zero_dynamics(found: Analysis) -> Iterator[str]:
    zero, along = found.zero_dynamics, found.zero_dynamics_along
    if zero is not None and zero.eigenvalues.size:
        yield f"Zero dynamics: eigenvalues {_complex(zero.eigenvalues)} 1/s."
    if zero is not None and found.zero_dynamics_dimension and zero.verdict != Verdict.UNSTABLE:
        yield f"Zero dynamics {zero.verdict}: {zero.reason}."
    for equilibrium in found.equilibria if len(found.equilibria) > 1 else ():
        if equilibrium.state is not None:
            place = named_values(found.system.state_signals, equilibrium.state)
            yield f"At rest at {place}: {equilibrium.verdict}."
    if along is not None and along.multipliers.size:
        yield f"Along the reference: Floquet multipliers {_complex(along.multipliers)}."
    if along is not None and along.verdict != Verdict.UNSTABLE:
        yield f"Zero dynamics along the reference {along.verdict}: {along.reason}."


def _complex(values: ComplexArray) -> str:
    """Eigenvalues in words; a conjugate pair is one."""
    size, texts = np.abs(values).max(initial=0.0), []
    for value in values[values.imag >= 0.0]:
        real = 0.0 if abs(value.real) < 1e-9 * size else value.real
        texts.append(f"{real:.4g} ± {value.imag:.4g}i" if value.imag else f"{real:.4g}")
    return ", ".join(texts)
