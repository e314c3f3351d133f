"""Stability of the zero dynamics: eigenvalues at rest, Floquet multipliers along R(t).   (35)-(36)

A small disturbance of a state on Z(R) moves by delta' = (dx'/dx) delta, x' = f* + h* u at fixed R,
and stays tangent to Z(R). At an equilibrium the eigenvalues on the tangent space decide. In bases T
of the tangent spaces a period takes T c to T M c; the eigenvalues of M are the multipliers.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import pairwise

import numpy as np
import scipy  # SciPy loads its large parts when they are used.
import scipy.linalg

from drake_dae.arrays import FloatArray, show
from drake_dae.dae.manifold import coordinates, tangent
from drake_dae.dae.pinned_motion import GROWN, PinnedMotion, PinnedSet
from drake_dae.dae.structure import Structure
from drake_dae.errors import ModelError

LINEARIZED = 1e-11  # The error of a linearization, relative to the terms in each of its entries.
ROUNDED = 1e-15  # The error of computed eigenvalues, relative to the norm of the matrix.
SHIFT = 1e-7  # The error of an equilibrium, relative to the size of the states.
# Along a periodic motion:
ACCURACY = 1e-9  # The error of an integration step, relative to the scale of the states.
MOST_RATES = 20_000  # The largest number of rates that are computed in a period.
SECTIONS = 16  # The number of parts of a period; after each, the state is projected onto Z(R).
# A motion is periodic if it returns to within this, relative to the scale of the states.
CLOSED = 1e-7
CARRIED = 1e-6  # The error of the matrix M, relative to its norm.
NEWTON_STEPS = 12  # The largest number of Newton steps.
REPEATED = 1e-6  # A reference has a period if it repeats itself to this, relative to its values.
ComplexArray = np.typing.NDArray[np.complex128]


class Verdict(StrEnum):
    """The verdicts on the zero dynamics."""

    STABLE = "exponentially stable"
    UNSTABLE = "unstable"
    UNDECIDED = "not decided"


@dataclass(frozen=True, eq=False)
class Stability:
    """The stability of the internal states about an equilibrium, with constant outputs."""

    verdict: Verdict
    reason: str
    eigenvalues: ComplexArray = field(default_factory=lambda: np.zeros(0, dtype=complex))
    state: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class StabilityAlong:
    """The stability of the internal states while the outputs follow a periodic reference."""

    verdict: Verdict
    reason: str
    period: float
    multipliers: ComplexArray = field(default_factory=lambda: np.zeros(0, dtype=complex))
    state: FloatArray | None = None


def linearized_eigenvalues(
    pinned: PinnedSet, scale: FloatArray, state: FloatArray
) -> tuple[ComplexArray, FloatArray]:
    """Returns the eigenvalues of d(f* + h* u)/dx on the tangent space of Z(R), with errors."""
    slopes = pinned.slopes(state)
    free, moved = coordinates(pinned.gradients(state), scale)
    # The tangent directions are known to round-off, relative to the scale of the states.
    least = np.where(moved == 0.0, 0.0, ROUNDED / LINEARIZED * scale[:, None] / scale[free])
    sizes, units = np.abs(slopes), scale[free][:, None] / scale[free]
    matrix = (slopes @ moved)[free] / units
    off = LINEARIZED * (sizes @ np.maximum(np.abs(moved), least))[free] / units
    along = moved @ (scale[free] * np.random.default_rng(0).standard_normal(free.size))
    along /= np.max(np.abs(along) / scale, initial=0.0) or 1.0
    nearby = pinned.slopes(state + SHIFT * along)
    if np.all(np.isfinite(nearby)):
        off += np.abs(((nearby - slopes) @ moved)[free] / units)
    # The numbers of a model are rounded as well, such as the cosine of a right angle.
    rounded = ROUNDED * float(np.linalg.norm(balanced_matrix(sizes * scale / scale[:, None])[0], 2))
    values, errors = eigenvalues_of(matrix, off, rounded)
    if _stays_off_the_axis(matrix, off, rounded):
        errors = np.minimum(errors, 0.5 * np.abs(values.real))
    return values, errors


def _stays_off_the_axis(matrix: FloatArray, error: FloatArray, rounded: float) -> bool:
    """Whether no eigenvalue can be on the imaginary axis, within the matrix's error.

    A perturbation that moves one to i w is at least the smallest singular value of A - i w; this
    equals e for some w only if i w is an eigenvalue of [[A, -e], [e, -A^T]] (Byers 1988).
    """
    balanced, units = balanced_matrix(matrix)
    norm = float(np.linalg.norm(balanced, 2))
    off = float(np.linalg.norm(error / units[:, None] * units, 2)) + rounded + ROUNDED * norm
    if not (np.isfinite(off) and norm > 0.0):
        return False
    away = off * np.eye(len(matrix))
    values = np.linalg.eigvals(np.block([[balanced, -away], [away, -balanced.T]]))
    # Its eigenvalues have an error of the root of round-off where they meet on the axis.
    return bool(np.min(np.abs(values.real)) > np.sqrt(ROUNDED) * norm)


def balanced_matrix(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns a matrix whose norm does not depend on units, and these units of its rows."""
    with np.errstate(invalid="ignore"):  # SciPy casts factors of 1e50 to numbers of rows.
        balanced, similarity = scipy.linalg.matrix_balance(matrix, permute=False)
    return balanced, np.diag(similarity)


def eigenvalues_of(
    matrix: FloatArray, error: FloatArray, rounded: float = 0.0
) -> tuple[ComplexArray, FloatArray]:
    """Returns eigenvalues, largest real part first, and their error bounds.

    To first order an error E of the matrix moves an eigenvalue by at most |y|^H |E| |x| / |y^H x|,
    with its left and right eigenvectors y and x. Balancing removes the units first. `error` bounds
    the entries of the matrix, `rounded` those of the balanced one.
    """
    if not matrix.size:
        return np.zeros(0, dtype=complex), np.zeros(0)
    balanced, units = balanced_matrix(matrix)
    values, left, right = scipy.linalg.eig(balanced, left=True, right=True)
    off = error / units[:, None] * units + rounded + ROUNDED * np.linalg.norm(balanced, 2)
    moved = np.einsum("ik,ij,jk->k", np.abs(left), off, np.abs(right))
    errors = moved / np.maximum(np.abs(np.sum(left.conj() * right, axis=0)), 1e-300)
    order = np.lexsort((values.imag, -values.real))
    return values[order], errors[order]


def judge(
    values: ComplexArray, errors: FloatArray, state: FloatArray, place: str, degenerate: int = 0
) -> Stability:
    """Judges a state at rest by its eigenvalues."""
    smallest = np.argsort(np.abs(values))[:degenerate]
    errors = errors.copy()
    errors[smallest] = np.maximum(errors[smallest], 2.0 * np.abs(values[smallest]))
    largest = f"the largest real part of an eigenvalue is {values[0].real:.4g} 1/s {place}"
    if np.any(values.real > errors):
        return Stability(Verdict.UNSTABLE, f"non-minimum phase: {largest}", values, state)
    if np.all(values.real < -errors):
        return Stability(Verdict.STABLE, f"minimum phase: {largest}", values, state)
    count = np.count_nonzero(np.abs(values.real) <= errors)
    reason = (
        f"the linearization does not decide: {count} of {values.size} eigenvalues are on the "
        f"imaginary axis, up to round-off, {place}"
    )
    if degenerate:
        reason += ", where the Jacobian is singular"
    return Stability(Verdict.UNDECIDED, reason, values, state)


def without_dynamics(structure: Structure) -> Stability:
    """Judges a system without zero dynamics: whether R determines the motion."""
    for matrix, margin in dict(A=structure.constraint_margin, B=structure.control_margin).items():
        if margin is not None and margin.is_singular:
            reason = (
                "no zero dynamics, but the reference does not determine the motion: "
                f"{matrix}(x) is singular at x = {show(margin.state)}"
            )
            return Stability(Verdict.UNDECIDED, reason)
    return Stability(Verdict.STABLE, "no zero dynamics: the reference alone determines the motion")


class _MotionLost(Exception):
    """Raised where a motion cannot be followed over a period."""


class PeriodicMotions:
    """The motions on Z(R(t)), given by `at`, with the period of R, and their multipliers."""

    def __init__(self, at: Callable[[float], PinnedSet], scale: FloatArray, period: float) -> None:
        self._at, self._scale, self._period = at, scale, period
        self._left = MOST_RATES

    def judge(self, motion: PinnedMotion) -> StabilityAlong:
        """Judges the periodic motion found near a motion."""
        if not motion.times.size:
            return StabilityAlong(Verdict.UNDECIDED, str(motion.ending), self._period)
        self._check_period(motion.times)
        # Late, when decaying disturbances are gone; or early, when growing ones are still small.
        late = int(np.count_nonzero(motion.times <= motion.times[-1] - self._period)) - 1
        for first in dict.fromkeys((max(late, 0), 0)):
            try:
                state, matrix = self._close(motion.states[first], float(motion.times[first]))
            except _MotionLost:
                continue
            noise = CARRIED * max(1.0, float(np.linalg.norm(matrix, 2)))
            values, errors = eigenvalues_of(matrix, np.full(matrix.shape, noise))
            order = np.argsort(-np.abs(values), kind="stable")
            values, errors = values[order], errors[order]
            sizes = np.abs(values)
            verdict = Verdict.STABLE if np.all(sizes < 1.0 - errors) else Verdict.UNDECIDED
            reason = f"the largest Floquet multiplier is {sizes[0]:.4g}"
            if np.any(sizes > 1.0 + errors):
                verdict = Verdict.UNSTABLE
                reason = f"small disturbances of the motion grow: {reason}"
            elif verdict is Verdict.UNDECIDED:
                reason = (
                    f"{np.count_nonzero(np.abs(sizes - 1.0) <= errors)} of {sizes.size} Floquet "
                    "multipliers are on the unit circle, up to the error of integration,"
                )
            reason += f" over {self._period:.6g} s"
            return StabilityAlong(verdict, reason, self._period, values, state)
        reason = f"no motion with the period {self._period:.6g} s of the reference is found"
        if motion.ending is not None:
            reason += f"; the motion ends: {motion.ending}"
        return StabilityAlong(Verdict.UNDECIDED, reason, self._period)

    def _check_period(self, times: FloatArray) -> None:
        """Raises ModelError if the signals do not repeat, at a few times."""
        begin = float(times[0])
        last = max(float(times[-1]) - self._period, begin)
        for time in np.linspace(begin, last, 4).tolist():
            now, later = self._at(time), self._at(time + self._period)
            for a, b in ((now.reference, later.reference), (now.parameters, later.parameters)):
                allowed = REPEATED * max(1.0, float(np.max(np.abs(a), initial=0.0)))
                if np.any(np.abs(b - a) > allowed):
                    raise ModelError(
                        f"{now.outputs.system.name}: the reference does not have the period "
                        f"{self._period:g} s: it differs at {time:g} s and a period later"
                    )

    def _onto(self, state: FloatArray, time: float) -> FloatArray:
        """Projects a state onto Z(R(t)), which must be near."""
        projected, converged = self._at(time).project(state)
        is_near = np.abs(projected - state) <= 0.1 * (self._scale + np.abs(state))
        if not (converged and np.all(is_near)):
            raise _MotionLost
        return projected

    def _close(self, state: FloatArray, begin: float) -> tuple[FloatArray, FloatArray]:
        """Returns the start of the periodic motion near a state, and M.

        Newton's method for the distance from the start after a period, along the tangent space.
        """
        for _ in range(NEWTON_STEPS):
            basis = tangent(self._at(begin).gradients(state), self._scale)
            later, columns, self._left = state, basis, MOST_RATES
            for start, stop in pairwise(np.linspace(begin, begin + self._period, SECTIONS + 1)):
                later, columns = self._section(later, columns, start, stop)
                later = self._onto(later, stop)
            scaled = (basis / self._scale[:, None]).T
            matrix = scaled @ (columns / self._scale[:, None])
            gap = scaled @ ((later - state) / self._scale)
            change = basis @ np.linalg.lstsq(matrix - np.eye(gap.size), -gap, rcond=CARRIED)[0]
            if np.max(np.abs(change) / self._scale) <= CLOSED:
                off = np.max(np.abs(later - state) / self._scale)
                if off > 1e3 * CLOSED * max(1.0, float(np.linalg.norm(matrix, 2))):
                    break
                return state, matrix
            state = self._onto(state + change, begin)
        raise _MotionLost

    def _section(
        self, state: FloatArray, columns: FloatArray, begin: float, end: float
    ) -> tuple[FloatArray, FloatArray]:
        """Integrates a state and tangent columns."""
        shape, unit = (1 + columns.shape[1], state.size), self._scale

        def rate(time: float, both: FloatArray) -> FloatArray:
            rows, pinned = both.reshape(shape) * unit, self._at(time)
            moved = np.vstack([pinned.rate(rows[0]), pinned.slopes(rows[0], rows[1:].T).T]) / unit
            self._left -= 1
            is_near = np.abs(both[: state.size]).max() <= bound and np.isfinite(moved).all()
            if self._left < 0 or not is_near:
                raise _MotionLost
            return moved.reshape(-1)

        y = (np.vstack([state, columns.T]) / unit).reshape(-1)
        bound = GROWN * np.maximum(1.0, np.abs(y[: state.size]).max())
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # A failed step raises _MotionLost.
            found = scipy.integrate.solve_ivp(
                rate, (begin, end), y, "LSODA", [end], rtol=ACCURACY, atol=ACCURACY
            )
        if not found.success:
            raise _MotionLost
        rows = found.y[:, -1].reshape(shape) * unit
        return rows[0], rows[1:].T
