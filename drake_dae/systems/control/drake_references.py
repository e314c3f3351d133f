"""Drake's trajectories as references."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import factorial

import casadi as ca
import numpy as np
from numpy.polynomial import Polynomial
from pydrake.trajectories import BsplineTrajectory, PiecewisePolynomial, Trajectory

from drake_dae.arguments import checked
from drake_dae.errors import ReferenceSignalError
from drake_dae.references import Reference
from drake_dae.references.polynomials import PiecewisePolynomials


@checked(ReferenceSignalError)
@dataclass(frozen=True, eq=False)
class TrajectoryReference(Reference):
    """A reference that is a Drake PiecewisePolynomial or BsplineTrajectory, with its derivatives.

    During a run a time outside its range is a SimulationError; Drake would clip it in silence.

    Attributes:
        trajectory: The trajectory, a column of shape (k, 1).

    Raises:
        ReferenceSignalError: The Trajectory is another one, or no column; or, where the reference
            is used, a derivative below the highest one jumps at a break.
    """

    trajectory: Trajectory

    def __post_init__(self) -> None:
        if not isinstance(self.trajectory, PiecewisePolynomial | BsplineTrajectory):
            raise ReferenceSignalError(
                "a reference Trajectory must be a PiecewisePolynomial or a BsplineTrajectory, got "
                f"a {type(self.trajectory).__name__}; sample it into one of these"
            )
        if self.trajectory.cols() != 1:
            raise ReferenceSignalError(
                "a reference Trajectory must be a column, this one is "
                f"{self.trajectory.rows()} x {self.trajectory.cols()}"
            )

    @property
    def size(self) -> int:
        return int(self.trajectory.rows())

    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX:
        pieces = self._pieces
        table = [pieces.expression(time)]
        for order in range(max(degrees)):
            self._check_breaks(pieces, order, degrees)
            pieces = _derivative(pieces)
            table.append(pieces.expression(time))
        rows = [table[k][i] for i, degree in enumerate(degrees) for k in range(degree + 1)]
        return ca.vertcat(*rows) + ca.if_else(self.margin(time) >= 0.0, 0.0, np.nan)

    def margin(self, time: ca.SX) -> ca.SX:
        """The distance of a time from the ends of the trajectory, in s; negative outside."""
        first, last = self.trajectory.start_time(), self.trajectory.end_time()
        return ca.fmin(time - first, last - time) + 1e-9 * max(1.0, abs(last))

    @property
    def _pieces(self) -> PiecewisePolynomials:
        """The polynomials of its segments, from their derivatives in the middle of each."""
        path, rows = self.trajectory, range(self.size)
        if isinstance(path, PiecewisePolynomial):
            breaks = np.array(path.get_segment_times())
            segments = range(path.get_number_of_segments())
            degree = max(path.getSegmentPolynomialDegree(i, row) for i in segments for row in rows)
        else:
            breaks, degree = np.unique(path.basis().knots()), path.basis().order() - 1
            breaks = breaks[(breaks >= path.start_time()) & (breaks <= path.end_time())]
        factors = np.zeros((breaks.size - 1, self.size, degree + 1))
        for i, (begin, end) in enumerate(pairwise(breaks)):
            middle, width = 0.5 * (begin + end), end - begin
            taylor = [path.value(middle)[:, 0]]
            taylor += [path.EvalDerivative(middle, k)[:, 0] for k in range(1, degree + 1)]
            shares = Polynomial([-0.5 * width, width])  # The time from the middle.
            for k, values in enumerate(taylor):
                power = np.asarray((shares**k).coef, float) / factorial(k)
                factors[i, :, : power.size] += np.outer(values, power)
        return PiecewisePolynomials(breaks, factors)

    def _check_breaks(
        self, pieces: PiecewisePolynomials, order: int, degrees: Sequence[int]
    ) -> None:
        before = pieces.factors[:-1].sum(axis=2)
        jumps = pieces.factors[1:, :, 0] - before
        for row, degree in enumerate(degrees):
            bad = np.abs(jumps[:, row]) > 1e-6 * (1.0 + np.abs(before[:, row]))
            if order < degree and bad.any():
                i = int(np.argmax(bad))
                raise ReferenceSignalError(
                    f"derivative {order} of row {row} of the reference Trajectory jumps by "
                    f"{jumps[i, row]:.3g} at t = {pieces.breaks[i + 1]:g} s, but the law needs a "
                    f"reference with {degree} derivatives; use a smoother trajectory"
                )


def _derivative(pieces: PiecewisePolynomials) -> PiecewisePolynomials:
    powers = np.arange(pieces.factors.shape[2])
    factors = (pieces.factors * powers)[:, :, 1:] / np.diff(pieces.breaks)[:, None, None]
    if not factors.shape[2]:
        factors = np.zeros((*factors.shape[:2], 1))
    return PiecewisePolynomials(pieces.breaks, factors)
