"""The curve of a reference, by the distance along it.

A reference r(t) is taken as a curve: its time is a parameter. The distance s has

    ds/dt = rho(t) = |D r'(t)|,   D = diag(1 / range of r_j),

over the outputs with mu_j = 2. By s the curve is regular wherever the reference rests on its way
along one direction, such as at the ends of a move from rest to rest. Where it rests and leaves in
another direction, any motion along it must rest, too; there it is divided into pieces. Where it
rests for some time, it has a pause.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.references.pieces import PiecewiseReference
from drake_dae.dae.references.reference import Reference, with_degrees
from drake_dae.dae.system.layout import DerivativeLayout, Indices
from drake_dae.dae.timing.many_points import ManyPoints
from drake_dae.errors import ReferenceSignalError

REST = 1e-9
"""A reference is at rest where its speed is below this fraction of the largest speed."""

NEAR_REST = 1e3
"""The speed at which a turn is a rest, relative to that of a rest."""

TURN = 0.5
"""The cosine between directions of neighbouring samples below which a rest is looked for."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)

Times = Callable[[FloatArray], FloatArray]


def at_times(references: Sequence[Reference], layout: DerivativeLayout) -> Times:
    """Returns references as a function of many times, shape (k,) -> (k, sum (mu_i + 1))."""
    parts = [_one_at_times(*part) for part in with_degrees(references, layout.degrees)]
    return lambda times: np.hstack([part(times) for part in parts])


def _one_at_times(reference: Reference, degrees: Sequence[int]) -> Times:
    if isinstance(reference, PiecewiseReference):
        reference.derivatives(degrees)  # Refuses those that are not smooth enough.
        return reference.pieces(degrees).at_all
    time = ca.SX.sym("t")
    rows = reference.expression(degrees, time)
    if rows is None:
        function = reference.derivatives(degrees)
        return lambda times: np.array([function(time) for time in times.tolist()])
    traced = ManyPoints(ca.Function("reference", [time], [ca.densify(rows)]))
    return lambda times: traced(times[:, None])[0]


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of a curve between two rests, or a pause.

    Attributes:
        times: The reference's times at the points, in s, shape (N + 1,).
        distances: s at the points, shape (N + 1,); all 0 in a pause.
        values: R at the points, shape (N + 1, sum (mu_i + 1)).
        tangents: r_s of the outputs with mu_i = 2, shape (N + 1, k).
        curvatures: r_ss of these, shape (N + 1, k).
        speeds: rho = ds/dt at the points, shape (N + 1,).
    """

    times: FloatArray
    distances: FloatArray
    values: FloatArray
    tangents: FloatArray
    curvatures: FloatArray
    speeds: FloatArray

    @property
    def is_pause(self) -> bool:
        """Whether nothing moves."""
        return not self.distances[-1] > 0.0


class Curve:
    """The curve of a reference, by the distance along it.

    Args:
        references: The references, in the order of the outputs.
        layout: The layout of R; degrees are 0 or 2.
        begin, end: The first and the last time of the reference, in s.
        count: The number of intervals between points.

    Attributes:
        pieces: Its pieces and pauses in their order.
        moving: The outputs with mu_i = 2.
        at: R at times of the reference, (k,) -> (k, sum (mu_i + 1)).

    Raises:
        ReferenceSignalError: No position moves.
    """

    def __init__(
        self,
        references: Sequence[Reference],
        layout: DerivativeLayout,
        begin: float,
        end: float,
        count: int,
    ) -> None:
        self.at, self.moving = at_times(references, layout), layout.dynamic
        self._first: Indices = layout.lowest[self.moving] + 1
        fine = np.linspace(begin, end, max(2001, 2 * count + 1))
        values = self.at(fine)
        if not np.isfinite(values).all():
            worst = fine[int(np.argmin(np.isfinite(values).all(axis=1)))]
            raise ReferenceSignalError(f"the reference is not finite at t = {worst:g} s")
        spread = np.ptp(values[:, layout.lowest[self.moving]], axis=0)
        moves = spread > 1e-12 * np.abs(values[:, layout.lowest[self.moving]]).max(axis=0)
        if not moves.any():
            raise ReferenceSignalError(
                "no position of the reference moves, so there is no path to time"
            )
        self._weights = np.where(moves, 1.0 / np.where(moves, spread, 1.0), 0.0)
        speeds = self._speed(values)
        self._rest = REST * float(speeds.max())
        ranges = list(self._ranges(fine, values, speeds))
        # Between rests points are spread as the time is that a motion at full acceleration takes.
        shares = np.array([0.0 if is_pause else length**0.5 for *_, length, is_pause in ranges])
        counts = np.maximum(np.ceil(count * shares / shares.sum()).astype(int), 20)
        self.pieces = tuple(
            self._pause(first, last, count) if is_pause else self._piece(first, last, int(number))
            for (first, last, _, is_pause), number in zip(ranges, counts, strict=True)
        )

    def _speed(self, values: FloatArray) -> FloatArray:
        """rho at rows of R."""
        return np.linalg.norm(self._weights * values[:, self._first], axis=1)

    def _ranges(
        self, times: FloatArray, values: FloatArray, speeds: FloatArray
    ) -> list[tuple[float, float, float, bool]]:
        """First and last time, length, and whether it is a pause, of each piece."""
        ranges: list[tuple[float, float, bool]] = []
        moves = speeds > self._rest
        first, before = float(times[0]), -1  # The begin of a piece, and its last moving sample.
        rates = self._weights * values[:, self._first]
        units = rates / np.where(moves, speeds, 1.0)[:, None]
        turns = np.flatnonzero(np.sum(units[1:] * units[:-1], axis=1) < TURN)
        looked = {0, times.size - 1, *turns.tolist(), *(turns + 1).tolist()}
        for k in sorted(looked):
            if moves[k]:
                is_next = before >= 0 and k - before <= 2
                turn = self._turn(times, rates, before, k) if is_next else None
                if turn is not None:
                    ranges.append((first, turn, False))
                    first = turn
                before = k
            elif k + 1 < times.size and not moves[k + 1] and (k == 0 or moves[k - 1]):
                last = k + int(np.argmax(np.append(moves[k:], True)))
                if before >= 0:
                    ranges.append((first, float(times[k]), False))
                first, before = float(times[last - 1]), -1
                ranges.append((float(times[k]), first, True))
        if first < times[-1]:
            ranges.append((first, float(times[-1]), False))
        lengths = np.concatenate(
            [[0.0], np.cumsum(np.diff(times) * (speeds[1:] + speeds[:-1]) / 2)]
        )
        return [
            (a, b, float(np.diff(np.interp([a, b], times, lengths))[0]), is_pause)
            for a, b, is_pause in ranges
        ]

    def _turn(self, times: FloatArray, rates: FloatArray, k: int, after: int) -> float | None:
        """Returns the time between two samples at which the reference rests and turns, if any."""
        from scipy.optimize import brentq, minimize_scalar  # It takes long to load.

        rate, next_rate = rates[k], rates[after]
        if rate @ next_rate > TURN * np.linalg.norm(rate) * np.linalg.norm(next_rate):
            return None

        def along(time: float) -> float:
            return float(self._weights * self.at(np.array([time]))[0, self._first] @ rate)

        def speed(time: float) -> float:
            return float(self._speed(self.at(np.array([time])))[0])

        if rate @ next_rate < 0.0:
            turn = float(brentq(along, times[k], times[after], xtol=1e-15, rtol=1e-15))
        else:
            limits = (times[k], times[after])
            turn = float(minimize_scalar(speed, bounds=limits, method="bounded").x)
        return turn if speed(turn) < NEAR_REST * self._rest else None

    def _pause(self, first: float, last: float, count: int) -> Piece:
        times = np.linspace(first, last, count + 1)  # Forces go on, as straight lines between.
        values, none = self.at(times), np.zeros((times.size, self.moving.size))
        return Piece(times, np.zeros(times.size), values, none, none, np.zeros(times.size))

    def _piece(self, first: float, last: float, count: int) -> Piece:
        """Points close together at both rests, where the speed changes fast with the distance.

        In between they are spread by the length, of which a whole turn counts as much as all.
        """
        fine = np.linspace(first, last, max(1001, 2 * count + 1))
        rates = self._weights * self.at((fine[1:] + fine[:-1]) / 2.0)[:, self._first]
        middle = np.linalg.norm(rates, axis=1)
        units = rates / np.maximum(middle, self._rest)[:, None]
        turned = np.linalg.norm(np.diff(units, axis=0, prepend=units[:1]), axis=1) / (2.0 * np.pi)
        moves = middle > NEAR_REST * self._rest  # The last of a motion has no direction.
        turned[~(moves & np.append(moves[0], moves[:-1]))] = 0.0
        lengths = middle * np.diff(fine)
        far = np.concatenate([[0.0], np.cumsum(lengths / lengths.sum() + turned)])
        close = far[-1] * (1.0 - np.cos(np.pi * np.arange(count + 1) / count)) / 2.0
        times = np.interp(close, far, fine)
        times[0], times[-1] = first, last
        half = np.diff(times)[:, None] / 2.0
        inner = (times[:-1, None] + half) + half * _NODES
        speeds = self._speed(self.at(inner.ravel())).reshape(inner.shape)
        distances = np.concatenate([[0.0], np.cumsum(half[:, 0] * (speeds @ _WEIGHTS))])
        values = self.at(times)
        return Piece(times, distances, values, *self._geometry(values))

    def _geometry(self, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """r_s, r_ss and rho at the points.

        r_s = r' / rho,   r_ss = (r'' - r_s rho') / rho^2,   rho' = D r' . D r'' / rho.

        At a rest r_s is that of the next point, and r_ss is 0: b is 0 there.
        """
        first, second = values[:, self._first], values[:, self._first + 1]
        rho = self._speed(values)
        rests = rho <= self._rest
        safe = np.where(rests, 1.0, rho)[:, None]
        slope = np.sum((self._weights * first) * (self._weights * second), axis=1)[:, None] / safe
        tangents = first / safe
        curvatures = (second - tangents * slope) / safe**2
        curvatures[rests] = 0.0
        for end, neighbour in ((0, 1), (-1, -2)):
            if rests[end]:
                tangents[end] = tangents[neighbour]
        return tangents, curvatures, np.where(rests, 0.0, rho)
