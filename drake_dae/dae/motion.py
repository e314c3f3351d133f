"""Time derivatives along the constrained motion, without differentiating a factorization.

The repeated Lie derivatives of section 2 are time derivatives along x' = f* + h* u. Instead of
expanding f* and differentiating the whole, the equations of the motion are differentiated:

    E x' = f + g v + h u,    c' = 0,

with c the last derivatives L_f^(r_i - 1) k_i of the constraints. Each order brings new unknowns
(x'', v'), (x''', v''), ... that solve a linear system with one and the same matrix,

    [[E, -g], [dc/dx, 0]] (x^(k+1), v^(k)) = what is known of the orders before,

so that E and A = dc/dx E^-1 g are factored once. For a robot E holds M(q), and A is J M^-1 J^T.
"""

import casadi as ca

from drake_dae.dae.expressions import Factorization, PositiveDefiniteFactorization
from drake_dae.dae.system import DaeSystem


class Motion:
    """The motion of a system on N* and its time derivatives, the control held constant.

    Args:
        system: (1)-(3).
        constraint: c = (L_f^(r_1 - 1) k_1, ..., L_f^(r_m - 1) k_m), shape (m, 1).

    Attributes:
        control: The symbol u, shape (p, 1).
        constraint_gradient: dc/dx, shape (m, n).
        constraint_matrix: A(x) of Assumption (2), shape (m, m).
        pivot: 0 exactly where A(x) is singular; see `expressions.Factorization`.
    """

    def __init__(self, system: DaeSystem, constraint: ca.SX) -> None:
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
        force = g[self._rows, :]
        inertia = PositiveDefiniteFactorization(mass[self._rows, self._rows])
        self.constraint_gradient = ca.jacobian(constraint, x)
        gradient = ca.sparsify(self.constraint_gradient[:, self._rows])
        reaction = inertia.solve(force)
        self.constraint_matrix = ca.sparsify(ca.mtimes(gradient, reaction))
        coupling = Factorization(self.constraint_matrix)
        self.pivot = coupling.pivot

        def unknowns(residual: ca.SX, rate: ca.SX) -> ca.SX:
            free = inertia.solve(-residual)
            multiplier = coupling.solve(-rate - ca.mtimes(gradient, free))
            return ca.vertcat(free + ca.mtimes(reaction, multiplier), multiplier)

        self._unknowns = unknowns
        self._symbols: list[ca.SX] = [x]
        self._rates: list[ca.SX] = []
        self._values: list[ca.SX] = []
        first = self._next_unknown()
        rate = ca.SX(f)
        rate[self._rows] = first[: len(self._rows), :]
        self._rates.append(rate)
        self._symbols.append(first)
        #: The constraint input v of (1) as an unknown of the motion, shape (m, 1).
        self.constraint_input = first[len(self._rows) :, :]  # Of a scalar [1:] would be a row.
        self._residual = (
            ca.mtimes(mass[self._rows, self._rows], rate[self._rows])
            - f[self._rows]
            - system.reaction_to(self.constraint_input)[self._rows]
            - ca.mtimes(h[self._rows, :], self.control)
        )
        self._constraint_rate = ca.jtimes(constraint, x, rate)
        self._solve_order()

    @property
    def rate(self) -> ca.SX:
        """x' as an unknown of the motion, shape (n, 1)."""
        return self._rates[0]

    def derivative(self, expression: ca.SX) -> ca.SX:
        """The time derivative of an expression of the state and of this motion's unknowns.

        Args:
            expression: Shape (k, 1).

        Returns:
            Shape (k, 1), in terms of the state and of unknowns; see `expand`.
        """
        if ca.depends_on(expression, self._symbols[-1]):
            self._add_order()
        return self._total_derivative(expression)

    def expand(self, expression: ca.SX) -> ca.SX:
        """An expression in terms of state, control and parameters alone."""
        return self._inline(expression, len(self._values))

    def unknowns(self) -> ca.SX:
        """State and all unknowns that exist up to now, below each other."""
        return ca.vertcat(*self._symbols)

    def _next_unknown(self) -> ca.SX:
        size = len(self._rows) + self.system.num_constraints
        return ca.SX.sym(f"w{len(self._symbols)}", size)

    def _total_derivative(self, expression: ca.SX) -> ca.SX:
        moving = self._symbols[: len(self._rates)]
        return ca.jtimes(expression, ca.vertcat(*moving), ca.densify(ca.vertcat(*self._rates)))

    def _add_order(self) -> None:
        following = self._next_unknown()
        self._rates.append(following)
        self._residual = self._total_derivative(self._residual)
        self._constraint_rate = self._total_derivative(self._constraint_rate)
        self._symbols.append(following)
        self._solve_order()

    def _solve_order(self) -> None:
        """The newest unknowns enter residual and constraint rate linearly: solve for them."""
        newest = self._symbols[-1]
        known = ca.substitute(
            ca.vertcat(self._residual, self._constraint_rate), newest, ca.SX.zeros(newest.numel())
        )
        count = len(self._rows)
        solution = self._unknowns(known[:count, :], known[count:, :])
        self._values.append(ca.densify(self._inline(solution, len(self._values))))

    def _inline(self, expression: ca.SX, orders: int) -> ca.SX:
        """Puts the values of the first `orders` unknowns in."""
        return (
            ca.substitute(
                expression,
                ca.vertcat(*self._symbols[1 : orders + 1]),
                ca.vertcat(*self._values[:orders]),
            )
            if orders
            else expression
        )
