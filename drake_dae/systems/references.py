"""References as a LeafSystem.                                                         (28)"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import factorial

import casadi as ca
import numpy as np
from pydrake.trajectories import BsplineTrajectory, PiecewisePolynomial, Trajectory

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray
from drake_dae.blocks.block import TIME, Block, Requirement, stacked
from drake_dae.blocks.lifetime import SHARED_DICTIONARY
from drake_dae.blocks.traced_system import TracedSystem
from drake_dae.dae import Signal
from drake_dae.errors import ReferenceSignalError
from drake_dae.references import Reference, ReferenceRows
from drake_dae.references.reference import stacked_expression
from drake_dae.references.splines import PiecewisePolynomials
from drake_dae.trace.functions import FailureKind


@checked(ReferenceSignalError)
class ReferenceGenerator(TracedSystem):
    """References of all outputs, stacked, with their derivatives.

    Output port:
        reference: R(t) of (28): r_1, r_1', ..., r_1^(mu_1), r_2, ..., output-major, shape
            (sum (mu_i + 1),).

    Args:
        references: The references, in the order of the outputs; together they cover all of them.
        degrees: The degrees mu_1, ..., mu_p, `TrackingLaw.degrees`.

    Raises:
        ReferenceSignalError: The references cover too few or too many outputs, or are not smooth
            enough.
        NonFiniteError: A reference is not finite during a run; the exception has the time.
    """

    __slots__ = SHARED_DICTIONARY

    def __init__(self, references: Sequence[Reference], degrees: Sequence[int]) -> None:
        self.references, self.degrees = tuple(references), tuple(degrees)
        super().__init__(reference_block(references, degrees), sees_steps=False)

    def reference(self, time: float) -> FloatArray:
        """R(t) at a time in s, without commands, shape (sum (mu_i + 1),)."""
        context = self.CreateDefaultContext()
        context.SetTime(time)
        self._steps.begin(context)  # Then a time without a value is an error.
        return np.array(self.get_output_port().Eval(context))


def reference_block(references: Sequence[Reference], degrees: Sequence[int]) -> Block:
    """R(t) with its derivatives, as a block; see `ReferenceGenerator`."""
    if (covered := sum(reference.size for reference in references)) != len(degrees):
        raise ReferenceSignalError(
            f"the references cover {covered} outputs, the law has {len(degrees)}"
        )
    wholes = (r.reference if isinstance(r, ReferenceRows) else r for r in references)
    ranges = (each.range for each in wholes if isinstance(each, TrajectoryReference))
    outputs = {"reference": stacked_expression(references, degrees, TIME)}
    return Block("reference", outputs=outputs, requirements=tuple(ranges))


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
        path = self.trajectory
        if not isinstance(path, PiecewisePolynomial | BsplineTrajectory):
            raise ReferenceSignalError(
                "a reference Trajectory must be a PiecewisePolynomial or a BsplineTrajectory, got "
                f"a {type(path).__name__}; sample it into one of these"
            )
        if path.cols() != 1:
            size = f"{path.rows()} x {path.cols()}"
            raise ReferenceSignalError(f"a reference Trajectory must be a column, got {size}")

    @property
    def size(self) -> int:
        return int(self.trajectory.rows())

    def expression(self, degrees: Sequence[int], time: ca.SX) -> ca.SX:
        pieces = self._pieces
        table = [pieces.expression(time)]
        for order in range(max(degrees)):
            pieces = _derivative(pieces, order, degrees)
            table.append(pieces.expression(time))
        rows = [table[k][i] for i, degree in enumerate(degrees) for k in range(degree + 1)]
        return ca.substitute(self.range.of(ca.vertcat(*rows)), TIME, time)

    @property
    def range(self) -> Requirement:
        """That TIME is in the range of the trajectory."""
        first, last = self.trajectory.start_time(), self.trajectory.end_time()
        margin = ca.fmin(TIME - first, last - TIME) + 1e-9 * max(1.0, abs(last))
        text = f"the reference Trajectory covers {first:g} to {last:g} s; extend it over the run"
        return Requirement(margin, text, FailureKind.OUTSIDE)

    @property
    def _pieces(self) -> PiecewisePolynomials:
        """The polynomials of its segments, from the derivatives at the begin of each."""
        path, rows = self.trajectory, range(self.size)
        if isinstance(path, PiecewisePolynomial):
            breaks = np.array(path.get_segment_times())
            segments = range(path.get_number_of_segments())
            degree = max(path.getSegmentPolynomialDegree(i, row) for i in segments for row in rows)
        else:
            breaks, degree = np.unique(path.basis().knots()), path.basis().order() - 1
            breaks = breaks[(breaks >= path.start_time()) & (breaks <= path.end_time())]
        powers = range(degree + 1)
        factors = [
            [
                path.EvalDerivative(begin, k)[:, 0] * (end - begin) ** k / factorial(k)
                for k in powers
            ]
            for begin, end in pairwise(breaks)
        ]
        return PiecewisePolynomials(breaks, np.swapaxes(factors, 1, 2))


def _derivative(
    pieces: PiecewisePolynomials, order: int, degrees: Sequence[int]
) -> PiecewisePolynomials:
    """The derivative of the one of this order, which must not jump below the highest one."""
    before = pieces.factors[:-1].sum(axis=2)
    jumps = pieces.factors[1:, :, 0] - before
    needed = order < np.array(degrees)
    for i, row in np.argwhere((np.abs(jumps) > 1e-6 * (1.0 + np.abs(before))) & needed):
        raise ReferenceSignalError(
            f"derivative {order} of row {row} of the reference Trajectory jumps by "
            f"{jumps[i, row]:.3g} at t = {pieces.breaks[i + 1]:g} s, but the law needs a "
            f"reference with {degrees[row]} derivatives; use a smoother trajectory"
        )
    powers = np.arange(pieces.factors.shape[2])
    factors = (pieces.factors * powers)[:, :, 1:] / np.diff(pieces.breaks)[:, None, None]
    constant = np.zeros((*factors.shape[:2], 1))
    return PiecewisePolynomials(pieces.breaks, factors if factors.shape[2] else constant)


RATES, RATE = {"N": 40.0, "N m": 40.0}, 12.0
"""Unit -> the rate w of the lags, in 1/s; that of others."""

SPEEDS, SPEED = {"m": 0.4, "N": 400.0, "N m": 40.0}, 1.0
"""Unit -> the largest speed V of a change, in this unit per second; that of others."""


@checked(ReferenceSignalError)
class CommandedReferences(ReferenceGenerator):
    """References with changes that are commanded while they run.

    Numeric parameter 0 has the commands, named by `commands`: a change of each reference in its
    unit, 0 by default, which may jump at any time. A law needs a reference with mu derivatives, so
    that a command c passes through mu + 1 lags of rate w, the first of limited speed:

        y_0' = sat(w (c - y_0), V),    y_j' = w (y_(j-1) - y_j),    j = 1, ..., mu,

    and y_mu is added to the reference. Its derivatives up to mu are sums of y_0, ..., y_mu. A lag
    is a mean with positive weights, so that y_mu does not overshoot, |y_mu'| <= V, and
    |y_mu^(k)| <= (2 w)^(k-1) V. `depth` is the least number of lags, for another block with the
    same commands and more derivatives; `signals` are names and units of outputs and commands.
    """

    __slots__ = TracedSystem.__slots__

    def __init__(
        self,
        references: Sequence[Reference],
        degrees: Sequence[int],
        signals: Sequence[Signal],
        *,
        depth: int = 0,
    ) -> None:
        self.references, self.degrees = tuple(references), tuple(degrees)
        base, self.commands = reference_block(references, degrees), tuple(signals)
        command = ca.SX.sym("c", len(self.commands))
        states, rates, rows = list[ca.SX](), list[ca.SX](), list[ca.SX]()
        for i, (degree, signal) in enumerate(zip(degrees, self.commands, strict=True)):
            w, most = RATES.get(signal.unit, RATE), SPEEDS.get(signal.unit, SPEED)
            y = ca.SX.sym("y", max(degree + 1, depth))
            first = ca.fmin(ca.fmax(w * (command[i] - y[0]), -most), most)
            rate = ca.vertcat(first, w * (y[:-1, :] - y[1:, :]))
            states.append(y)
            rates.append(rate)
            rows.append(y[-1])
            for _ in range(degree):
                rows.append(ca.jtimes(rows[-1], y, rate))
        block = replace(
            base,
            outputs={"reference": base.outputs["reference"] + stacked(rows)},
            state=stacked(states),
            derivative=stacked(rates),
            parameters=command,
            start={},
            signals={"parameters": self.commands},
        )
        TracedSystem.__init__(self, block, sees_steps=False)
