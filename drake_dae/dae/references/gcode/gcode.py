"""A reference from a program in G-code."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from math import isfinite, pi, sqrt
from pathlib import Path
from typing import Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, positive
from drake_dae.dae.references.gcode.points import read_points
from drake_dae.dae.references.gcode.program import GCodeMove, GCodeProgram, read_program
from drake_dae.dae.references.paths import check_order
from drake_dae.dae.references.splines import (
    MOST_POINTS,
    SplineReference,
    TimeSpline,
    basis_pieces,
    rounded_up,
    settle_axes,
    spline_within,
)
from drake_dae.dae.references.travel import PathLimits
from drake_dae.dae.system.layout import Indices
from drake_dae.errors import ReferenceSignalError
from drake_dae.files import read_text

SHARE = 0.5
"""The share of the acceleration that is for speeding up and for arcs; the rest is for corners."""

NODES = 4000
"""The number of points of a path at which its speed and its distance from the spline are
computed."""

_SAMPLES = 8
"""The number of chords that replace a span of the spline when its distance is measured."""


@checked(ReferenceSignalError)
@dataclass(frozen=True)
class GCodeReference(SplineReference):
    """The path of a program in G-code, from rest to rest, for two outputs.

    It follows G0, G1, G2 and G3 in the plane XY, see `read_program`, at the programmed feeds, G0 at
    the limit of the speed, and slower on arcs and before corners as the limits need. It is a
    uniform B-spline over points that this motion passes a step h apart. A corner at which the
    velocity changes by dv is then rounded by g h dv with the acceleration b dv / h, where b and g
    belong to the order; the step makes dv as large as tolerance and acceleration allow. `remark`
    reports the rounding and the duration. With `press` there is a third output, a force that is
    smaller in G0 moves.

    A .csv has the points of a path without times in place of a program: x and y in mm, and the
    speed in mm/s or the feed in mm/min with which a point is reached, see `read_points`; without
    speeds the limit of the speed holds. With `press` the whole path has the first force. Each of
    `columns` is one more output, linear between the points: so the tool can follow normals that a
    CAM program gives, as the components of its axis.

    Attributes:
        file: The program, or the points as a .csv.
        limits: The largest speed, acceleration and jerk of the two outputs, in m and s.
        origin: The position of X0 Y0, shape (2,), in m.
        along: The direction of X, shape (2,): the change of the outputs per m.
        up: The direction of Y, likewise.
        press: The force in G1, G2 and G3 and that in G0, in N, shape (2,); None without force.
        columns: Further columns of a .csv, one for each further output, in the outputs' units.
        tolerance: The largest distance of the path from the reference, in m.
        start_time: The start of the motion, in s.
        order: The number of continuous derivatives, from 2 to 12; at least mu of the outputs.

    Raises:
        ReferenceSignalError: A number is not valid. When the reference is used: the program cannot
            be read or followed, or the tolerance needs too many points.
    """

    file: str
    limits: PathLimits
    origin: ArrayLike = (0.0, 0.0)
    along: ArrayLike = (1.0, 0.0)
    up: ArrayLike = (0.0, 1.0)
    press: ArrayLike | None = None
    columns: Sequence[str] = ()
    tolerance: float = 1e-4
    start_time: float = 0.0
    order: int = 4

    def __post_init__(self) -> None:
        settle_axes(self)
        positive("tolerance", self.tolerance, ReferenceSignalError)
        check_order(self.order)

    @property
    def size(self) -> int:
        return 2 + (self.press is not None) + len(self.columns)

    def beside(self, folder: Path) -> Self:
        return replace(self, file=os.path.abspath(folder / self.file))

    @cached_property
    def program(self) -> GCodeProgram:
        """The moves that the file contains."""
        if Path(self.file).suffix.lower() == ".csv":
            return read_points(self.file, self.columns)
        if self.columns:
            raise ReferenceSignalError(
                f"'{self.file}' is a program and has no columns {', '.join(self.columns)}; give "
                "the points of the path as a .csv"
            )
        try:
            return read_program(read_text(self.file), self.file)
        except (OSError, ValueError) as error:
            if isinstance(error, ReferenceSignalError):
                raise
            reason = getattr(error, "strerror", None) or error
            raise ReferenceSignalError(f"cannot read '{self.file}': {reason}") from error

    @cached_property
    def spline(self) -> TimeSpline:
        return self._fitted[0]

    @property
    def deviation(self) -> float:
        """The largest distance of the path from the reference, in m."""
        return self._fitted[1]

    @property
    def remark(self) -> str:
        moves = self.program.moves
        programmed = sum(move.length / self._speed(move) for move in moves)
        parts = [
            f"takes {self.spline.duration:.3g} s, {programmed:.3g} s by its feeds alone",
            f"corners are rounded by up to {rounded_up(1e3 * self.deviation)} mm",
        ]
        if self.program.ignored:
            parts.append(f"{', '.join(self.program.ignored)} not followed")
        return f"GCodeReference '{Path(self.file).name}': {'; '.join(parts)}"

    def _speed(self, move: GCodeMove) -> float:
        """The speed of a move along the outputs."""
        return min(move.speed, self.limits.speed)

    @cached_property
    def _fitted(self) -> tuple[TimeSpline, float]:
        """The spline, and the distance of the path from it."""
        # The peak of the B-spline of degree order - 1, and half the mean distance from its middle
        # for that of degree order + 1, by normal distributions of the same variance.
        peak = sqrt(6.0 / (pi * self.order))
        reach = sqrt((self.order + 2) / (24.0 * pi))
        allowed, acceleration = self.tolerance, self.limits.acceleration
        at_corners = (1.0 - SHARE) * acceleration
        while True:
            step = sqrt(allowed * peak / (reach * at_corners))
            change = sqrt(allowed * at_corners / (reach * peak))
            bend = sqrt(24.0 * allowed / (self.order + 2)) / step
            path = _Path(self.program.moves, [self._speed(move) for move in self.program.moves])
            times = path.times(change, bend, SHARE * acceleration)
            if times[-1] / step > MOST_POINTS:
                raise ReferenceSignalError(
                    f"'{self.file}': a tolerance of {self.tolerance:g} m needs "
                    f"{times[-1] / step:,.0f} points, and {MOST_POINTS:,} are the most; choose a "
                    "larger one, or split the program"
                )
            step = times[-1] / np.ceil(times[-1] / step)
            moments = np.linspace(0.0, times[-1], round(times[-1] / step) + 1)
            along = np.interp(moments, times, path.distances)
            off = _distance(TimeSpline(path.at(along), step, 0.0, self.order), path, along)
            if off <= self.tolerance:
                break
            allowed *= max(0.9 * self.tolerance / off, 0.25)
        points = np.asarray(self.origin) + path.at(along) @ np.array([self.along, self.up])
        if self.press is not None:
            is_program = Path(self.file).suffix.lower() != ".csv"
            is_rapid = np.array([is_program and not isfinite(m.speed) for m in path.moves])
            force = np.asarray(self.press)[is_rapid[path.moves_at(along)].astype(int)]
            points = np.column_stack([points, force])
        further = [np.interp(along, path.ends, column) for column in self.program.further.T]
        points = np.column_stack([points, *further])
        spline = spline_within(points, self.limits, self.start_time, self.order, among=2)
        return replace(spline, step=max(spline.step, step)), off


class _Path:
    """Moves one after the other, by the distance along them.

    Attributes:
        moves: The moves.
        distances: Nodes along the path, with the ends of all moves among them, in m.
    """

    def __init__(self, moves: Sequence[GCodeMove], speeds: Sequence[float]) -> None:
        self.moves, self._speeds = moves, speeds
        self.ends = np.concatenate([[0.0], np.cumsum([move.length for move in moves])])
        parts = [
            np.linspace(first, last, max(3, int(NODES * (last - first) / self.ends[-1])))[1:]
            for first, last in pairwise(self.ends)
        ]
        self.distances = np.concatenate([[0.0], *parts])

    def moves_at(self, along: FloatArray) -> Indices:
        """The index of the move at each distance."""
        last = len(self.moves) - 1
        return np.clip(np.searchsorted(self.ends, along, side="left") - 1, 0, last)

    def at(self, along: FloatArray) -> FloatArray:
        """The points at distances along the path, shape (n, 2)."""
        points, which = np.empty((along.size, 2)), self.moves_at(along)
        for number in np.unique(which).tolist():
            chosen, move = which == number, self.moves[number]
            shares = (along[chosen] - self.ends[number]) / move.length
            points[chosen] = move.at(np.clip(shares, 0.0, 1.0))
        return points

    def times(self, change: float, bend: float, acceleration: float) -> FloatArray:
        """Returns the times in s at which the motion passes the nodes.

        Args:
            change: The largest change of the velocity at a corner, at the start and at the end.
            bend: The largest speed on an arc, relative to the root of its radius.
            acceleration: The largest acceleration along the path, and across it on an arc.
        """
        speeds = np.array(self._speeds)
        for number, move in enumerate(self.moves):
            radius = move.radius
            speeds[number] = min(speeds[number], bend * sqrt(radius), sqrt(acceleration * radius))
        squares = speeds[self.moves_at(self.distances)] ** 2
        corners = np.searchsorted(self.distances, self.ends - 1e-12 * self.ends[-1])
        squares[corners[[0, -1]]] = np.minimum(squares[corners[[0, -1]]], change**2)
        for node, (before, after), pair in zip(
            corners[1:-1], pairwise(self.moves), pairwise(speeds), strict=True
        ):
            turned = float(np.linalg.norm(after.direction(0.0) - before.direction(1.0)))
            squares[node] = min(*np.square(pair), (change / max(turned, 1e-9)) ** 2)
        gains = 2.0 * acceleration * np.diff(self.distances)
        for nodes in (range(1, squares.size), range(squares.size - 2, -1, -1)):
            for i in nodes:
                j = i - nodes.step
                squares[i] = min(squares[i], squares[j] + gains[min(i, j)])
        speed = np.sqrt(squares)
        steps = 2.0 * np.diff(self.distances) / (speed[1:] + speed[:-1])
        return np.concatenate([[0.0], np.cumsum(steps)])


def _distance(spline: TimeSpline, path: _Path, along: FloatArray) -> float:
    """The largest distance of a path's nodes from a spline over points of the path.

    Args:
        spline: The spline.
        path: The path.
        along: The distances of the points along the path.
    """
    powers = (np.arange(_SAMPLES)[:, None] / _SAMPLES) ** np.arange(spline.degree + 1)
    spans = sliding_window_view(spline.differences[0], spline.degree + 1, axis=0)
    curve = np.einsum("si,ik,nck->nsc", powers, basis_pieces(spline.degree), spans)
    curve = np.concatenate([curve.reshape(-1, 2), spline.points[-1:]])
    # The spans on which the last point before a node acts, and the next one.
    near = np.searchsorted(along, path.distances, side="right") - 1
    width = (spline.order + 3) * _SAMPLES
    padded = np.pad(curve, ((_SAMPLES, width), (0, 0)), mode="edge")
    windows = sliding_window_view(padded, width + 1, axis=0)[near * _SAMPLES]
    first, edge = windows[..., :-1], np.diff(windows, axis=-1)
    to_node = path.at(path.distances)[:, :, None] - first
    squares = np.maximum((edge**2).sum(axis=1), np.finfo(float).tiny)
    shares = np.clip((to_node * edge).sum(axis=1) / squares, 0.0, 1.0)
    distances = np.linalg.norm(to_node - shares[:, None, :] * edge, axis=1)
    return float(distances.min(axis=1).max())
