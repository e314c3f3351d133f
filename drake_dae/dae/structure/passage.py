"""Motion through a singular configuration, where the constraints lose their rank."""

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.constrained import ConstraintStructure
from drake_dae.trace.functions import TracedFunction
from drake_dae.trace.round_off import positive

WINDOW = 1e-3
"""A(x) is not used if the sine of the angle between gradients is below this. Outside, the round-off
of a state on N* causes errors of 1e-16 / WINDOW^3 in the acceleration off its branch; inside,
neglected terms cause errors of the order of WINDOW, with opposite signs before and after. Of 1e-4,
3e-4 and 1e-3 the last had the smallest errors."""

NULL = 10.0 * WINDOW**2
"""An eigenvalue of A(x), scaled to a diagonal of 1, below this belongs to lost gradients."""

CROSSING = 1e-3
"""A motion crosses a singular configuration if the lost gradients return at least at this rate,
relative to the rate at which gradients turn."""

BRANCH = 0.05
"""The allowed deviation of a velocity from the directions of the branches, relative to the angle
between them. The velocity of a trial state deviates slightly."""

MISS, SEARCH = 1e-5, 5
"""N* misses a singular configuration if the sine of the angle stays above MISS. SEARCH is the
number of Newton steps for this test, from a state in the window."""

STEADY, NEAREST = 0.2, 1e-6
"""The allowed relative change of the crossing speed on the way to the configuration (or on a way of
length NEAREST if it is nearer). With a larger change the system is almost at rest there."""


@dataclass(frozen=True, eq=False)
class Passage:
    """The motion of a system on N* through a singular configuration.

    Let n be the combinations of constraints whose gradients vanish in the configuration, n^T C = 0
    with the gradients C of the last derivatives c = L_f^(r_i - 1) k_i. There n^T c' = 0 does not
    restrict the acceleration, and an input along n has no effect. Both are limits: on the branch of
    N* on which the system arrives, n^T c'' = 0 holds as well, which is an equation for the
    acceleration, since n^T C changes with the motion; and a bounded constraint force acts in the
    direction in which the vanishing column of g returns. So

        E x' = f + g v + h u + (g' n) s,    P c' = 0,    n^T c'' = 0,

    with the remaining constraints P determines x'. The branch is that of the velocity. If the
    system is at rest, or N* has a cusp, the continuation is undetermined. If N* only comes near a
    singular configuration, by more than `MISS`, it does not pass through it. The inputs v have no
    component along n; there they grow without bound, usually as 1 / time.

    Attributes:
        structure: The structure of the system.
    """

    structure: ConstraintStructure

    def motion(
        self, state: FloatArray, control: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Returns x' and v at a state close to a singular configuration, shapes (n,) and (m,).

        Returns:
            None if the system does not cross one there: its gradients are independent, or stay
            dependent along its motion, it is at rest, its velocity is not along a branch, or it
            narrowly misses one. None also if A(x) is not symmetric, as with friction, if
            constraints have other degrees than 2, or with exogenous signals or shared forces.
        """
        system, n = self.structure.system, state.size
        if self.doubt is None:
            return None
        values = {
            name: value.reshape(n, -1)
            for name, value in zip(
                system.fields.output_names[:3], system.fields(state, parameters), strict=False
            )
        }
        mass, matrix, gradient = (v.copy() for v in self._matrices.evaluate(state, parameters))
        m = system.num_constraints
        matrix, gradient = matrix.reshape(m, m), gradient.reshape(m, n)
        if not np.all(np.isfinite(matrix)):
            return None
        unit = 1.0 / np.sqrt(self._sizes)
        scaled = matrix * unit * unit[:, None]
        if not np.allclose(scaled, scaled.T, rtol=0.0, atol=1e-9):
            return None
        eigenvalues, vectors = np.linalg.eigh((scaled + scaled.T) / 2.0)
        lost = eigenvalues < NULL
        if not lost.any():
            return None
        independent, null = unit[:, None] * vectors[:, ~lost], unit[:, None] * vectors[:, lost]

        # The motion without the lost constraints.
        free = values["f"][:, 0] + values["h"] @ control
        c_rate = self._along(state, free, parameters)[0]
        v = -independent @ ((independent.T @ c_rate) / eigenvalues[~lost])
        rate = free + values["g"] @ v
        c_rate, _, _, turning, _ = self._along(state, rate, parameters)
        columns, mass = turning @ np.hstack([independent, null]), mass.reshape(n, n)
        least, most = _return_of_lost(mass, values["g"] @ independent, columns)
        if not least > CROSSING**2 * most:
            return None
        # With r = 2, c = J v: on a branch the lost part of J' v is zero as well.
        moving = np.where(np.any(values["g"], axis=1), state, 0.0)
        energy = float(moving @ mass @ moving)
        if not np.linalg.norm(null.T @ c_rate) <= BRANCH * np.sqrt(most * energy):
            return None
        missed = self._missed(state, parameters, independent, null)
        if not missed * np.sqrt(most) < MISS**2 * np.sqrt(energy):
            return None

        # With the input directions that return.
        ways = np.hstack([values["g"] @ independent, np.linalg.solve(mass, turning @ null)])
        for _ in range(3):
            c_rate, c_second, slope, _, _ = self._along(state, rate, parameters)
            rows = np.vstack([independent.T @ gradient, null.T @ slope])
            residuals = np.concatenate([independent.T @ c_rate, null.T @ c_second])
            step = np.linalg.lstsq(rows @ ways, -residuals)[0]
            rate = rate + ways @ step
            v = v + independent @ step[: independent.shape[1]]
        bending = self._along(state, rate, parameters)[4] @ null
        if not np.all(np.isfinite(bending)):
            return None
        change = np.linalg.eigvalsh(bending.T @ np.linalg.solve(mass, bending))[-1]
        distance = max(np.sqrt(max(eigenvalues[lost][-1], 0.0)), NEAREST)
        return (rate, v) if distance * np.sqrt(max(change, 0.0)) < STEADY * least else None

    def _missed(
        self, state: FloatArray, parameters: FloatArray, independent: FloatArray, null: FloatArray
    ) -> float:
        """The residual of the constraints in the singular configuration next to a state.

        There P k = 0 and J^T n = 0, which is solved for positions and for n = null + kept M by
        Newton's method. Where n^T k is not zero, N* comes near to it and turns away.
        """
        x, mixed = state.copy(), np.zeros((independent.shape[1], null.shape[1]))
        used, count = self._used, null.shape[1]
        size = len(used)
        for _ in range(SEARCH):
            k, gradient, hessian = (v.copy() for v in self._positions.evaluate(x, parameters))
            gradient = gradient.reshape(-1, size)
            turning = hessian.reshape(len(k), size, size)
            n = null + independent @ mixed
            matrix = np.zeros((independent.shape[1] + count * size, size + mixed.size))
            matrix[: independent.shape[1], :size] = independent.T @ gradient
            residuals = [independent.T @ k]
            for j in range(count):
                rows = slice(independent.shape[1] + j * size, independent.shape[1] + (j + 1) * size)
                columns = slice(
                    size + j * independent.shape[1], size + (j + 1) * independent.shape[1]
                )
                matrix[rows, :size] = np.tensordot(n[:, j], turning, 1)
                matrix[rows, columns] = gradient.T @ independent
                residuals.append(gradient.T @ n[:, j])
            step = -np.linalg.lstsq(matrix, np.concatenate(residuals))[0]
            x[used] += step[:size]
            mixed = mixed + step[size:].reshape(count, -1).T
            if not np.all(np.isfinite(x)):
                return np.inf
        k = self._positions.evaluate(x, parameters)[0]
        return float(np.linalg.norm((null + independent @ mixed).T @ k))

    @cached_property
    def _used(self) -> list[int]:
        """The states that the constraints depend on."""
        system = self.structure.system
        depends = ca.which_depends(system.k, system.state, 1, False)
        return [i for i, used in enumerate(depends) if used]

    @cached_property
    def _positions(self) -> TracedFunction:
        """k, J = dk/dq, and the derivatives of its rows, one below the other."""
        system = self.structure.system
        q = system.state[self._used]
        gradient = ca.jacobian(system.k, q)
        turning = [ca.jacobian(gradient[i, :].T, q) for i in range(system.num_constraints)]
        outputs = {"k": system.k, "gradient": gradient, "hessian": ca.vertcat(*map(_row, turning))}
        return system.trace("positions", outputs, often=False)

    @cached_property
    def doubt(self) -> ca.SX | None:
        """An expression that is negative where `motion` is needed; None if it never is."""
        elimination, system = self.structure.elimination, self.structure.system
        if set(self.structure.constraint_degrees) != {2}:
            return None
        if system.exogenous or system.sharing is not None:
            return None
        lengths = ca.diag(elimination.constraint_matrix) / ca.DM(self._sizes)
        return ca.fmin(elimination.pivot, ca.mmin(lengths)) - WINDOW**2

    @cached_property
    def _sizes(self) -> FloatArray:
        """The usual size of the diagonal of A(x), whose entries may vanish near a configuration."""
        m = self.structure.system.num_constraints
        values = self.structure.system.parameter_values
        sizes = [
            np.abs(np.diag(self._matrices(state, values)[1].reshape(m, m)))
            for state in self.structure.states
        ]
        return positive(np.median(sizes, axis=0))

    @cached_property
    def _matrices(self) -> TracedFunction:
        elimination = self.structure.elimination
        outputs = {
            "mass": self.structure.system.mass_matrix,
            "matrix": elimination.constraint_matrix,
            "gradient": elimination.constraint_gradient,
        }
        return self.structure.system.trace("singular configuration", outputs, often=False)

    @cached_property
    def _derivatives(self) -> TracedFunction:
        """c', c'' and its derivative by x', g' and g'', with the part of x'' that x' determines."""
        structure, system = self.structure, self.structure.system
        x, rate = system.state, ca.SX.sym("rate", system.num_states)
        ends = np.cumsum(structure.constraint_degrees) - 1
        c = structure.manifold.residual_expression[ends.tolist()]
        # x'' of rows like q' = N v; of the others n^T C is zero.
        plain = [i for i in range(system.num_states) if _is_plain(system.mass_matrix, i)]
        plain = [i for i in plain if not (system.g[i, :].nnz() or system.h[i, :].nnz())]
        second = ca.SX(system.num_states, 1)
        second[plain] = ca.jtimes(system.f[plain], x, rate)
        c_rate = ca.jtimes(c, x, rate)
        c_second = ca.jtimes(c_rate, x, rate) + ca.jtimes(c_rate, rate, ca.densify(second))
        turning = ca.jtimes(ca.vec(ca.densify(system.g)), x, rate)
        outputs = {
            "c'": c_rate,
            "c''": c_second,
            "slope": ca.jacobian(c_second, rate),
            "turning": turning,
            "bending": ca.jtimes(turning, x, rate) + ca.jtimes(turning, rate, ca.densify(second)),
        }
        return system.trace("passage", outputs, {"rate": rate}, often=False)

    def _along(
        self, state: FloatArray, rate: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        n, m = state.size, self.structure.system.num_constraints
        derivatives = [v.copy() for v in self._derivatives.evaluate(state, rate, parameters)]
        c_rate, c_second, slope, turning, bending = derivatives
        return (
            c_rate,
            c_second,
            slope.reshape(m, n),
            turning.reshape(m, n).T,
            bending.reshape(m, n).T,
        )


def _row(matrix: ca.SX) -> ca.SX:
    """The entries of a symmetric matrix, side by side."""
    return ca.densify(ca.vec(matrix)).T


def _is_plain(mass: ca.SX, row: int) -> bool:
    """Whether a row of E is that of the identity."""
    return mass[row, :].nnz() == 1 and mass[row, row].is_one()


def _return_of_lost(
    mass: FloatArray, accelerations: FloatArray, turning: FloatArray
) -> tuple[float, float]:
    """The rate at which lost gradients return, and that at which gradients turn; both squared.

    Args:
        mass: E.
        accelerations: E^-1 g of the remaining constraints.
        turning: The rates of the columns of g, those of the remaining constraints first.
    """
    speeds = turning.T @ np.linalg.solve(mass, turning)
    count = accelerations.shape[1]
    cross = turning[:, count:].T @ accelerations
    back = speeds[count:, count:] - cross @ np.linalg.solve(
        accelerations.T @ mass @ accelerations, cross.T
    )
    return float(np.linalg.eigvalsh(back)[0]), float(np.linalg.eigvalsh(speeds)[-1])
