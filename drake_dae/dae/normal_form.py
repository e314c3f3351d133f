"""The normal form: constraint chains, output chains, and what completes them.       (20)-(27)"""

from collections.abc import Callable, Iterator, Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dgetrf, dgetrs

from drake_dae.dae.expressions import TracedFunction
from drake_dae.dae.manifold import CONSISTENT
from drake_dae.dae.samples import Fields, Margin, Samples, show, traced
from drake_dae.dae.structure import Structure
from drake_dae.dae.system import Signal
from drake_dae.errors import FloatArray, InconsistentStateError, ModelError

CONVERGED = 1e-9
"""A Newton step of this size, relative to the state, leaves its square: round-off."""

TRANSVERSAL = 0.05
"""Single states complete the chains if the sine of their smallest angle is above this."""


class NormalForm:
    """The change of coordinates Phi (20)-(22),

        y    = k_i, L_f k_i, ..., L_f^(r_i - 1) k_i              (xtilde, zero on N*)
        zeta = l*_i, L_f* l*_i, ..., L_f*^(mu_i - 1) l*_i        (xbar; outputs with mu_i >= 1)
        xi   = Psi_2(x)                                          (the completion)

    both chains in the order of the system's constraints and outputs.

    Phi is a local diffeomorphism where its Jacobian is regular. By Theorem 2.1 the differentials
    of both chains are independent wherever A(x) of Assumption (2) and B(x) of (16) are regular;
    so where the Jacobian is singular, one of these is, or xi does not complete the chains there.
    The paper allows any completion; L_h* xi = 0 is not required.

    Args:
        structure: Of the system.
        completion: xi as expressions of the state (and parameters), shape (d, 1) with
            d = n - sum r_i - sum mu_i. Chosen if None: states that complete the chains well at
            all of `structure.states`; if none do, linear combinations of states.

    Attributes:
        structure: As given.
        completion: xi, shape (d, 1).
        completion_signals: Names and units of xi. A chosen one is its own name: "x3", or
            "x0 - 0.5 x1".
        coordinate_signals: Names and units of (y, zeta, xi), n in all.
        margin: How far the Jacobian of Phi is from singular over `structure.states`.

    Raises:
        ModelError: A completion that does not fit, or whose differentials are not independent of
            each other and of the chains; or B(x) is singular.
    """

    def __init__(self, structure: Structure, completion: ca.SX | None = None) -> None:
        self.structure = structure
        self.system = structure.system
        system, residual = self.system, structure.manifold.residual_expression
        if structure.control_margin.is_singular:
            raise ModelError(
                f"{system.name}: B(x) of (16) is singular at x = "
                f"{show(structure.control_margin.state)}, so the output chains are not independent "
                "there and are no coordinates; choose other outputs"
            )
        chains = ca.vertcat(residual, *[e for chain in structure.output_chains for e in chain])
        samples = Samples(structure.manifold, Fields(system.explicit), structure.states)
        if completion is None:
            found = _choose(structure, chains, samples)
        else:
            found = _given(structure, chains, samples, completion)
        self.completion, self.completion_signals, self.margin = found
        self.coordinate_signals = (
            *structure.manifold.residual_signals,
            *[
                signal.derivative(order)
                for signal, degree in zip(
                    system.output_signals, structure.output_degrees, strict=True
                )
                for order in range(degree)
            ],
            *self.completion_signals,
        )
        coordinates = ca.vertcat(chains, self.completion)
        inputs = {"state": system.state, "parameters": system.parameter_symbol}
        self._coordinates = TracedFunction(
            f"{system.name} normal form", inputs, {"coordinates": coordinates}
        )
        self._map = TracedFunction(
            f"{system.name} normal form and Jacobian",
            inputs,
            {"coordinates": coordinates, "jacobian": ca.jacobian(coordinates, system.state)},
        )
        self._scale = samples.scale

    def coordinates(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """Phi(x) = (y, zeta, xi) of (20)-(22).

        Args:
            state: x, shape (n,), on N* or not.
            parameters: Values of all parameters; the defaults if None.

        Returns:
            Shape (n,), as `coordinate_signals`.
        """
        return self._coordinates(state, self._parameters(parameters))[0]

    def jacobian(self, state: ArrayLike, parameters: ArrayLike | None = None) -> FloatArray:
        """dPhi/dx, shape (n, n); singular where Phi is no coordinate change, see the class.

        Args:
            state: x, shape (n,).
            parameters: Values of all parameters; the defaults if None.
        """
        return self._at(np.asarray(state, dtype=float), self._parameters(parameters))[1]

    def state(
        self,
        coordinates: ArrayLike,
        guess: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
    ) -> FloatArray:
        """x = Phi^-1(y, zeta, xi) of (24), to round-off; with y = 0 that of (27), on N*.

        The inverse is local: other states may have the same coordinates (elbow up, elbow down;
        an angle and the same angle plus 2 pi, as states are not wrapped). The one that continues
        the guess is sought by damped Newton's method; where that fails, on the straight way from
        the coordinates of the guess to the given ones.

        Args:
            coordinates: (y, zeta, xi), shape (n,).
            guess: A state near the wanted one, shape (n,); the nominal consistent state if None.
            parameters: Values of all parameters; the defaults if None.

        Returns:
            Shape (n,).

        Raises:
            InconsistentStateError: There is no such state, or no way to it from the guess. Its
                residual is what is left in the coordinates, shape (n,).
            ModelError: Shapes that do not fit, or numbers that are not finite.
        """
        target = self._vector("coordinates", coordinates)
        x = self._vector("guess", self.structure.states[0] if guess is None else guess)
        p = self._parameters(parameters)
        found = self._newton(x, target, p)
        if found is not None:
            return found
        start, first = self._at(x, p)
        if not np.all(np.isfinite(start)):
            raise ModelError(
                f"{self.system.name}: the coordinates (20)-(22) are not finite at the guess "
                f"{show(x)}; start inside the domain of the functions"
            )
        reached, stride = 0.0, 0.5
        while reached < 1.0:
            share = min(1.0, reached + stride)
            found = self._newton(x, start + share * (target - start), p)
            if found is not None:
                x, reached, stride = found, share, 2.0 * stride
            elif stride > 1e-4:
                stride /= 2.0
            else:
                raise self._out_of_reach(x, start, target, first, p)
        return x

    def _newton(
        self, state: FloatArray, target: FloatArray, parameters: FloatArray
    ) -> FloatArray | None:
        """Damped by the natural monotonicity test (Deuflhard, 2004, section 3.3).

        It compares Newton steps in the state, so that the units of the coordinates do not matter.
        """
        x = state
        scale = np.maximum(self._scale, np.abs(x))
        for _ in range(50):
            values, jacobian = self._at(x, parameters)
            solve = _solver(jacobian, scale)
            if solve is None:
                return None
            step = solve(target - values)
            size = np.abs(step).max()
            if size <= CONVERGED:
                return x + scale * step
            length = 1.0
            while True:
                trial = x + length * scale * step
                simplified = solve(target - self._coordinates(trial, parameters)[0])
                rest = np.abs(simplified).max()
                if rest <= (1.0 - length / 4.0) * size:
                    break
                length /= 2.0
                if length < 1e-2:
                    # Round-off, if the Jacobian is ill-conditioned.
                    return x if size <= CONSISTENT else None
            x = trial
            if rest <= CONVERGED:
                return x + scale * simplified
        return None

    def _out_of_reach(
        self,
        state: FloatArray,
        start: FloatArray,
        target: FloatArray,
        first: FloatArray,
        parameters: FloatArray,
    ) -> InconsistentStateError:
        """Names the coordinate along which the Jacobian is weakest where the search ended."""
        values, jacobian = self._at(state, parameters)
        left = target - values
        rows, columns = np.linalg.norm(first * self._scale, axis=1), self._scale
        rows[rows == 0.0] = 1.0
        weak, sizes, _ = np.linalg.svd(jacobian * columns / rows[:, None])
        worst = int(np.argmax(np.abs(weak[:, -1] * left / rows)))
        message = (
            f"{self.system.name}: no way from the guess to the given coordinates: "
            f"{self.coordinate_signals[worst].name} can be brought from {start[worst]:.6g} to "
            f"{values[worst]:.6g}, but not to {target[worst]:.6g}; the search ended at x = "
            f"{show(state)}. "
        )
        before = np.linalg.svd(first * columns / rows[:, None], compute_uv=False)
        if sizes[-1] < 0.1 * before[-1]:
            message += (
                "The coordinates (20)-(22) become dependent there: A(x) of (2) or B(x) of (16) "
                "loses its rank (Theorem 2.1)"
            )
            if self.completion_signals:
                message += (
                    f", or {', '.join(s.name for s in self.completion_signals)} does not complete "
                    "the chains any more"
                )
        else:
            message += "Start from a guess that is nearer, in the domain of the functions"
        return InconsistentStateError(message, left)

    def _at(self, state: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Phi and its Jacobian."""
        values, jacobian = self._map(state, parameters)
        return values, jacobian.reshape(values.size, -1)

    def _parameters(self, parameters: ArrayLike | None) -> FloatArray:
        values = self.system.parameter_values if parameters is None else parameters
        return np.asarray(values, dtype=float)

    def _vector(self, what: str, values: ArrayLike) -> FloatArray:
        array = np.array(values, dtype=float)
        if array.shape != (self.system.num_states,) or not np.all(np.isfinite(array)):
            raise ModelError(
                f"{self.system.name}: {what} must be finite with shape "
                f"({self.system.num_states},), got {values!r}"
            )
        return array


Completion = tuple[ca.SX, tuple[Signal, ...], Margin]
"""xi, its signals, and the margin of the Jacobian of Phi."""


def _given(structure: Structure, chains: ca.SX, samples: Samples, xi: ca.SX) -> Completion:
    """A completion that somebody chose, or why it is none."""
    system, count = structure.system, structure.zero_dynamics_dimension
    if not isinstance(xi, ca.SX) or xi.shape != (count, 1):
        got = f"shape {xi.shape}" if isinstance(xi, ca.SX) else type(xi).__name__
        raise ModelError(
            f"{system.name}: the completion must be a CasADi SX column of {count} expressions, "
            f"n - sum r_i - sum mu_i; got {got}"
        )
    known = ca.vertcat(system.state, system.parameter_symbol)
    unknown = [s.name() for s in ca.symvar(xi) if not ca.depends_on(known, s)]
    if unknown:
        raise ModelError(
            f"{system.name}: the completion depends on {', '.join(unknown)}, which is neither a "
            "state nor a parameter"
        )
    signals = tuple(
        next(
            (
                signal
                for j, signal in enumerate(system.state_signals)
                if ca.is_equal(xi[i], system.state[j])
            ),
            Signal(f"xi{i}"),
        )
        for i in range(count)
    )
    gradient = ca.jacobian(ca.vertcat(chains, xi), system.state)
    margin = samples.margin(gradient)
    if not margin.is_singular:
        return xi, signals, margin
    if not count:
        raise ModelError(
            f"{system.name}: the differentials of the chains are dependent to round-off at x = "
            f"{show(margin.state)}: A(x) of (2) or B(x) of (16) is close to singular there"
        )
    (matrix,) = traced(system, gradient=gradient)(margin.state, system.parameter_values)
    # How far each differential is from the span of those before it.
    rows = _unit_rows(matrix.reshape(system.num_states, -1) * samples.scale)
    distances = np.abs(np.diag(np.linalg.qr(rows.T)[1]))[-count:]
    worst = int(np.argmin(distances))
    raise ModelError(
        f"{system.name}: the completion '{signals[worst].name}' = "
        f"{str(xi[worst])[:60]} is not independent of the chains and of the rest of the "
        f"completion at x = {show(margin.state)}; choose a function whose differential is not in "
        "the span of theirs, there and around"
    )


def _choose(structure: Structure, chains: ca.SX, samples: Samples) -> Completion:
    """Single states whose differentials complete those of the chains, or else linear combinations.

    They complete them where they are regular on the null spaces of the chains' differentials.
    """
    system, count = structure.system, structure.zero_dynamics_dimension
    if not count:
        return _given(structure, chains, samples, ca.SX(0, 1))
    gradients = samples.values(gradient=ca.jacobian(chains, system.state))
    spaces = np.array(
        [np.linalg.svd(_unit_rows(g * samples.scale))[2][-count:].T for (g,) in gradients]
    )
    for matrix in _candidates(spaces):
        matrix = matrix / samples.scale
        # Rounded, so that ties go to the first state on every machine.
        largest = np.argmax(np.round(_unit_rows(np.abs(matrix)), 6), axis=1)
        leading = matrix[np.arange(count), largest]
        factors = np.vectorize(lambda c: float(f"{c:.3g}"))(matrix / leading[:, None])
        xi = ca.mtimes(ca.sparsify(ca.SX(factors)), system.state)
        margin = samples.margin(ca.jacobian(ca.vertcat(chains, xi), system.state))
        if not margin.is_singular:
            return xi, tuple(_combination(row, system.state_signals) for row in factors), margin
    raise ModelError(
        f"{system.name}: no linear combinations of states complete the chains (20) at all states "
        f"around the nominal one; give a completion of {count} expressions"
    )


def _candidates(spaces: FloatArray) -> Iterator[FloatArray]:
    """Combinations of states, shape (d, n), that are regular on all spaces, shape (k, n, d)."""
    count = spaces.shape[2]
    single = _pivots(spaces)
    if np.linalg.svd(spaces[:, single], compute_uv=False).min() > TRANSVERSAL:
        yield np.eye(spaces.shape[1])[single]
    # The space that is nearest to all of them, in the basis that is the identity on its pivots.
    mean = np.linalg.eigh(np.einsum("kid,kjd->ij", spaces, spaces))[1][:, -count:]
    basis = np.linalg.solve(mean[_pivots(mean[None])].T, mean.T)
    yield np.where(np.abs(basis) > 0.02, basis, 0.0)


def _pivots(spaces: FloatArray) -> list[int]:
    """States whose rows are far from dependent in all spaces: one QR with pivoting for all."""
    rest, chosen = spaces.copy(), []
    for _ in range(spaces.shape[2]):
        # Rounded, as above.
        chosen.append(int(np.argmax(np.round(np.linalg.norm(rest, axis=2).min(axis=0), 6))))
        direction = _unit_rows(rest[:, chosen[-1]])
        rest -= np.einsum("kid,kd,ke->kie", rest, direction, direction)
    return sorted(chosen)


def _combination(factors: FloatArray, signals: Sequence[Signal]) -> Signal:
    """Named as it reads: "x0 - 0.5 x1"."""
    terms = [(c, signal) for c, signal in zip(factors, signals, strict=True) if c]
    units = {signal.unit for _, signal in terms}
    sign = {1.0: "", -1.0: "-"}
    name = " + ".join(sign.get(c, f"{c:.3g} ") + signal.name for c, signal in terms)
    return Signal(name.replace("+ -", "- "), units.pop() if len(units) == 1 else "")


def _unit_rows(matrix: FloatArray) -> FloatArray:
    length = np.linalg.norm(matrix, axis=-1, keepdims=True)
    return matrix / np.where(length > 0.0, length, 1.0)


def _solver(jacobian: FloatArray, scale: FloatArray) -> Callable[[FloatArray], FloatArray] | None:
    """right -> Newton step in units of the scale; None if the Jacobian is singular, not finite."""
    matrix = jacobian * scale
    rows = np.abs(matrix).max(axis=1)
    if not (rows.min() > 0.0 and rows.max() < np.inf):
        return None
    factors, pivots, info = dgetrf(matrix / rows[:, None])
    return None if info else lambda right: dgetrs(factors, pivots, right / rows)[0]
