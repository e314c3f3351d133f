"""How a system can violate Assumptions (1)-(5), as values, and which rows depend on which."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

import casadi as ca
import numpy as np
import scipy.linalg

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.elimination import Elimination
from drake_dae.dae.family import Deciding
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.margins import RankMargin
from drake_dae.dae.samples import Samples
from drake_dae.dae.signals import Signal
from drake_dae.errors import AssumptionError
from drake_dae.trace.round_off import (
    SINGULAR,
    are_dependent,
    equilibrated,
    equilibration,
    significant,
    smallest_singular_value,
)

ON_MANIFOLD = 1e-8
"""The residual of a constraint that a state on N* may have. It appears in the gradient of an output
that is a constraint times a factor."""


class ViolationKind(Enum):
    """The kinds of violations; the enum value is the remedy."""

    COUNT = "Remove the redundant ones"
    CONSTRAINT_DEGREE = (
        "Keep away from this state, or write the constraint so that its gradient does not vanish"
    )
    OUTPUT_DEGREE = "Choose another output, or keep away from this state"
    EARLY_CONTROL = "Take that control out, or add an actuator state in front of it"
    NO_FORCE = "It is redundant, or no constraint input enforces it"
    NO_CONTROL = "Choose another output"
    CONSTRAINT_RANK = (
        "Their gradients are independent there, but the constraint inputs cannot act on them "
        "independently. Keep away from this state, or change how the constraint inputs enter"
    )
    REDUNDANT = (
        "The constraints are redundant at every state, so that the forces are not determined. "
        "Remove one with its constraint input, as drop_constraints does, or have the forces shared "
        "by least squares: share_forces, or `compliances` of a robot or a scenario"
    )
    SINGULAR_CONFIGURATION = (
        "This is a singular configuration: forces are not determined there, and motions on N* may "
        "branch. A plant that starts elsewhere passes through it if its velocity leads across; a "
        "law cannot. Choose a nominal state and motions that keep away, or give one of the "
        "constraints a spring or a clearance"
    )
    HIDDEN_DEGREE = (
        "No constraint is redundant, but one less the combination of others that its row follows "
        "from has a higher relative degree. Write this difference in its place: N* stays the same"
    )
    NUMBERS = (
        "The structure must be the same for all values of parameters and signals. Give such a "
        "parameter or signal another default, or give its range, by `DaeSystem.with_bounds` or "
        "`bounds` of a scenario; equal bounds fix it at its default"
    )
    BOUNDS = "Give narrower bounds, which exclude this value"
    CONTROL_RANK = (
        "Choose other outputs, keep away from this state, or see whether `dynamic_extension` finds "
        "integrators that help"
    )


@dataclass(frozen=True)
class Combination:
    """A row of a matrix that is a linear combination of others: row = sum factors_j row_j.

    It is `constant` if the factors are the same at all states.
    """

    name: str
    others: tuple[str, ...]
    factors: FloatArray
    constant: bool

    def __str__(self) -> str:
        terms = " + ".join(
            f"{factor:.4g} {other}" for other, factor in zip(self.others, self.factors, strict=True)
        )
        varying = "" if self.constant else ", with factors that depend on the state"
        return f"'{self.name}' ~ {terms.replace('+ -', '- ') or '0'}{varying}"


@dataclass(frozen=True, eq=False)
class Violation:
    """A violation of one of Assumptions (1)-(5) by a system.

    Attributes:
        assumption: The number of the assumption, 1 to 5.
        cause: Its kind.
        names: The constraints or outputs.
        order: The order of the derivative on which an input acts.
        state: Where, shape (n,).
        singular_value: The smallest singular value there, rows and columns scaled.
        combinations: The rows that are combinations of others.
        deciding: The parameters on which it depends.
        least: The value below which a singular value counts as zero.
    """

    assumption: int
    cause: ViolationKind
    names: tuple[str, ...]
    order: int | None = None
    state: FloatArray | None = None
    singular_value: float | None = None
    combinations: tuple[Combination, ...] = ()
    deciding: Deciding | None = None
    least: float | None = None

    def __str__(self) -> str:
        text = f"Assumption ({self.assumption}): {self._statement()}. {self.cause.value}"
        if self.deciding is None or self.cause in (ViolationKind.NUMBERS, ViolationKind.BOUNDS):
            return text
        acts = {
            ViolationKind.NO_FORCE: "a constraint input acts",
            ViolationKind.NO_CONTROL: "the control acts",
        }
        regular = f"{'A' if self.assumption <= 3 else 'B'}(x) is regular"
        return (
            f"{text}. This depends on parameter values: {acts.get(self.cause, regular)} "
            f"{self.deciding}"
        )

    def error(self) -> AssumptionError:
        """Returns the exception for this violation."""
        return AssumptionError(str(self), self.assumption, self.state, self)

    def _statement(self) -> str:
        names = ", ".join(f"'{name}'" for name in self.names)
        where = "" if self.state is None else f" at x = {show(self.state)}"
        value = "" if self.singular_value is None else f"{self.singular_value:.1e}"
        if value:
            value = f"smallest singular value {value}, rows and columns scaled"
            value += "" if self.least is None else f", below the least_margin of {self.least:.0e}"
        rows = "; ".join(map(str, self.combinations))
        kind = ViolationKind
        match self.cause:
            case kind.COUNT:
                return f"the m = {len(self.names)} constraints are more than the states"
            case kind.CONSTRAINT_DEGREE | kind.OUTPUT_DEGREE:
                what, inputs = "constraint", "constraint inputs act"
                if self.cause is kind.OUTPUT_DEGREE:
                    what, inputs = "output", "control acts"
                return (
                    f"the relative degree of {what} {names} is not defined{where}: the {inputs} "
                    f"on its derivative {self.order} around this state, but not there"
                )
            case kind.EARLY_CONTROL:
                return (
                    f"the control acts on derivative {self.order} of constraint {names}, before "
                    f"any constraint input does{where}, and so binds the control, not the state"
                )
            case kind.NO_FORCE:
                return (
                    f"no constraint input ever acts on constraint {names}: none reaches it, or its "
                    "derivatives repeat each other or fill the state"
                    f"{f'; gradients of constraints: {rows}' if rows else ''}"
                )
            case kind.NO_CONTROL:
                why = f"it follows from the constraints, {rows}"
                if not rows:
                    why = "its derivatives repeat those of the constraints, or none reaches it"
                return (
                    f"the control never acts on output {names}: {why}, so it has no relative "
                    "degree and B(x) no row for it"
                )
            case kind.NUMBERS:
                what = "output" if self.assumption == 4 else "constraint"
                inputs = "constraint inputs act" if self.assumption == 1 else "control acts"
                return (
                    f"the relative degree of {what} {names} depends on numbers: the {inputs} on "
                    f"its derivative {self.order} {self.deciding}"
                )
            case kind.BOUNDS:
                matrix = "A(x)" if self.assumption == 2 else "B(x) of (16)"
                places = [
                    f" of '{name}', between its default {default:.6g} and {bound:.6g}"
                    for name, bound, default in (self.deciding.pairs if self.deciding else ())
                ]
                return f"{matrix} loses rank within the bounds{','.join(places)}"
            case kind.CONTROL_RANK:
                return (
                    f"B(x) of (16) is singular{where}: the controlled outputs "
                    f"{', '.join(self.names)} cannot be steered independently; {value}"
                    f"{f'; rows of B(x): {rows}' if rows else ''}"
                )
            case _:  # A(x) has lost its rank.
                in_rows = self.cause in (kind.CONSTRAINT_RANK, kind.HIDDEN_DEGREE)
                what = "rows of A(x)" if in_rows else "gradients of constraints"
                parts = [part for part in (value, rows and f"{what}: {rows}") if part]
                return f"A(x) loses rank{where}: {'; '.join(parts)}"


def rank_violation(
    margin: RankMargin | None,
    signals: Sequence[Signal],
    degrees: Sequence[int],
    vanishing: tuple[int, ViolationKind],
    dependent: tuple[int, ViolationKind],
) -> Violation | None:
    """Returns the violation by a singular matrix: another kind if a whole row vanishes."""
    if margin is None or not margin.is_singular:
        return None
    row = margin.vanishing_row
    if row is not None:
        return Violation(*vanishing, (signals[row].name,), degrees[row], margin.state)
    names = tuple(signal.name for signal in signals)
    return Violation(
        *dependent, names, state=margin.state, singular_value=margin.relative, least=margin.least
    )


def find_dependence(
    manifold: Manifold, elimination: Elimination, states: FloatArray, where: FloatArray
) -> tuple[tuple[Combination, ...], bool, bool]:
    """Finds how the constraints depend on each other at a state where A(x) is singular.

    Also returns whether A(x) is singular at all states, and whether the gradients of k_i, k_i', ...
    depend on each other at all states examined: at that one, or at all.
    """
    system = manifold.system
    names = [signal.name for signal in system.constraint_output_signals]
    rows = {"a": elimination.constraint_matrix, "last": elimination.constraint_gradient}
    function = system.trace("dependence", {k: ca.densify(e) for k, e in rows.items()}, often=False)

    def matrices(state: FloatArray) -> list[FloatArray]:
        a, last = (v.reshape(len(names), -1) for v in function(state, system.parameter_values))
        return [a, last * system.scale]

    def is_singular(state: FloatArray) -> bool:
        scaled = equilibrated(significant(matrices(state)[0]))
        return smallest_singular_value(scaled) < system.least_margin

    everywhere = all(is_singular(state) for state in states)
    examined = [where, *states] if everywhere else [where]
    in_gradients = all(are_dependent(manifold.gradients(x) * system.scale) for x in examined)
    # Chains may depend on each other below their last derivatives alone.
    by_gradients = in_gradients and are_dependent(matrices(where)[1])
    values = [matrices(state)[1 if by_gradients else 0] for state in examined]
    return tuple(combinations_of(names, values)), everywhere, in_gradients


def redundant_constraints(samples: Samples) -> tuple[Combination, ...]:
    """Returns the constraints whose gradients depend on those of earlier ones at all samples."""
    system = samples.system
    if not samples.dependent(system.k):
        return ()
    names = [signal.name for signal in system.constraint_output_signals]
    values = samples.values(gradient=ca.jacobian(system.k, system.state))
    return tuple(combinations_of(names, [gradient * system.scale for (gradient,) in values]))


def following_outputs(samples: Samples, names: Sequence[str]) -> Iterator[Combination]:
    """Yields the outputs that are functions of the constraints, by their gradients."""
    system, manifold = samples.system, samples.manifold
    constraints = [signal.name for signal in manifold.residual_signals]
    for row, signal in enumerate(system.output_signals):
        if signal.name in names and not system.m[row, :].nnz():
            both = ca.vertcat(manifold.residual_expression, system.l[row])
            gradients = []
            for (gradient,) in samples.values(gradient=ca.densify(ca.jacobian(both, system.state))):
                # A residual alone in its column counts as much as any other entry.
                sizes = np.abs(gradient * system.scale)
                is_residual = sizes < ON_MANIFOLD * sizes.max(axis=1, keepdims=True)
                gradients.append(np.where(is_residual, 0.0, gradient * system.scale))
            rows = combinations_of([*constraints, signal.name], gradients, ON_MANIFOLD)
            yield from (row for row in rows if row.name == signal.name)


def combinations_of(
    names: list[str], values: list[FloatArray], least: float = SINGULAR
) -> list[Combination]:
    """Returns the rows that depend on earlier rows at the first of some states."""
    scaled = []
    for value in values:
        matrix = significant(value)
        rows, columns = equilibration(matrix)
        scaled.append((matrix / rows[:, None] / columns, rows))
    independent: list[int] = []
    combinations = []
    for i, name in enumerate(names):
        factors, error = _fit(scaled[0][0], independent, i)
        if error >= least:
            independent.append(i)
            continue
        used = [j for j, factor in zip(independent, factors, strict=True) if abs(factor) > least]
        plain, *others = [_fit(m, used, i)[0] * lengths[i] / lengths[used] for m, lengths in scaled]
        constant = all(np.allclose(other, plain, rtol=1e-6, atol=0.0) for other in others)
        combinations.append(Combination(name, tuple(names[j] for j in used), plain, constant))
    return combinations


def _fit(matrix: FloatArray, others: list[int], row: int) -> tuple[FloatArray, float]:
    """The factors of rows whose combination is nearest to another row, and the remainder."""
    if not others:
        return np.zeros(0), float(np.linalg.norm(matrix[row]))
    factors = scipy.linalg.lstsq(matrix[others].T, matrix[row])[0]
    return factors, float(np.linalg.norm(matrix[row] - factors @ matrix[others]))
