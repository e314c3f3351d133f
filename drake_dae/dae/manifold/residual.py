"""The residual of N*: the constraints and their derivatives, with the Newton step to zero.   (4)"""

from collections.abc import Callable, Sequence
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.agreement import agree
from drake_dae.dae.system.layout import DerivativeLayout
from drake_dae.dae.system.system import DaeSystem
from drake_dae.trace.factorization import PositiveDefiniteFactorization
from drake_dae.trace.functions import TracedFunction, count_operations
from drake_dae.trace.newton import norm
from drake_dae.trace.round_off import positive


class Residual:
    """The residual L_f^k k_i(x), k = 0, ..., r_i - 1, i = 1, ..., m, and its gradients."""

    def __init__(self, system: DaeSystem, chains: Sequence[Sequence[ca.SX]]) -> None:
        self.system = system
        self.residual_expression = ca.vertcat(
            ca.SX(0, 1), *[ca.vertcat(*chain) for chain in chains]
        )  # (4)
        self.layout = DerivativeLayout(tuple(len(chain) for chain in chains))
        self.residual_signals = self.layout.chain_signals(system.constraint_output_signals)
        self.gradient = ca.jacobian(self.residual_expression, system.state)
        self.residual_function = system.trace("manifold", {"residual": self.residual_expression})
        outputs = {"gradient": self.gradient}
        self._gradient = system.trace("manifold gradient", outputs, often=False)
        self.scale = system.scale
        gradients = self.gradients(system.nominal_state) * self.scale
        if not np.all(np.isfinite(gradients)):
            gradients = np.zeros_like(gradients)
        self.lengths: FloatArray = np.linalg.norm(gradients, axis=1)

    def gradients(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """Returns the gradients C of the residual at a state, shape (sum r_i, n)."""
        values = self._gradient(state, self.system.parameter_vector(parameters))[0]
        return values.reshape(-1, self.system.num_states)

    @cached_property
    def short_gradient(self) -> ca.SX:
        """`gradient`, in fewer operations where constraint forces are along the gradients.

        Where q' = v, the forces g' are dk/dq, and the gradient of k' = (dk/dq) v is the derivative
        of dk/dq along v beside dk/dq.
        """
        system = self.system
        if set(self.layout.degrees) != {2}:
            return self.gradient
        slope, rate = ca.SX(system.num_constraints, system.num_states), 0 * system.state
        forces = system.frictional_contacts.without_friction(system.g)
        index = {entry.name(): i for i, entry in enumerate(ca.vertsplit(system.state))}
        moved = ca.SX(*slope.shape)
        for i, entry in enumerate(ca.vertsplit(system.f)):
            if entry.is_symbolic() and (j := index.get(entry.name())) is not None:
                rate[i], slope[:, i], moved[:, j] = entry, forces[j, :].T, forces[j, :].T
        further = ca.jtimes(ca.vec(ca.densify(slope)), system.state, rate)
        moved += ca.reshape(further, slope.shape)
        rows = zip(ca.vertsplit(slope), ca.vertsplit(moved), strict=True)
        short = ca.sparsify(ca.vertcat(*[row for pair in rows for row in pair]))
        is_shorter = count_operations(short) < count_operations(self.gradient)
        return short if is_shorter and agree(system, short, self.gradient) else self.gradient

    @cached_property
    def newton_step(self) -> TracedFunction:
        """The Newton step of least norm from a state, divided by the scale of the states.

        A function of the state, a second state at which the gradients are taken, and parameters.
        """
        other, state = ca.SX.sym("other", self.system.num_states), self.system.state
        gradient = ca.substitute(self.short_gradient, state, other)
        scale = ca.SX(self.scale)
        step = shortest_step(gradient, scale)[0](self.residual_expression)
        inputs = {"other": other}
        return self.system.trace("step to the manifold", {"step": step}, inputs, often=False)

    @np.errstate(all="ignore")  # Iterates outside the domain are tried and rejected.
    def relative_size(self, state: FloatArray, parameters: FloatArray) -> float:
        """Returns the norm of the residual, each entry divided by its scaled gradient."""
        residual = self.residual_function.evaluate(state, parameters)[0]
        if not residual.any():
            return 0.0
        length = np.linalg.norm(self.gradients(state, parameters) * self.scale, axis=1)
        return norm(residual / positive(length))


def shortest_step(
    gradient: ca.SX, scale: ca.SX
) -> tuple[Callable[[ca.SX], ca.SX], Sequence[ca.SX]]:
    """residual -> the shortest dz with C S dz = -residual, where dx = S dz and S is the scale.

    It is -(C S)' N^-1 residual with N = C S (C S)', each row by its largest entry. An error of N^-1
    grows with the square of the condition of C, and only makes Newton's method slower. The lengths
    of the parts of the gradients that are orthogonal to those before are returned as well.
    """
    if not gradient.shape[0]:
        return (lambda residual: ca.SX(gradient.shape[1], 1)), ()
    scaled = ca.mtimes(gradient, ca.diag(scale))
    # By their largest entries: the squares of entries may be too large for a number.
    largest = [ca.norm_inf(row) for row in ca.vertsplit(scaled)]
    sizes = ca.vertcat(*[ca.if_else(size > 0, size, 1) for size in largest])
    scaled = ca.sparsify(scaled / ca.repmat(sizes, 1, scaled.shape[1]))
    normal = PositiveDefiniteFactorization(ca.mtimes(scaled, scaled.T))
    lengths = [size * length for size, length in zip(largest, normal.lengths, strict=True)]
    # CasADi lets the infinities of constant gradients cancel each other.
    regular = ca.if_else(normal.pivot > 0, 0, ca.SX.nan())
    return lambda residual: regular - ca.mtimes(scaled.T, normal.solve(residual / sizes)), lengths
