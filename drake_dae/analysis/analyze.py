"""Examines one system and reports what the theory says about it: `analyze`."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from difflib import get_close_matches
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.analysis.report import Analysis, Assumption, Finding, count_of
from drake_dae.arrays import FloatArray, check_whole_number, numbers
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.states.margins import Margin
from drake_dae.dae.states.region import Region
from drake_dae.dae.states.samples import Fields, Samples, default_spread
from drake_dae.dae.structure import (
    Constrained,
    Structure,
    check_system,
    constraint_violation,
    control_violation,
    examine_constraints,
    examine_outputs,
)
from drake_dae.dae.system import DaeSystem, check_is_system
from drake_dae.dae.zero_dynamics.zero_dynamics import ZeroDynamics, first_outputs
from drake_dae.errors import AssumptionError, InconsistentStateError, ModelError, NonFiniteError

STATEMENTS = (
    "v acts on y_i first in derivative r_i",
    "A(x) has rank m, so v can keep all constraints",
    "u does not act on y_i before derivative r_i",
    "u acts on z_i first in derivative mu_i",
    "B(x) has rank p, so u can steer all outputs",
)
"""Assumptions (1) to (5) in a line each."""


_NEIGHBOURS = 5
"""Beside states that are given, where the first of them may have a zero that others have not."""


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
        states: Consistent states to examine instead, shape (k, n). Degrees are decided also at a
            few others close to the first: what is zero at one state alone is not zero.
        reference: t -> R(t), output-major as for `TrackingLaw`; the margins are also taken along
            the motion that it commands, and the zero dynamics judged at its first outputs.
        times: In s, increasing, shape (k,); where on the reference.
        start: State near which the motion along the reference starts, shape (n,); the first
            examined state if None; only with a reference.
        count: How many random states are drawn.
        seed: Of the random numbers.

    Returns:
        The report. An assumption that is violated is part of it, with what is known before.

    Raises:
        InconsistentStateError: No consistent state in the region or around the nominal state, or
            given states that are not consistent.
        ModelError: Arguments that make no sense, such as a reference whose derivatives are not
            those of its values; a system without controls, with a function that
            is not finite, or a mass matrix that is not symmetric and positive definite.
    """
    check_is_system(system, "analyze")
    if region is not None and states is not None:
        raise ModelError(f"{system.name}: give a region or states, not both")
    if (reference is None) != (times is None):
        raise ModelError(f"{system.name}: a reference needs times, and times need a reference")
    if start is not None and reference is None:
        raise ModelError(f"{system.name}: start is where a reference begins, and there is none")
    check_whole_number(f"{system.name}: count", count, 1)
    check_whole_number(f"{system.name}: seed", seed, 0)
    if not (reference is None or callable(reference)):
        raise ModelError(
            f"{system.name}: reference must be a function of the time that returns R(t), got "
            f"{reference!r}"
        )
    box = None if region is None else _box(system, region)
    random = np.random.default_rng(seed)
    if states is None:
        given, guesses = 0, _guesses(system, box, count, random)
    else:
        guesses = _given(system, states)
        given = len(guesses)
        around = default_spread(guesses[0]) * random.standard_normal(
            (_NEIGHBOURS, guesses.shape[1])
        )
        guesses = np.vstack([guesses, guesses[0] + 0.1 * around])
    try:
        check_system(system)
        constrained = examine_constraints(system, guesses, box)
    except AssumptionError as error:
        where = _where(len(guesses), len(guesses), "state", region, given)
        return Analysis(system, where, guesses[: given or None], _assumptions((), [error]))
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
        # Degrees are decided around them, too; margins are theirs alone.
        samples = Samples(samples.manifold, Fields(system.explicit), guesses[:given])
        _check_consistent(samples.manifold, guesses[:given], samples.states)
    where = _where(len(samples.states), len(guesses), "consistent state", region, given)
    analysis, dynamics = _examined(constrained, samples, where, search=states is None)
    if dynamics is None:
        return analysis
    if reference is None or times is None:
        return replace(analysis, zero_dynamics=dynamics.stability(samples.states[0]))
    with suppress(NonFiniteError), np.errstate(all="ignore"):  # The motion tells when.
        _check_reference(dynamics.structure, reference, times)
    motion = dynamics.motion(reference, times, samples.states[0] if start is None else start)
    rest, outputs = samples.states[0], None
    if motion.times.size:
        # The state does not tell outputs with mu_i = 0: they are as the reference begins.
        rest = motion.states[0]
        outputs = first_outputs(dynamics.structure, reference(float(motion.times[0])))
    stability = dynamics.stability(rest, outputs=outputs)
    return replace(analysis, motion=motion, zero_dynamics=stability)


def _examined(
    constrained: Constrained, samples: Samples, where: str, search: bool
) -> tuple[Analysis, ZeroDynamics | None]:
    """From the constraints on, with margins at given samples; without the zero dynamics."""
    elimination = constrained.elimination
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
        margin = samples.margin(matrix, search=search)
        constrained = replace(constrained, margin=margin)
        judge(margin, constraint_violation(system, constrained.degrees, margin), 2)
        regular = samples.is_regular(matrix)
    if regular:
        try:
            structure = examine_outputs(constrained)
        except AssumptionError as error:
            errors.append(error)
        else:
            matrix = structure.control_matrix
            satisfied |= {4, 5}
            margin = samples.margin(matrix, structure.round_off, search)
            structure = replace(structure, control_margin=margin)
            judge(margin, control_violation(system, structure.output_degrees, margin), 5)
            known |= {
                "output_degrees": structure.output_degrees,
                "output_order": structure.output_order,
                "independence": _independence(structure, samples),
            }
            if samples.is_regular(matrix, structure.round_off):
                dynamics = ZeroDynamics(structure)
                known["structure"] = structure
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


def _check_reference(
    structure: Structure, reference: Callable[[float], FloatArray], times: ArrayLike
) -> None:
    """That each entry of R(t) that says so is the derivative of the one before.

    Against central differences with two steps: where these do not agree, as at a kink of the
    highest derivative, nothing is said.
    """
    system, grid = structure.system, numbers(f"{structure.system.name}: times", times).reshape(-1)
    degrees = structure.output_degrees
    size = sum(degree + 1 for degree in degrees)

    def value(time: float) -> FloatArray:
        given = reference(time)
        found = None if given is None else numbers(f"{system.name}: reference({time:g})", given)
        if found is None or found.size != size:
            raise ModelError(
                f"{system.name}: the reference must have size {size} (each output and its "
                f"derivatives up to its degree {degrees}), got "
                f"{'None' if found is None else found.size}"
            )
        return found.reshape(-1)

    if not grid.size or not np.all(np.isfinite(grid)):
        return
    value(float(grid[0]))
    length = float(grid[-1] - grid[0])
    step = 1e-6 * length
    if step <= 1e-9 * np.max(np.abs(grid)):
        return
    # Not at round fractions, where references have their breaks.
    tried = grid[0] + length * (0.05 + 0.9 * (np.arange(1, 10) * 0.6180339887 % 1.0))
    values = np.array([value(time) for time in tried])
    slopes, coarse = (
        np.array([(value(t + h) - value(t - h)) / (2 * h) for t in tried]) for h in (step, 2 * step)
    )
    start = 0
    for signal, degree in zip(system.output_signals, degrees, strict=True):
        for order in range(degree):
            i = start + order
            told, found = values[:, i + 1], slopes[:, i]
            scale = max(np.abs(told).max(), np.abs(found).max())
            round_off = 1e-13 * np.abs(values[:, i]).max() / step
            unsure = 4.0 * np.abs(found - coarse[:, i])
            excess = np.abs(told - found) - 1e-3 * scale - round_off - unsure
            worst = int(np.argmax(excess))
            if excess[worst] > 0.0:
                raise ModelError(
                    f"{system.name}: the reference contradicts itself: it tells "
                    f"{signal.derivative(order + 1).name} = {told[worst]:.4g} at t = "
                    f"{tried[worst]:.4g} s, but {signal.derivative(order).name} changes by "
                    f"{found[worst]:.4g} per second. Give the derivatives of r, output by output: "
                    "r_1, r_1', ..., r_2, ..."
                )
        start += degree + 1


def _box(system: DaeSystem, region: Mapping[str, tuple[float, float]]) -> Region:
    if not isinstance(region, Mapping):
        raise ModelError(
            f"{system.name}: region must be state name -> (lowest, highest), got {region!r}"
        )
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
    drawn = nominal + default_spread(nominal) * random.standard_normal((count, nominal.size))
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
        if not manifold.is_consistent(state):
            residual = manifold.residual(state)
            worst = int(np.argmax(np.abs(residual)))
            raise InconsistentStateError(
                f"{name}: states[{number}] is not consistent: "
                f"{manifold.residual_signals[worst].name} = {residual[worst]:.3g}; project it, for "
                "example with `find_structure(system).manifold.project`",
                residual,
            )
        near = 1e-4 * np.maximum(np.abs(state), np.abs(taken).max(axis=0))
        if not np.any(np.all(np.abs(taken - state) <= near, axis=1)):
            raise ModelError(
                f"{name}: states[{number}] is outside the domain: functions of (1)-(3) are not "
                "finite there"
            )


def _where(
    kept: int,
    drawn: int,
    noun: str,
    region: Mapping[str, tuple[float, float]] | None,
    given: int,
) -> str:
    if given:
        return f"{count_of(given, noun)} as given"
    place = f"with {_bounds(region)}" if region else "around the nominal one"
    missing = f"; {drawn - kept} more were outside the domain or off N*" if drawn > kept else ""
    return f"{count_of(kept, noun)} {place}{missing}"


def _bounds(region: Mapping[str, tuple[float, float]]) -> str:
    return ", ".join(f"{name} in [{low:g}, {high:g}]" for name, (low, high) in region.items())
