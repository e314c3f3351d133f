"""Relative degrees by Assumptions (1), (3) and (4), and the chains of derivatives.

Whether an input acts on a derivative is decided by the structure of the expression first, then by
its numbers at consistent states, with the default parameters and signals at rest; what is zero
there must be zero with all other numbers.
"""

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from drake_dae.arrays import Booleans, FloatArray
from drake_dae.dae.assumptions import Violation, ViolationKind, redundant_constraints
from drake_dae.dae.derivatives import (
    Derivatives,
    Elimination,
    eliminate_numbers,
    lie_derivative,
    lie_derivative_along,
)
from drake_dae.dae.manifold import Manifold
from drake_dae.dae.samples import Family, Samples, as_matrix, fields_at, outside
from drake_dae.dae.signals import Signal
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import AssumptionError
from drake_dae.trace.factorization import nonzeros
from drake_dae.trace.numerics import MANY, VISIBLE, Sized, multiply

# Rows of numbers at a state for values of all parameters, without round-off, with their sizes
# before cancellation.
Row = Callable[[FloatArray, FloatArray], Sized]


def constraint_chains(system: DaeSystem, guesses: FloatArray) -> tuple[list[list[ca.SX]], Samples]:
    """k_i, L_f k_i, ..., L_f^(r_i - 1) k_i of each constraint, by Assumptions (1) and (3)."""
    explicit = system.explicit
    x, f, names = system.state, explicit.f, [s.name for s in system.constraint_output_signals]
    chains = [[system.k[i]] for i in range(system.num_constraints)]  # (2)
    undecided, others = list(range(len(chains))), _OtherDegrees(system.constraint_output_signals)
    while undecided:
        last = ca.vertcat(*[chains[i][-1] for i in undecided])
        by_force = lie_derivative_along(last, explicit.g, x)
        by_control = lie_derivative_along(last, explicit.h, x)
        samples = Samples(Manifold(system, chains), guesses)
        actions, following, stuck = InputActions(samples), list[int](), list[int]()
        force_acts = actions.acts(by_force, actions.along(last, "g"))
        control_acts = actions.acts(by_control, actions.along(last, "h"))
        reached = _reached(explicit.g, f, last, x)
        for row, i in enumerate(undecided):
            order, name = len(chains[i]), (names[i],)
            if force_acts[row].all():
                others.check(i)
                continue
            if force_acts[row].any():
                state = samples.states[int(np.argmin(force_acts[row]))]
                raise Violation(1, ViolationKind.CONSTRAINT_DEGREE, name, order, state).error()
            if control_acts[row].any():
                state = samples.states[int(np.argmax(control_acts[row]))]
                raise Violation(3, ViolationKind.EARLY_CONTROL, name, order, state).error()
            for key, rows, assumption in (("g", by_force, 1), ("h", by_control, 3)):
                if rows[row, :].nnz():
                    along = actions.along(chains[i][-1], key)
                    others.examine(i, assumption, order, samples, along)
            following.append(i)
            if not reached[row] or (
                by_force[row, :].nnz() and samples.dependent(ca.vertcat(*chains[i]))
            ):
                stuck.append(i)
        if not following:
            return chains, samples
        if sum(len(chain) for chain in chains) + len(following) > system.num_states:
            stuck = following
        if stuck:
            raise others.never(ViolationKind.NO_FORCE, stuck, samples)
        for i in following:
            derivative = lie_derivative(chains[i][-1], f, x)
            if system.exogenous:
                derivative += system.exogenous.rate(chains[i][-1])
            chains[i].append(derivative)
        undecided = following
    return chains, Samples(Manifold(system, chains), guesses)


def output_chains(
    derivatives: Derivatives, elimination: Elimination, samples: Samples
) -> dict[str, Any]:
    """l*_i, L_f* l*_i, ..., L_f*^(mu_i - 1) l*_i of each output, and more fields of `Structure`."""
    system = derivatives.system
    x, f_star, h_star = system.state, elimination.f_star, elimination.h_star
    names, count = [s.name for s in system.output_signals], system.num_outputs
    shape = (count, system.num_controls)
    drift, control_matrix, highest = ca.SX(count, 1), ca.SX(*shape), ca.SX(count, 1)
    round_off, need_force = np.zeros(shape, dtype=bool), False
    chains: list[list[ca.SX]] = [[] for _ in range(count)]
    others, actions = _OtherDegrees(system.output_signals), InputActions(samples, elimination)
    slopes = actions.numbers(actions.feedthrough)
    moving = system.outputs(derivatives.constraint_input)
    following, rows = elimination.l_star, elimination.n_star
    undecided = list(range(count))
    while True:
        acts, still = np.asarray(slopes.any(axis=2)).T, []
        for row, i in enumerate(undecided):
            order, name = len(chains[i]), (names[i],)
            if acts[row].all():
                others.check(i)
                drift[i], highest[i] = following[row], moving[row]
                control_matrix[i, :] = rows[row, :]  # (16)
                round_off[i] = len(slopes) >= MANY and ~slopes[:, row, :].any(axis=0)
            elif acts[row].any():
                state = samples.states[int(np.argmin(acts[row]))]
                raise Violation(4, ViolationKind.OUTPUT_DEGREE, name, order, state).error()
            else:
                if not chains[i] and rows[row, :].nnz():
                    others.examine(i, 4, 0, samples, actions.feedthrough, i)
                still.append(i)
                chains[i].append(following[row])
                need_force = need_force or derivatives.orders_in(moving[row]) > 0
        if not still:
            break
        last = ca.vertcat(*[chains[i][-1] for i in still])
        # Along x' = f* + h* u: the derivative is L_f* + L_h* u of the last one.
        moving = derivatives.derivative(moving[[undecided.index(i) for i in still]])
        following, rows = derivatives.by_control(moving)
        slopes = actions.numbers(actions.along(last, "h*"), rows)
        acts, stuck = np.asarray(slopes.any(axis=2)).T, []
        reached = _reached(h_star, f_star, last, x)
        for row, i in enumerate(still):
            if acts[row].any():
                continue
            if rows[row, :].nnz():
                along = actions.along(chains[i][-1], "h*")
                others.examine(i, 4, len(chains[i]), samples, along)
            # By Theorem 2.1 these differentials are independent if the output has a degree. Tested
            # where nothing acts although the structure allows it.
            used = ca.vertcat(samples.manifold.residual_expression, *chains[i])
            is_full = used.numel() >= system.num_states or not reached[row]
            if is_full or (rows[row, :].nnz() and samples.dependent(used)):
                stuck.append(i)
        if stuck:
            raise others.never(ViolationKind.NO_CONTROL, stuck, samples)
        undecided = still
    return {
        "output_chains": tuple(map(tuple, chains)),
        "highest_derivatives": highest,
        "drift": drift,
        "control_matrix": control_matrix,
        "chains_need_force": need_force,
        "round_off": round_off,
    }


class InputActions:
    """The numbers by which inputs act on functions, at states and for values of all parameters."""

    def __init__(self, samples: Samples, elimination: Elimination | None = None) -> None:
        self._samples, self._system, self._scale = samples, samples.system, samples.scale
        if elimination is not None:
            factors = {"c": elimination.constraint_gradient, "A": elimination.constraint_matrix}
            self._factors = self._system.trace("sample", factors, often=False)

    def along(self, functions: ca.SX, key: str) -> Row:
        """Returns the derivatives of functions along the columns of g, h or h* (10)."""
        system = self._system
        gradient = system.matrix("sample", ca.jacobian(functions, system.state))

        def row(state: FloatArray, parameters: FloatArray) -> Sized:
            if key == "h*":
                field, _ = self._eliminated(state, parameters)
            else:
                value = fields_at(system, state, parameters)[key]
                field = value, np.abs(value)
            gradients = gradient(state, parameters)
            if not np.all(np.isfinite(gradients)):
                return (gradients @ (np.nan * field[0]),) * 2
            return multiply(gradients, field, self._scale)

        return row

    def feedthrough(self, state: FloatArray, parameters: FloatArray) -> Sized:
        """Returns n* (12)."""
        return self._eliminated(state, parameters)[1]

    def numbers(self, row: Row, pattern: ca.SX | None = None) -> FloatArray:
        """Returns rows at the samples; zeros if an expression of them, if given, is zero."""
        samples, system = self._samples, self._system
        if pattern is not None and not pattern.nnz():
            return np.zeros((len(samples.states), *pattern.shape))
        values = [row(x, system.parameter_values)[0] for x in samples.states]
        for state, value in zip(samples.states, values, strict=True):
            if not np.all(np.isfinite(value)):
                raise outside(system, "a derivative", state)
        return np.array(values)

    def acts(self, pattern: ca.SX, row: Row) -> Booleans:
        """Returns where rows are not zero, shape (functions, samples)."""
        return np.asarray(self.numbers(row, pattern).any(axis=2)).T

    def _eliminated(self, state: FloatArray, parameters: FloatArray) -> tuple[Sized, Sized]:
        """h* and n*."""
        fields = fields_at(self._system, state, parameters)
        gradient, matrix = map(as_matrix, self._factors(state, parameters))
        try:
            return eliminate_numbers(fields, gradient, matrix, self._scale)
        except np.linalg.LinAlgError:
            h_star = np.nan * fields["h"]
            n_star = np.full((len(fields["m"]), h_star.shape[1]), np.nan)
            return (h_star, h_star), (n_star, n_star)


class _OtherDegrees:
    """What is found for other parameters than the defaults, where nothing acts at these."""

    def __init__(self, signals: Sequence[Signal]) -> None:
        self._names = [signal.name for signal in signals]
        self._violations: dict[int, Violation] = {}

    def examine(
        self, i: int, assumption: int, order: int, samples: Samples, row: Row, of: int = 0
    ) -> None:
        """Looks whether a row that is zero at the default parameters is not at others."""

        @np.errstate(all="ignore")  # Values that are not finite decide nothing.
        def acts(state: FloatArray, parameters: FloatArray) -> bool:
            value, size = (each[of] for each in row(state, parameters))
            return bool(np.any(np.abs(value) > VISIBLE * size))

        if i in self._violations:
            return
        if deciding := Family(samples.manifold, samples.states).deciding(acts):
            names, kind = (self._names[i],), ViolationKind.NUMBERS
            self._violations[i] = Violation(assumption, kind, names, order, deciding=deciding)

    def check(self, i: int) -> None:
        """Raises the violation of one whose degree is another one for other parameters."""
        if i in self._violations:
            raise self._violations[i].error()

    def never(self, kind: ViolationKind, stuck: Sequence[int], samples: Samples) -> AssumptionError:
        """The error of constraints or outputs on which no input ever acts."""
        is_constraint = kind is ViolationKind.NO_FORCE
        found = [self._violations[i].deciding for i in stuck if i in self._violations]
        return Violation(
            2 if is_constraint else 5,
            kind,
            tuple(self._names[i] for i in stuck),
            combinations=redundant_constraints(samples) if is_constraint else (),
            deciding=found[0] if found else None,
        ).error()


def _reached(fields: ca.SX, drift: ca.SX, expressions: ca.SX, state: ca.SX) -> Booleans:
    """The expressions that an input along the fields can influence, by structure."""
    influence = nonzeros(ca.jacobian_sparsity(drift, state))
    moved = nonzeros(fields.sparsity()).any(axis=1)
    for _ in range(state.numel()):
        moved = moved | influence[:, moved].any(axis=1)
    used = nonzeros(ca.jacobian_sparsity(expressions, state))
    return np.asarray((used & moved).any(axis=1))
