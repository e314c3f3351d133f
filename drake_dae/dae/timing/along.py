"""What a system needs along a curve, at rest and at any speed and acceleration."""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.timing.curve import Piece
from drake_dae.dae.timing.limited_signals import LimitedSignals
from drake_dae.dae.timing.many_points import ManyPoints
from drake_dae.dae.timing.motion_limits import MotionLimits
from drake_dae.dae.zero_dynamics.pinned.pinned_outputs import PinnedOutputs
from drake_dae.errors import InconsistentStateError, ReferenceSignalError

CONVERGED = 1e-6
"""A Newton step that is this small relative to the states is the last one."""

_SINGULAR = (
    "{}: no states are found along the path: it leads through, or close to, a singular "
    "configuration, or out of reach"
)

COARSE = 16
"""The points of a piece whose states are found one after the other, from the one before."""


class AlongCurve:
    """The feedforward of the tracking law along a curve: (28), (35) without tracking error.

    On Z(R), where all outputs are on their references, (28) is u = B^-1 (r^(mu) - a(x)), and (25)
    is v = alpha + beta u. With r' = r_s s', r'' = r_ss s'^2 + r_s s'' both are affine in s'' for
    a constant speed w = s'. For a rigid robot without friction they are affine in s'' and s'^2:

        u = m(s) s'^2 + n(s) s'' + c(s).

    Args:
        structure: The structure of the system: degrees 0 and 2, no zero dynamics.
        limits: The limits.

    Attributes:
        limited: The signals that have limits.

    Raises:
        ModelError: A limit names no signal of the system.
        ReferenceSignalError: The system has outputs of other degrees, zero dynamics, or moving
            exogenous signals.
    """

    def __init__(self, structure: Structure, limits: MotionLimits) -> None:
        _check(structure)
        self.limited = LimitedSignals(structure, limits)
        self._pinned = PinnedOutputs(structure)
        self.system, self.layout = structure.system, structure.layout
        state = self.system.state
        residual = structure.manifold.residual_expression
        reference = ca.SX.sym("R", self.layout.reference_size)
        goal = reference[self.layout.chained.tolist(), :]
        equations = ca.vertcat(residual, structure.chain - goal)
        inputs = [state, reference, self.system.parameter_symbol]
        gradients = ca.densify(ca.jacobian(equations, state))
        newton = ca.Function("newton", inputs, ca.cse([ca.densify(equations), gradients]))
        self._newton = ManyPoints(newton, self.system.compiled)
        control, _ = structure.control_for(reference[self.layout.highest.tolist(), :])  # (28)
        values = ca.Function("along", inputs, ca.cse([self.limited.values(control)]))
        self._values = ManyPoints(values, self.system.compiled)

    def reference(self, piece: Piece, w: FloatArray, a: FloatArray) -> FloatArray:
        """Returns R at the points for speeds and accelerations, shape (N + 1, sum (mu_i + 1))."""
        rows, first = piece.values.copy(), self.layout.lowest[self.layout.dynamic]
        rows[:, first + 1] = piece.tangents * w[:, None]
        rows[:, first + 2] = piece.curvatures * w[:, None] ** 2 + piece.tangents * a[:, None]
        return rows

    def states_at_rest(
        self, piece: Piece, guess: FloatArray, parameters: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Returns the states on Z(R) at rest at the points, and their derivatives by the speed w.

        Returns:
            x, shape (N + 1, n), and dx/dw at w = 0, shape (N + 1, n).

        Raises:
            ReferenceSignalError: A point is out of reach, or the path leads through a singular
                configuration.
        """
        count, zero = len(piece.times) - 1, np.zeros(len(piece.times))
        rest = self.reference(piece, zero, zero)
        places = np.unique(np.linspace(0, count, COARSE + 1).astype(int))
        coarse = []
        for row, time in zip(rest[places], piece.times[places], strict=True):
            try:
                guess = self._pinned.state(row, guess, parameters)
            except InconsistentStateError as error:
                where = f"at t = {time:.4g} s of the reference the path is out of reach"
                raise ReferenceSignalError(f"{where}: {error}") from error
            coarse.append(guess)
        states = np.array(coarse)
        # By interpolation, then on finer grids.
        for number in (4 * COARSE, count):
            finer = np.unique(np.linspace(0, count, number + 1).astype(int))
            start = _interpolated(places, states, finer)
            states, places = self.states(rest[finer], start, parameters), finer
        moving = self.reference(piece, zero + 1.0, zero) - rest
        moving[:, self.layout.lowest[self.layout.dynamic] + 2] = 0.0
        _, gradients = self._newton(states, rest, parameters)
        goals = np.zeros(states.shape)
        goals[:, -self.layout.chain_size :] = moving[:, self.layout.chained]
        return states, self._solved(gradients, goals)

    def states(self, rows: FloatArray, start: FloatArray, parameters: FloatArray) -> FloatArray:
        """Returns states on Z(R) for rows of R, by Newton's method from guesses, shape (k, n).

        Raises:
            ReferenceSignalError: It does not converge.
        """
        scale, x = self.system.scale, start.copy()
        for _ in range(12):
            residual, gradients = self._newton(x, rows, parameters)
            step = self._solved(gradients, residual)
            x -= step
            if not np.isfinite(x).all():
                break
            # The error after a step is of the order of its square.
            if (np.abs(step) <= CONVERGED * np.maximum(scale, np.abs(x))).all():
                return x
        raise ReferenceSignalError(_SINGULAR.format(self.system.name))

    def _solved(self, gradients: FloatArray, values: FloatArray) -> FloatArray:
        """Solutions of gradients * x = values at all points, in units of the states' scale."""
        scale = self.system.scale
        try:
            return np.asarray(scale * np.linalg.solve(gradients * scale, values[..., None])[..., 0])
        except np.linalg.LinAlgError:
            raise ReferenceSignalError(_SINGULAR.format(self.system.name)) from None

    def values(self, states: FloatArray, rows: FloatArray, parameters: FloatArray) -> FloatArray:
        """Returns the limited signals for states on Z(R) and rows of R, shape (k, signals)."""
        return self._values(states, rows, parameters)[0]

    def limited_states(self, states: FloatArray) -> FloatArray:
        """Returns the limited states, shape (k, limited states)."""
        return states[:, self.limited.states]


def _interpolated(places: np.ndarray, values: FloatArray, targets: np.ndarray) -> FloatArray:
    """Values between places by a cubic spline."""
    from scipy.interpolate import CubicSpline  # It takes long to load.

    return np.asarray(CubicSpline(places, values)(targets))


def _check(structure: Structure) -> None:
    system = structure.system
    others: Sequence[str] = [
        f"'{signal.name}' has degree {degree}"
        for signal, degree in zip(system.output_signals, structure.output_degrees, strict=True)
        if degree not in (0, 2)
    ]
    if others:
        raise ReferenceSignalError(
            f"{system.name}: time-optimal motion is for rigid joints, where positions have degree "
            f"2 and forces degree 0; here {others[0]}, as behind springs or motors"
        )
    if structure.zero_dynamics_dimension:
        raise ReferenceSignalError(
            f"{system.name}: the outputs leave {structure.zero_dynamics_dimension} states free "
            "(zero dynamics), so that the path does not determine the motion"
        )
    if system.exogenous.moving:
        names = ", ".join(parameter.name for parameter in system.exogenous.moving)
        raise ReferenceSignalError(
            f"{system.name}: {names} moves with the time, which a path cannot stretch"
        )
