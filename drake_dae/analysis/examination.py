"""Examines one system and reports what the theory says about it: `analyze`."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_dae.analysis.report import Analysis, Assumption, Finding
from drake_dae.analysis.tables import count_of
from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, check_whole_number
from drake_dae.dae import DaeSystem, RankMargin, Stability, Violation, ZeroDynamics, why_no_law
from drake_dae.dae.margins import ContactMargins, find_margin
from drake_dae.dae.structure import (
    check_system,
    constraint_violation,
    control_violation,
    examine_constraints,
    examine_outputs,
)
from drake_dae.errors import AssumptionError, ModelError
from drake_dae.references import Reference

STATEMENTS = (
    "v acts on y_i first in derivative r_i",
    "A(x) has rank m, so v can enforce all constraints",
    "u does not act on y_i before derivative r_i",
    "u acts on z_i first in derivative mu_i",
    "B(x) has rank p, so u can control all outputs",
)
"""Assumptions (1) to (5), in a line each."""

COUNT, SEED = 50, 0
"""The number of random states that are examined by default, and the seed of their numbers."""


@checked(ModelError)
def analyze(
    system: DaeSystem,
    *,
    reference: Callable[[float], FloatArray] | None = None,
    times: ArrayLike | None = None,
    start: ArrayLike | None = None,
    period: float | None = None,
    exogenous: Sequence[Reference] = (),
    count: int = COUNT,
    seed: int = SEED,
) -> Analysis:
    """Examines relative degrees, index, Assumptions (1)-(5) and 2.2, also along a reference.

    Numbers are decided at random consistent states around `system.nominal_state`, with the default
    parameters. Degrees must be the same for all numbers that parameters may have, see
    `DaeSystem.with_bounds`. A determinant that changes its
    sign between the first state and another one is zero on the way. From the worst of the random
    ones the smallest singular values of A(x) and B(x) are also followed downhill, inside
    the box that the random states span, so that a singular state between them is found as a
    rule. There is no proof that none was missed.

    Where friction acts on contacts that can only push, the margin of A(x) is that without friction,
    and the sign of `contact_margin` shows how far friction is from the Painleve paradox, with the
    critical coefficients; the same along a reference.

    Args:
        system: The system (1)-(3).
        reference: The function t -> R(t), as for `TrackingLaw`; the margins are also taken along
            the motion that it commands, and the zero dynamics judged at its first outputs.
        times: Times in s at which the reference is examined, increasing, shape (k,).
        start: State near which the motion along the reference starts, shape (n,); the first
            examined state if None; only with a reference.
        period: The period of the reference and of the exogenous signals, in s; the zero dynamics
            are then also judged along the reference.
        exogenous: The references of the exogenous signals; all else is examined with
            these signals at rest at their parameters' values.
        count: The number of random states.
        seed: The seed of the random numbers.

    Returns:
        The report. An assumption that is violated is part of it, with what is known before.

    Raises:
        InconsistentStateError: There is no consistent state around the nominal state.
        ModelError: Arguments make no sense, or the system has a function that is not finite, or a
            mass matrix that is not symmetric and positive definite.
    """
    if (reference is None) != (times is None):
        raise ModelError(f"{system.name}: a reference needs times, and times need a reference")
    for name, value in (("start", start), ("period", period)):
        if value is not None and reference is None:
            raise ModelError(f"{system.name}: {name} is that of a reference, and none is given")
    check_whole_number(f"{system.name}: count", count, 1)
    check_whole_number(f"{system.name}: seed", seed, 0)
    analysis = examine(system, count, seed)
    return along(analysis, reference, times, start, period, exogenous)


def examine(system: DaeSystem, count: int = COUNT, seed: int = SEED) -> Analysis:
    """Examines degrees, Assumptions (1)-(5) and margins, without zero dynamics."""
    # The states.
    nominal, random = system.nominal_state, np.random.default_rng(seed)
    drawn = system.spread_around(nominal) * random.standard_normal((count, nominal.size))
    guesses = np.vstack([nominal, nominal + drawn])
    try:
        check_system(system)
        constrained, samples = examine_constraints(system, guesses)
    except AssumptionError as error:
        where = f"{count_of(len(guesses), 'state')} around the nominal one"
        return Analysis(system, where, guesses, _assumptions((), [error.violation]))
    where = f"{count_of(len(samples.states), 'consistent state')} around the nominal one"
    if left_out := len(guesses) - len(samples.states):
        where += f"; {left_out} more were outside the domain or off N*"

    # The constraints.
    elimination = constrained.elimination
    results: dict[str, Any] = {"constraint_degrees": constrained.constraint_degrees}
    margins: dict[int, RankMargin] = {}
    violations: list[Violation] = []
    satisfied, regular = {1, 2, 3}, True

    def judge(margin: RankMargin, violation: Violation | None, number: int) -> None:
        if violation:
            violations.append(violation)
            satisfied.difference_update({violation.assumption, number})
        margins[violation.assumption if violation else number] = margin

    if constrained.constraint_margin is not None:
        matrix = system.frictional_contacts.without_friction(elimination.constraint_matrix)
        margin = find_margin(samples, matrix, search=True)
        constrained = replace(constrained, constraint_margin=margin)
        judge(margin, constraint_violation(constrained), 2)
        regular = margin.is_regular_at_samples
    if regular:
        results["constraint_structure"] = constrained
        if system.frictional_contacts:
            margins_of_contacts = ContactMargins(system, elimination.constraint_matrix)
            results["contact_margin"] = margins_of_contacts.over(samples)

    # The outputs.
    without_law = why_no_law(system)
    if regular and not without_law:
        try:
            structure = examine_outputs(constrained, samples)
        except AssumptionError as error:
            violations.append(error.violation)
        else:
            matrix = structure.control_matrix
            satisfied |= {4, 5}
            margin = find_margin(samples, matrix, structure.round_off, search=True)
            structure = replace(structure, control_margin=margin)
            judge(margin, control_violation(structure), 5)
            results["output_degrees"] = structure.output_degrees
            if margin.is_regular_at_samples:
                results["structure"] = structure
    assumptions = _assumptions(satisfied, violations, margins, without_law)
    return Analysis(system, where, samples.states, assumptions, **results)


def along(
    analysis: Analysis,
    reference: Callable[[float], FloatArray] | None = None,
    times: ArrayLike | None = None,
    start: ArrayLike | None = None,
    period: float | None = None,
    exogenous: Sequence[Reference] = (),
) -> Analysis:
    """Adds zero dynamics, and what `analyze` says along a reference, if there is a structure."""
    system, states, structure = analysis.system, analysis.states, analysis.structure
    if structure is None:
        return analysis
    dynamics, found = ZeroDynamics(system, structure=structure), dict[str, Any]()
    rest, outputs = states[0], None
    if reference is not None and times is not None:
        guess = states[0] if start is None else start
        motion = found["motion"] = dynamics.motion(reference, times, guess, exogenous=exogenous)
        if motion.times.size:
            # The state does not determine outputs with mu_i = 0: they are taken from the start of
            # the reference.
            rest = motion.states[0]
            outputs = structure.layout.values(reference(float(motion.times[0])))
            if system.frictional_contacts:
                contacts = ContactMargins(system, structure.elimination.constraint_matrix)
                margin = contacts.along(motion.times, motion.states, motion.parameters)
                found["contact_margin_along"] = margin
        if dynamics.dimension and period is not None:
            found["zero_dynamics_along"] = dynamics.stability_along(
                reference, motion, period, exogenous=exogenous
            )
    stability = dynamics.stability(rest, outputs=outputs)
    equilibria = _equilibria(dynamics, stability, states, outputs)
    return replace(analysis, zero_dynamics=stability, equilibria=equilibria, **found)


def _equilibria(
    dynamics: ZeroDynamics, stability: Stability, states: FloatArray, outputs: FloatArray | None
) -> tuple[Stability, ...]:
    """Returns the verdicts on all equilibria with the same outputs, the judged one first."""
    if not dynamics.dimension:
        return ()
    judged: tuple[Stability, ...] = ()
    if stability.state is not None and len(dynamics.equilibria([stability.state], None, outputs)):
        judged, states = (stability,), np.vstack([stability.state, states])
    others = dynamics.equilibria(states, outputs=outputs)[len(judged) :]
    return (*judged, *(dynamics.stability(state, outputs=outputs) for state in others))


def _assumptions(
    satisfied: Container[int],
    violations: Sequence[Violation],
    margins: Mapping[int, RankMargin] | None = None,
    not_examined: str = "",
) -> tuple[Assumption, ...]:
    """Returns Assumptions (1)-(5); those neither satisfied nor violated were not examined."""
    violated = {violation.assumption: violation for violation in violations}
    before = f"Assumption ({violations[0].assumption}) is violated" if violations else not_examined
    result = []
    for number, statement in enumerate(STATEMENTS, start=1):
        if number in violated:
            finding, reason = Finding.VIOLATED, str(violated[number])
        elif number in satisfied:
            finding, reason = Finding.SATISFIED, ""
        else:
            finding, reason = Finding.NOT_EXAMINED, before
        margin = (margins or {}).get(number)
        violation = violated.get(number)
        result.append(Assumption(number, statement, finding, margin, reason, violation))
    return tuple(result)
