"""Findings as text, tables and data."""

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.analysis.contact_text import contact_margin_as_dict, contact_margin_in_words
from drake_dae.analysis.findings import Finding, Findings
from drake_dae.analysis.tables import Part, Table, count_of, named_values
from drake_dae.dae.states.margins import RankMargin
from drake_dae.dae.structure.structure import why_no_law
from drake_dae.dae.system.signals import Signal
from drake_dae.dae.system.system import ForceSharing
from drake_dae.dae.zero_dynamics.pinned_motion import PinnedMotion
from drake_dae.dae.zero_dynamics.stability import ComplexArray, Stability, Verdict


def as_dict(findings: Findings) -> dict[str, Any]:
    """Returns the findings as plain numbers, lists and texts."""
    system = findings.system
    zero, motion = findings.zero_dynamics, findings.motion
    along = findings.zero_dynamics_along
    return {
        "name": system.name,
        "num_states": system.num_states,
        "num_constraints": system.num_constraints,
        "num_controls": system.num_controls,
        "num_outputs": system.num_outputs,
        "states": [signal.name for signal in system.state_signals],
        "examined_at": findings.where,
        "constraint_degrees": _by_name(
            system.constraint_output_signals, findings.constraint_degrees
        ),
        "index": findings.index,
        "manifold_dimension": findings.manifold_dimension,
        "redundant": None
        if system.sharing is None
        else {
            "left_out": [signal.name for signal in system.sharing.left_out_signals],
            "undetermined_forces": list(system.sharing.undetermined),
        },
        "output_degrees": _by_name(system.output_signals, findings.output_degrees),
        "output_order": None
        if findings.output_order is None
        else [system.output_signals[i].name for i in findings.output_order],
        "zero_dynamics_dimension": findings.zero_dynamics_dimension,
        "assumptions": [
            {
                "number": a.number,
                "statement": a.statement,
                "finding": str(a.finding),
                "margin": _margin(a.margin),
                "reason": a.reason,
            }
            for a in findings.assumptions
        ],
        "independence": _margin(findings.independence),
        "zero_dynamics": None if zero is None else {**_stability(zero), "reason": zero.reason},
        "equilibria": [_stability(equilibrium) for equilibrium in findings.equilibria],
        "zero_dynamics_along": None
        if along is None
        else {
            "verdict": str(along.verdict),
            "period": along.period,
            "multipliers": _pairs(along.multipliers),
            "reason": along.reason,
        },
        "contact_margin": contact_margin_as_dict(findings.contact_margin),
        "contact_margin_along": contact_margin_as_dict(findings.contact_margin_along),
        "reference": None if motion is None else _motion(motion),
        "problems": list(findings.problems),
    }


def parts_of(findings: Findings) -> list[Part]:
    """Returns the paragraphs and tables of the report, without the problems."""
    system = findings.system
    counts = (
        count_of(system.num_states, "state"),
        count_of(system.num_constraints, "constraint"),
        count_of(system.num_controls, "control"),
        count_of(system.num_outputs, "controlled output"),
    )
    parts: list[Part] = [[f"{system.name}: {', '.join(counts)}", f"examined at {findings.where}"]]
    if system.num_constraints:
        rows = [
            [signal.name, _known(findings.constraint_degrees, i)]
            for i, signal in enumerate(system.constraint_output_signals)
        ]
        parts.append(Table(["constraint", "r"], rows))
    order = findings.output_order
    rows = [
        [
            signal.name,
            _known(findings.output_degrees, i),
            "?" if order is None else str(order.index(i) + 1),
        ]
        for i, signal in enumerate(system.output_signals)
    ]
    if rows:
        parts.append(Table(["output", "mu", "order in (15)"], rows))
    index, manifold, zero = (
        "?" if number is None else str(number)
        for number in (
            findings.index,
            findings.manifold_dimension,
            findings.zero_dynamics_dimension,
        )
    )
    dimensions = f"index {index}, N* of dimension {manifold}"
    parts.append([f"{dimensions}, zero dynamics of dimension {zero}" if rows else dimensions])
    if system.sharing is not None:
        parts.append([_shared(system.sharing)])
    parts.append(_findings(findings))
    margins = [a.margin for a in findings.assumptions if a.margin] + [findings.independence]
    if any(margins):
        parts.append(
            [
                "margin: smallest singular value after rows and columns are scaled to about "
                f"length one; below {findings.system.least_margin:.0e} it counts as singular."
            ]
        )
    parts += _places(findings)
    if findings.motion is not None and findings.motion.times.size:
        parts.append(_along(findings.motion))
    return parts


def _shared(sharing: ForceSharing) -> str:
    """Which redundant constraints were left out, and which forces are not determined."""
    gone = ", ".join(f"'{signal.name}'" for signal in sharing.left_out_signals)
    forces = ", ".join(sharing.undetermined)
    return (
        f"Left out as redundant: {gone}. The distribution of {forces} is not determined by "
        "(1)-(3): it is computed by least squares, and any other gives the same motion."
    )


def _findings(findings: Findings) -> Table:
    free = "" if findings.system.num_constraints else ": m = 0"
    rows = [
        [
            f"({a.number})  {a.statement}{free if a.number <= 3 else ''}",
            str(a.finding),
            *_figures(a.margin),
        ]
        for a in findings.assumptions
    ]
    chains, zero = Finding.NOT_EXAMINED, findings.zero_dynamics_finding
    if findings.output_degrees is not None:
        singular = findings.independence is not None and findings.independence.is_singular
        chains = Finding.FAILS if singular else Finding.SATISFIED
    none = ": the system has none" if findings.zero_dynamics_dimension == 0 else ""
    rows += [
        [
            "2.1  theorem: gradients of all chains are independent",
            chains,
            *_figures(findings.independence),
        ],
        [f"2.2  zero dynamics are stable{none}", zero, "", ""],
    ]
    return Table(["assumption", "finding", "margin", "singular value"], rows, left=2)


def _places(findings: Findings) -> list[Part]:
    """The smallest margins, the zero dynamics, and why further results are missing."""
    matrices = {}
    if findings.constraint_structure is not None:
        matrix = findings.constraint_structure.elimination.constraint_matrix
        matrices[2] = findings.system.frictional_contacts.without_friction(matrix)
    if findings.structure is not None:
        matrices[5] = findings.structure.control_matrix
    lines = [
        _nearest(findings, a.number, matrices[a.number], a.margin)
        for a in findings.assumptions
        if a.margin is not None and a.finding is Finding.SATISFIED and a.number in matrices
    ]
    lines += [
        contact_margin_in_words(findings, where, margin)
        for where, margin in (
            ("at the examined states", findings.contact_margin),
            ("along the reference", findings.contact_margin_along),
        )
        if margin is not None
    ]
    why = why_no_law(findings.system)
    if why and findings.constraint_structure is not None:
        lines.append(f"The rest was not examined: {why}.")
    zero = findings.zero_dynamics
    spare = findings.system.num_controls - findings.system.num_outputs
    if findings.system.control_metric is not None and findings.structure is not None:
        lines.append(
            f"B(x) leaves {count_of(spare, 'combination')} of the controls undetermined: they are "
            "as close as possible to free_control in the system's control_metric."
        )
    if zero is not None and zero.eigenvalues.size:
        lines.append(f"Zero dynamics: eigenvalues {_complex(zero.eigenvalues)} 1/s.")
    if zero is not None and findings.zero_dynamics_dimension and zero.verdict != Verdict.UNSTABLE:
        lines.append(f"Zero dynamics {zero.verdict}: {zero.reason}.")
    if len(findings.equilibria) > 1:
        signals = findings.system.state_signals
        lines += [
            f"At rest at {named_values(signals, equilibrium.state)}: {equilibrium.verdict}."
            for equilibrium in findings.equilibria
            if equilibrium.state is not None
        ]
    along = findings.zero_dynamics_along
    if along is not None:
        if along.multipliers.size:
            lines.append(f"Along the reference: Floquet multipliers {_complex(along.multipliers)}.")
        if along.verdict != Verdict.UNSTABLE:
            lines.append(f"Zero dynamics along the reference {along.verdict}: {along.reason}.")
    return [lines] if lines else []


def _nearest(findings: Findings, number: int, matrix: ca.SX, margin: RankMargin) -> str:
    """Where A(x) or B(x) is nearest to singular, in the states that it depends on."""
    letter, system = "A" if number == 2 else "B", findings.system
    used = ca.which_depends(ca.vec(matrix), system.state, 1, False)
    if not any(used):
        return f"{letter}(x) is the same at all states."
    value = system.trace("margin", {"value": matrix}, often=False)
    values = np.array(
        [
            value(state, system.parameter_values)[0]
            for state in np.vstack([findings.states, margin.state])
        ]
    )
    if np.all(np.ptp(values, axis=0) <= 1e-9 * np.abs(values).max()):
        return f"{letter}(x) is the same at all examined states."
    place = named_values(system.state_signals, margin.state, used)
    return f"{letter}(x) is nearest to singular at {place}."


def _known(values: Sequence[int] | None, index: int) -> str:
    return "?" if values is None else str(values[index])


def _figures(margin: RankMargin | None) -> list[str]:
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
    margins_and_times = {}
    for letter, margins in (("A", motion.constraint_margins), ("B", motion.control_margins)):
        if margins.size and np.all(np.isfinite(margins)):
            worst = int(np.argmin(margins))
            margins_and_times[f"{letter}(x)"] = (float(margins[worst]), float(motion.times[worst]))
    return margins_and_times


def _complex(values: ComplexArray) -> str:
    """Eigenvalues in words; a conjugate pair is one."""
    size = np.abs(values).max(initial=0.0)
    texts = []
    for value in values:
        real = 0.0 if abs(value.real) < 1e-9 * size else value.real
        if value.imag > 0.0:
            texts.append(f"{real:.4g} ± {value.imag:.4g}i")
        elif value.imag == 0.0:
            texts.append(f"{real:.4g}")
    return ", ".join(texts)


def _stability(stability: Stability) -> dict[str, Any]:
    return {
        "verdict": str(stability.verdict),
        "eigenvalues": _pairs(stability.eigenvalues),
        "state": None if stability.state is None else stability.state.tolist(),
    }


def _pairs(values: ComplexArray) -> list[list[float]]:
    """Complex numbers as their real and imaginary parts."""
    return [[float(value.real), float(value.imag)] for value in values]


def _by_name(signals: Sequence[Signal], values: Sequence[int] | None) -> dict[str, int] | None:
    if values is None:
        return None
    return {signal.name: value for signal, value in zip(signals, values, strict=True)}


def _margin(margin: RankMargin | None) -> dict[str, Any] | None:
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
        "failure": "" if motion.ending is None else str(motion.ending),
        "failure_time": None if motion.ending is None else float(motion.ending.time),
        "margins": {
            letter: {"smallest": smallest, "time": time}
            for letter, (smallest, time) in _worst(motion).items()
        },
    }
