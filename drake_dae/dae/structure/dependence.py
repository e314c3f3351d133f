"""The dependent constraints and outputs where A(x) or B(x) loses its rank."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.linalg

from drake_dae.arrays import FloatArray
from drake_dae.dae.elimination import Elimination
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.states.samples import Samples
from drake_dae.trace.round_off import (
    SINGULAR,
    are_dependent,
    equilibrated,
    equilibration,
    significant,
    smallest_singular_value,
)

_ON_MANIFOLD = 1e-8
"""The residual of a constraint that a state on N* may have. It appears in the gradient of an output
that is a constraint times a factor."""


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
                is_residual = sizes < _ON_MANIFOLD * sizes.max(axis=1, keepdims=True)
                gradients.append(np.where(is_residual, 0.0, gradient * system.scale))
            rows = combinations_of([*constraints, signal.name], gradients, _ON_MANIFOLD)
            yield from (row for row in rows if row.name == signal.name)


def combinations_of(
    names: list[str], values: list[FloatArray], least: float = SINGULAR
) -> list[Combination]:
    """Returns the rows that depend on earlier rows at the first of some states."""
    matrix, lengths = _scaled(values[0])
    independent: list[int] = []
    combinations = []
    for i, name in enumerate(names):
        factors, error = _fit(matrix, independent, i)
        if error >= least:
            independent.append(i)
            continue
        used = [j for j, factor in zip(independent, factors, strict=True) if abs(factor) > least]
        plain = _fit(matrix, used, i)[0] * lengths[i] / lengths[used]
        others = []
        for value in values[1:]:
            scaled, lengths_there = _scaled(value)
            others.append(_fit(scaled, used, i)[0] * lengths_there[i] / lengths_there[used])
        constant = all(np.allclose(other, plain, rtol=1e-6, atol=0.0) for other in others)
        combinations.append(Combination(name, tuple(names[j] for j in used), plain, constant))
    return combinations


def _fit(matrix: FloatArray, others: list[int], row: int) -> tuple[FloatArray, float]:
    """The factors of rows whose combination is nearest to another row, and the remainder."""
    if not others:
        return np.zeros(0), float(np.linalg.norm(matrix[row]))
    factors = scipy.linalg.lstsq(matrix[others].T, matrix[row])[0]
    return factors, float(np.linalg.norm(matrix[row] - factors @ matrix[others]))


def _scaled(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A matrix with rows and columns of about length one, and the divisors of its rows."""
    matrix = significant(matrix)
    rows, columns = equilibration(matrix)
    return matrix / rows[:, None] / columns, rows
