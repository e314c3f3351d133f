"""Time derivatives along the constrained motion, without differentiating a factorization.

The repeated Lie derivatives of section 2 are time derivatives along x' = f* + h* u. Instead of
expanding f* and differentiating the whole, the equations of the motion are differentiated:

    E x' = f + g v + h u,    c' = 0,

where c are the last derivatives L_f^(r_i - 1) k_i of the constraints. Exogenous signals and their
derivatives change with time as well. Each order brings new unknowns (x'', v'), (x''', v''), ...
that solve a linear system with one and the same matrix,

    [[E, -g], [dc/dx, 0]] (x^(k+1), v^(k)) = terms of the lower orders,

so that E and A = dc/dx E^-1 g are factored once. For a robot E holds M(q), and A is J M^-1 J^T.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system import DaeSystem
from drake_dae.errors import ModelError
from drake_dae.trace.factorization import (
    Factorization,
    PositiveDefiniteFactorization,
    block_stages,
    nonzeros,
    saddle_point_solver,
)
from drake_dae.trace.numerics import Sized, equilibration, multiply, without_round_off


class Derivatives:
    """The motion of a system on N* and its time derivatives, for a constant control.

    `constraint` is the column c. Its rate c' is 0, or minus `damping`, an expression that vanishes
    on N*; its higher derivatives are 0 in both cases. `pivot` is 0 exactly where A(x) is singular;
    with frictional contacts it is not positive where the Painleve paradox occurs.
    """

    def __init__(self, system: DaeSystem, constraint: ca.SX, damping: ca.SX | None = None) -> None:
        self.system = system
        self.control = ca.SX.sym("u", system.num_controls)
        x = system.state
        mass, f, g, h = system.mass_matrix, system.f, system.g, system.h
        # Rows like q' = v need no unknown: their right side is a state.
        plain = [
            i
            for i in range(system.num_states)
            if f[i].is_leaf()
            and not (g[i, :].nnz() or h[i, :].nnz())
            and mass[i, :].nnz() == 1
            and mass[:, i].nnz() == 1
            and mass[i, i].is_one()
        ]
        self._rows = [i for i in range(system.num_states) if i not in plain]
        g_rows = g[self._rows, :]
        self.constraint_gradient = ca.jacobian(constraint, x)
        self._symbols: list[ca.SX] = [x]
        self._rates: list[ca.SX] = []
        self._values: list[ca.SX] = []
        first = self._next_unknown()
        rate = ca.SX(f)
        rate[self._rows] = first[: len(self._rows), :]
        self._rates.append(rate)
        self._symbols.append(first)
        #: The constraint input v of (1) as an unknown of the motion, shape (m, 1).
        self.constraint_input = first[len(self._rows) :, :]  # A slice [1:] of a scalar is a row.
        balance, self._constraint_rate = self._first_order(constraint)
        self._balance = balance[self._rows] - ca.mtimes(h[self._rows, :], self.control)  # (1)
        gradient = ca.sparsify(self.constraint_gradient[:, self._rows].T)
        if system.agree(gradient, g_rows):
            gradient = g_rows
        E = mass[self._rows, self._rows]
        self._matrix = ca.blockcat(E, -g_rows, gradient.T, ca.SX(g.shape[1], g.shape[1]))
        self._unknowns, self.constraint_matrix, self.pivot = saddle_point_solver(
            PositiveDefiniteFactorization(E), g_rows, gradient
        )
        if system.frictional_contacts:
            self.pivot = ca.fmin(
                self.pivot, system.frictional_contacts.reserve(self.constraint_matrix)
            )
        self._equations: list[ca.SX] = []
        self._control_slopes: list[ca.SX] = []
        self._solve_order(damping)

    @property
    def rate(self) -> ca.SX:
        """x' as an unknown of the motion, shape (n, 1)."""
        return self._rates[0]

    def derivative(self, expression: ca.SX) -> ca.SX:
        """Returns the time derivative of an expression along the motion."""
        if ca.depends_on(expression, self._symbols[-1]):
            following, size = self._next_unknown(), self._balance.numel()
            self._rates.append(following)
            both = self._total_derivative(ca.vertcat(self._balance, self._constraint_rate))
            self._balance, self._constraint_rate = both[:size, :], both[size:, :]
            self._symbols.append(following)
            self._solve_order()
        return self._total_derivative(expression)

    def expand(self, expression: ca.SX) -> ca.SX:
        """Returns an expression in terms of only state, control and parameters."""
        return self._inline(expression, len(self._values))

    def by_control(self, expression: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Returns a(x) and B(x) of an expression a(x) + B(x) u of the motion."""
        orders = self.orders_in(expression)
        slope = self._slope(expression, orders)
        unknowns = ca.vertcat(ca.SX(0, 1), *self._symbols[1 : orders + 1])
        zero = ca.SX.zeros(self.control.numel())
        free = ca.vertcat(ca.SX(0, 1), *self._values[:orders])
        both = ca.substitute(
            ca.vertcat(expression, ca.vec(slope)),
            ca.vertcat(unknowns, self.control),
            ca.vertcat(ca.substitute(free, self.control, zero), zero),
        )
        size = expression.numel()
        return both[:size, :], ca.sparsify(ca.reshape(both[size:, :], slope.shape))

    def orders_in(self, expression: ca.SX) -> int:
        """The number of orders of unknowns in an expression."""
        used = [k for k, w in enumerate(self._symbols[1:], 1) if ca.depends_on(expression, w)]
        return max(used, default=0)

    def _slope(self, expression: ca.SX, orders: int) -> ca.SX:
        """The derivative of an expression by the control, in terms of unknowns."""
        while len(self._control_slopes) < orders:
            k, count = len(self._control_slopes), len(self._rows)
            # The matrix in front of the newest unknowns holds the state alone.
            moved = self._slope(self._equations[k], k)
            solution = self._unknowns(moved[:count, :], moved[count:, :])
            self._control_slopes.append(ca.sparsify(solution))
        slope = ca.jacobian(expression, self.control)
        for unknown, moves in zip(self._symbols[1:], self._control_slopes[:orders], strict=False):
            which = sorted(set(moves.sparsity().row()))
            slope += ca.mtimes(ca.jacobian(expression, unknown[which]), moves[which, :])
        return slope

    def inverse(
        self, expression: ca.SX, desired: ca.SX, shown: ca.SX | None = None
    ) -> tuple[ca.SX, ca.SX, ca.SX] | None:
        """Returns the control for which an expression of the motion has desired values.

        The equations of the motion and `expression = desired` are solved together for the control
        and the unknowns that it moves, block by block along their structure (Dulmage and Mendelsohn
        1958): B(x) of (16) is not formed, with rigid joints it is inverse dynamics. Also returns a
        scalar that is 0 exactly where the control is not determined, and what is shown; None if the
        equations are not linear in what it moves.
        """
        shown = ca.SX(0, 1) if shown is None else shown
        orders = self.orders_in(ca.vertcat(expression, shown))
        symbols = ca.vertcat(ca.SX(0, 1), *self._symbols[1 : orders + 1])
        values = ca.vertcat(ca.SX(0, 1), *self._values[:orders])
        moved = ca.which_depends(values, self.control, 1, True) if orders else []
        unmoved = [i for i, moves in enumerate(moved) if not moves]
        unknowns = ca.vertcat(symbols[[i for i, moves in enumerate(moved) if moves]], self.control)
        equations = ca.vertcat(ca.SX(0, 1), *self._equations[:orders], expression - desired)
        involved = ca.which_depends(equations, unknowns, 1, True)
        used_rows = [i for i, involves in enumerate(involved) if involves]
        equations = equations[used_rows]
        if equations.numel() != unknowns.numel():
            return None
        matrix = self._slopes(expression, orders, moved)[used_rows, :]
        if ca.depends_on(matrix, unknowns):
            return None
        blocks = []
        waiting = list(range(unknowns.numel()))
        for stage in block_stages(matrix.sparsity()):
            ahead = unknowns[waiting]
            # An unknown that is solved for later may appear here with a slope that cancels.
            every = equations[[row for rows, _ in stage for row in rows]]
            right_sides = ca.vertsplit(
                ca.substitute(every, ahead, ca.SX.zeros(ahead.numel())),
                np.cumsum([0, *[len(rows) for rows, _ in stage]]).tolist(),
            )
            for (rows, columns), right in zip(stage, right_sides, strict=True):
                factors = Factorization(ca.densify(matrix[rows, columns]))
                blocks.append((columns, factors.solve(-right), factors.pivot))
            solved = {column for _, columns in stage for column in columns}
            waiting = [column for column in waiting if column not in solved]
        # Only the unknowns that the control depends on are solved for.
        solutions = [solution for _, solution, _ in blocks]
        uses = nonzeros(ca.jacobian_sparsity(ca.vertcat(ca.SX(0, 1), *solutions), unknowns))
        needed, pivot, last = [self.control, shown], ca.SX(1), len(uses)
        is_needed = np.any(nonzeros(ca.jacobian_sparsity(ca.vertcat(*needed), unknowns)), axis=0)
        for columns, solution, block_pivot in reversed(blocks):
            last -= len(columns)
            if is_needed[columns].any():
                is_needed |= uses[last : last + len(columns)].any(axis=0)
                needed.append(solution)
                pivot = ca.fmin(pivot, block_pivot)
        if unmoved and ca.depends_on(ca.vertcat(*needed), symbols[unmoved]):
            pivot = ca.fmin(pivot, self.pivot)
        _, results = ca.substitute_inplace(
            [symbols[unmoved], *(unknowns[columns] for columns, _, _ in blocks)],
            [values[unmoved], *solutions],
            [self.control, pivot, shown],
        )
        return results[0], results[1], results[2]

    def _slopes(self, expression: ca.SX, orders: int, moved: Sequence[bool]) -> ca.SX:
        """The derivatives of equations of some orders, and of an expression, by what moves."""
        rows = [*self._equations[:orders], expression]
        blocks = []
        for k, row in enumerate(rows):
            columns = []
            for j in range(orders):
                size = self._symbols[j + 1].numel()
                which = [i for i in range(size) if moved[j * size + i]]
                if j == k:  # Known, in fewer operations.
                    columns.append(self._matrix[:, which])
                elif j < k:
                    columns.append(ca.jacobian(row, self._symbols[j + 1][which]))
                else:
                    columns.append(ca.SX(row.numel(), len(which)))
            blocks.append(ca.horzcat(*columns, ca.jacobian(row, self.control)))
        return ca.sparsify(ca.vertcat(*blocks))

    def _first_order(self, constraint: ca.SX) -> tuple[ca.SX, ca.SX]:
        """E x' - f - g v and c', in terms of the first unknowns."""
        system, rate = self.system, self._rates[0]
        balance = ca.mtimes(system.mass_matrix, rate) - system.f
        balance -= ca.mtimes(system.g, self.constraint_input)
        constraint_rate = ca.jtimes(constraint, system.state, rate)
        if system.exogenous:
            constraint_rate += system.exogenous.rate(constraint)
        if system.implicit is None:
            return balance, constraint_rate
        shorter = ca.vertcat(*system.implicit(rate, self.constraint_input))
        if system.exogenous:  # `implicit` has the part of the state alone.
            shorter = ca.vertcat(shorter[: system.num_states], constraint_rate)
        longer = ca.vertcat(balance, constraint_rate)
        if shorter.shape != longer.shape or not system.agree(
            shorter, longer, self._symbols[1], self.control
        ):
            raise ModelError(
                f"{system.name}: 'implicit' is not (E x' - f - g v, c') near the nominal state"
            )
        return shorter[: system.num_states], shorter[system.num_states :, :]

    def _next_unknown(self) -> ca.SX:
        size = len(self._rows) + self.system.num_constraints
        return ca.SX.sym(f"w{len(self._symbols)}", size)

    def _total_derivative(self, expression: ca.SX) -> ca.SX:
        moving = self._symbols[: len(self._rates)]
        rate = ca.jtimes(expression, ca.vertcat(*moving), ca.densify(ca.vertcat(*self._rates)))
        return rate + self.system.exogenous.rate(expression) if self.system.exogenous else rate

    def _solve_order(self, damping: ca.SX | None = None) -> None:
        """Solves for the newest unknowns, which enter the balance and constraint rate linearly."""
        newest, rate = self._symbols[-1], self._constraint_rate
        if damping is not None:
            rate = rate + damping
        self._equations.append(ca.vertcat(self._balance, rate))
        remainder = ca.substitute(self._equations[-1], newest, ca.SX.zeros(newest.numel()))
        count = len(self._rows)
        solution = self._unknowns(remainder[:count, :], remainder[count:, :])
        self._values.append(ca.densify(self._inline(solution, len(self._values))))

    def _inline(self, expression: ca.SX, orders: int) -> ca.SX:
        """An expression with the values of the first `orders` unknowns put in."""
        if not orders:
            return expression
        symbols = ca.vertcat(*self._symbols[1 : orders + 1])
        return ca.substitute(expression, symbols, ca.vertcat(*self._values[:orders]))


def lie_derivative(expression: ca.SX, field: ca.SX, state: ca.SX) -> ca.SX:
    """Returns L_f k = (dk/dx) f, by one forward sweep."""
    return ca.jtimes(expression, state, ca.densify(field))


def lie_derivative_along(expression: ca.SX, fields: ca.SX, state: ca.SX) -> ca.SX:
    """Returns [L_g1 k, ..., L_gm k] with structural zeros."""
    return ca.sparsify(ca.mtimes(ca.jacobian(expression, state), fields))


@dataclass(frozen=True, eq=False)
class Elimination:
    """Equations (9)-(14) as expressions of the state; not finite where A(x) is singular.

    On the manifold N* the constraint inputs are v = alpha + beta u (25), and

        x' = f* + h* u,    z = l* + n* u.
    """

    constraint_gradient: ca.SX  # The rows d L_f^(r_i - 1) k_i / dx, shape (m, n).
    constraint_matrix: ca.SX  # A(x) of Assumption (2), shape (m, m).
    alpha: ca.SX  # v where u = 0 (13), shape (m, 1).
    beta: ca.SX  # The factor of u in v (14), shape (m, p).
    f_star: ca.SX  # f + g alpha (9), shape (n, 1).
    h_star: ca.SX  # h + g beta (10), shape (n, p).
    l_star: ca.SX  # l + m alpha (11), shape (p, 1).
    n_star: ca.SX  # m beta (12), shape (p, p).
    pivot: ca.SX  # A scalar that is 0 exactly where A(x) is singular.


def eliminate(derivatives: Derivatives) -> Elimination:
    """Derives (9)-(14) from the derivatives on N*, which are affine in the control."""
    system = derivatives.system
    alpha, beta = derivatives.by_control(derivatives.constraint_input)  # (13), (14), (25)
    f_star, h_star = derivatives.by_control(derivatives.rate)  # (9), (10)
    l_star, n_star = system.outputs(alpha), ca.sparsify(ca.mtimes(system.m, beta))  # (11), (12)
    gradient, matrix = derivatives.constraint_gradient, derivatives.constraint_matrix
    return Elimination(
        gradient, matrix, alpha, beta, f_star, h_star, l_star, n_star, derivatives.pivot
    )


def eliminate_numbers(
    fields: Mapping[str, FloatArray],
    constraint_gradient: FloatArray,
    constraint_matrix: FloatArray,
    scale: FloatArray,
) -> tuple[Sized, Sized]:
    """Returns h* (10) and n* (12) at one state, without round-off."""
    h, size = fields["h"], np.abs(fields["h"])
    by_control = multiply(constraint_gradient, (h, size), scale)
    # Units of the constraints' derivatives, and of the constraint inputs.
    rows, columns = equilibration(np.abs(constraint_matrix))
    scaled = np.linalg.inv(constraint_matrix / rows[:, None] / columns)
    inverse = scaled / columns[:, None] / rows
    beta = multiply(-inverse, by_control, rows)
    added, added_size = multiply(fields["g"], beta, 1.0 / columns)
    h_star = without_round_off(h + added, size + added_size)
    return h_star, multiply(fields["m"], beta, 1.0 / columns)
