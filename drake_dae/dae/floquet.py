"""Stability of the zero dynamics along a periodic reference: Floquet multipliers.         (35)

To first order a disturbance delta of a state on Z(R(t)) moves by delta' = (dx'/dx) delta, with the
derivative of x' = f* + h* u at fixed R, and stays tangent to Z(R(t)). In bases T of the tangent
spaces a period of a periodic motion takes T c to T M c; the eigenvalues of M are the multipliers.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import scipy  # SciPy loads its large parts when they are used.
import scipy.linalg

from drake_dae.arrays import FloatArray
from drake_dae.dae.equilibria import ComplexArray, Verdict, eigenvalues_of
from drake_dae.dae.manifold import tangent
from drake_dae.dae.pinned_motion import GROWN, PinnedMotion, PinnedSet
from drake_dae.errors import ModelError

ACCURACY = 1e-9  # The error of an integration step, relative to the scale of the states.
MOST_STEPS = 5000  # The largest number of integration steps in a period.
SECTIONS = 16  # The number of parts of a period; after each, the state is projected onto Z(R).
# A motion is periodic if it returns to within this, relative to the scale of the states.
CLOSED = 1e-7
CARRIED = 1e-6  # The error of the matrix M, relative to its norm.
NEWTON_STEPS = 12  # The largest number of Newton steps.
REPEATED = 1e-6  # A reference has a period if it repeats itself to this, relative to its values.


@dataclass(frozen=True, eq=False)
class StabilityAlong:
    """The stability of the internal states while the outputs follow a periodic reference."""

    verdict: Verdict
    reason: str
    period: float
    multipliers: ComplexArray = field(default_factory=lambda: np.zeros(0, dtype=complex))
    state: FloatArray | None = None


class _MotionLost(Exception):
    """Raised where a motion cannot be followed over a period."""


class PeriodicMotions:
    """The motions on Z(R(t)), given by `at`, with the period of R, and their multipliers."""

    def __init__(self, at: Callable[[float], PinnedSet], scale: FloatArray, period: float) -> None:
        self._at, self._scale, self._period = at, scale, period

    def judge(self, motion: PinnedMotion) -> StabilityAlong:
        """Judges the periodic motion found near a motion."""
        if not motion.times.size:
            return StabilityAlong(Verdict.UNDECIDED, str(motion.ending), self._period)
        self._check_period(motion.times)
        over = f"over {self._period:.6g} s"
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
            reason = f"the largest Floquet multiplier is {sizes[0]:.4g} {over}"
            if np.any(sizes > 1.0 + errors):
                verdict = Verdict.UNSTABLE
                reason = f"small disturbances of the motion grow: {reason}"
            elif np.all(sizes < 1.0 - errors):
                verdict = Verdict.STABLE
            else:
                verdict, count = Verdict.UNDECIDED, np.count_nonzero(np.abs(sizes - 1.0) <= errors)
                reason = (
                    f"{count} of {sizes.size} Floquet multipliers are on the unit circle, up to "
                    f"the error of integration, {over}"
                )
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
            later, columns, left = state, basis, MOST_STEPS
            for start, stop in pairwise(np.linspace(begin, begin + self._period, SECTIONS + 1)):
                later, columns, steps = self._section(later, columns, start, stop, left)
                later, left = self._onto(later, stop), left - steps
            scaled = (basis / self._scale[:, None]).T
            matrix = scaled @ (columns / self._scale[:, None])
            if not np.all(np.isfinite(matrix)):
                break
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
        self, state: FloatArray, columns: FloatArray, begin: float, end: float, most: int
    ) -> tuple[FloatArray, FloatArray, int]:
        """Integrates a state and tangent columns; also returns the number of steps."""
        n, unit = state.size, self._scale[:, None]

        def split(both: FloatArray) -> tuple[FloatArray, FloatArray]:
            parts = both.reshape(-1, n).T * unit
            return parts[:, 0], parts[:, 1:]

        def joined(first: FloatArray, rest: FloatArray) -> FloatArray:
            return np.asarray((np.column_stack([first, rest]) / unit).T.reshape(-1))

        def rate(time: float, both: FloatArray) -> FloatArray:
            (x, along), pinned = split(both), self._at(time)
            moved = joined(pinned.rate(x), pinned.slopes(x, along))
            if not np.all(np.isfinite(moved)):
                raise _MotionLost
            return moved

        def slopes(time: float, both: FloatArray) -> FloatArray:
            # Without second derivatives, for which the iteration of the integrator compensates.
            matrix = self._at(time).slopes(split(both)[0])
            blocks = [matrix * self._scale / unit] * (1 + columns.shape[1])
            return np.asarray(scipy.linalg.block_diag(*blocks), dtype=np.float64)

        y, steps = joined(state, columns), 0
        bound = GROWN * np.maximum(1.0, np.max(np.abs(y[:n])))
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # A failed step raises _MotionLost.
            solver = scipy.integrate.LSODA(
                rate, begin, y, end, rtol=ACCURACY, atol=ACCURACY, jac=slopes
            )
            while solver.status == "running":
                solver.step()
                steps += 1
                largest = np.max(np.abs(solver.y[:n]))
                if solver.status == "failed" or steps > most or not largest <= bound:
                    raise _MotionLost
        return (*split(solver.y), steps)
