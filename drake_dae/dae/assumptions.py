"""How a system can violate Assumptions (1)-(5), as values, and which rows depend on which."""

from dataclasses import dataclass
from enum import Enum

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.derivatives import Elimination
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.samples import Deciding, Samples
from drake_dae.errors import AssumptionError
from drake_dae.trace.numerics import (
    SINGULAR,
    are_dependent,
    equilibrated,
    equilibration,
    significant,
    smallest_singular_value,
)

_NO_DEGREE = (
    "the relative degree of {what} is not defined{where}: {acts} on its derivative {order} around "
    "this state, but not there"
)
_LOSES_RANK = "A(x) loses rank{where}: {evidence}"


class ViolationKind(Enum):
    """The kinds of violations: what is wrong, and the remedy."""

    COUNT = "the m = {count} constraints are more than the states", "Remove the redundant ones"
    CONSTRAINT_DEGREE = (
        _NO_DEGREE,
        "Keep away from this state, or write the constraint so that its gradient does not vanish",
    )
    OUTPUT_DEGREE = _NO_DEGREE, "Choose another output, or keep away from this state"
    EARLY_CONTROL = (
        "the control acts on derivative {order} of {what}, before any constraint input "
        "does{where}, and so binds the control, not the state",
        "Take that control out, or add an actuator state in front of it",
    )
    NO_FORCE = (
        "no constraint input ever acts on {what}: none reaches it, or its derivatives repeat each "
        "other or fill the state; {evidence}",
        "It is redundant, or no constraint input enforces it",
    )
    NO_CONTROL = (
        "the control never acts on {what}: none reaches it, or it follows from the constraints or "
        "from its own derivatives, so it has no relative degree and B(x) no row for it",
        "Choose another output",
    )
    CONSTRAINT_RANK = (
        _LOSES_RANK,
        "Their gradients are independent there, but the constraint inputs cannot act on them "
        "independently. Keep away from this state, or change how the constraint inputs enter",
    )
    REDUNDANT = (
        _LOSES_RANK,
        "The constraints are redundant at every state, so that the forces are not determined. "
        "Remove one with its constraint input, as drop_constraints does, or have the forces shared "
        "by least squares: share_forces, or `compliances` of a robot or a scenario",
    )
    SINGULAR_CONFIGURATION = (
        _LOSES_RANK,
        "This is a singular configuration: forces are not determined there. Choose a nominal state "
        "and motions that keep away, or give one of the constraints a spring or a clearance",
    )
    HIDDEN_DEGREE = (
        _LOSES_RANK,
        "No constraint is redundant, but one less the combination of others that its row follows "
        "from has a higher relative degree. Write this difference in its place: N* stays the same",
    )
    NUMBERS = (
        "the relative degree of {what} depends on numbers: {acts} on its derivative {order} "
        "{deciding}",
        "Give such a parameter or signal another default, or give its range, by "
        "`DaeSystem.with_bounds` or `bounds` of a scenario; equal bounds fix it at its default",
    )
    BOUNDS = (
        "{matrix} loses rank within the bounds, {deciding}",
        "Give narrower bounds, which exclude this value",
    )
    CONTROL_RANK = (
        "B(x) of (16) is singular{where}: {what} cannot be steered independently; {evidence}",
        "Choose other outputs, keep away from this state, or see whether `dynamic_extension` finds "
        "integrators that help",
    )


@dataclass(frozen=True)
class Combination:
    """A row of a matrix that is a linear combination of others: row = sum factors_j row_j."""

    name: str
    others: tuple[str, ...]
    factors: FloatArray

    def __str__(self) -> str:
        pairs = zip(self.factors, self.others, strict=True)
        terms = " + ".join(f"{factor:.4g} {other}" for factor, other in pairs)
        return f"'{self.name}' ~ {terms.replace('+ -', '- ') or '0'}"


@dataclass(frozen=True, eq=False)
class Violation:
    """A violation of one of Assumptions (1)-(5) by a system."""

    assumption: int  # Its number, 1 to 5.
    cause: ViolationKind
    names: tuple[str, ...]  # The constraints or outputs.
    order: int | None = None  # Of the derivative on which an input acts.
    state: FloatArray | None = None  # Where, shape (n,).
    singular_value: float | None = None  # The smallest one there, rows and columns scaled,
    least: float | None = None  # and the value below which it counts as zero.
    combinations: tuple[Combination, ...] = ()  # The rows that are combinations of others.
    deciding: Deciding | None = None  # The parameters on which it depends.

    def error(self) -> AssumptionError:
        """Returns the exception for this violation."""
        return AssumptionError(str(self), self.assumption, self.state, self)

    def __str__(self) -> str:
        what, remedy = self.cause.value
        of_constraints = self.assumption <= 3
        evidence = []
        if self.singular_value is not None:
            evidence.append(
                f"smallest singular value {self.singular_value:.1e}, rows and columns scaled, "
                f"below the least_margin of {self.least:.0e}"
            )
        if self.combinations:
            evidence.append(f"dependent rows: {'; '.join(map(str, self.combinations))}")
        names = ", ".join(f"'{name}'" for name in self.names)
        text = what.format(
            count=len(self.names),
            what=f"{'constraint' if of_constraints else 'output'} {names}",
            order=self.order,
            where="" if self.state is None else f" at x = {show(self.state)}",
            acts="the constraint inputs act" if self.assumption == 1 else "the control acts",
            matrix="A(x)" if of_constraints else "B(x) of (16)",
            deciding=self.deciding,
            evidence="; ".join(evidence),
        ).rstrip("; ")
        text = f"Assumption ({self.assumption}): {text}. {remedy}"
        if self.deciding is None or "{deciding}" in what:
            return text
        return f"{text}. This depends on parameter values: it is not so {self.deciding}"


def find_dependence(
    manifold: Manifold, elimination: Elimination, states: FloatArray, where: FloatArray
) -> tuple[ViolationKind, tuple[Combination, ...]]:
    """Finds how the constraints depend on each other at a state where A(x) is singular."""
    system = manifold.system
    A = system.matrix("dependence", elimination.constraint_matrix)
    matrices = [A(x, system.parameter_values) for x in (where, *states)]
    everywhere = all(
        smallest_singular_value(equilibrated(each)) < system.least_margin for each in matrices
    )
    examined = [where, *states] if everywhere else [where]
    in_gradients = all(are_dependent(manifold.gradients(x) * system.scale) for x in examined)
    last = system.matrix("dependence", elimination.constraint_gradient)
    gradient = last(where, system.parameter_values) * system.scale
    # Chains may depend on each other below their last derivatives alone.
    rows = gradient if in_gradients and are_dependent(gradient) else matrices[0]
    if in_gradients:
        kind = ViolationKind.REDUNDANT if everywhere else ViolationKind.SINGULAR_CONFIGURATION
    else:
        kind = ViolationKind.HIDDEN_DEGREE if everywhere else ViolationKind.CONSTRAINT_RANK
    return kind, combinations_of([s.name for s in system.constraint_output_signals], rows)


def redundant_constraints(samples: Samples) -> tuple[Combination, ...]:
    """If gradients depend at all samples, the rows that do so at the first."""
    system = samples.system
    if not samples.dependent(system.k):
        return ()
    ((gradient,), *_) = samples.values(gradient=ca.jacobian(system.k, system.state))
    names = [signal.name for signal in system.constraint_output_signals]
    return combinations_of(names, gradient * system.scale)


def combinations_of(names: list[str], matrix: FloatArray) -> tuple[Combination, ...]:
    """Returns the rows that depend on earlier ones."""
    matrix = significant(matrix)
    rows, columns = equilibration(matrix)
    scaled = matrix / rows[:, None] / columns
    independent: list[int] = []
    combinations = []

    def fit(row: int, others: list[int]) -> FloatArray:
        """The factors of the combination of other rows that is nearest to a row."""
        return np.asarray(np.linalg.lstsq(scaled[others].T, scaled[row])[0])

    for i, name in enumerate(names):
        factors = fit(i, independent)
        if np.linalg.norm(scaled[i] - factors @ scaled[independent]) >= SINGULAR:
            independent.append(i)
            continue
        used = [j for j, c in zip(independent, factors, strict=True) if abs(c) > SINGULAR]
        factors = fit(i, used) * rows[i] / rows[used]
        combinations.append(Combination(name, tuple(names[j] for j in used), factors))
    return tuple(combinations)
