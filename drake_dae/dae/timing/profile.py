"""The time-optimal profile of a path reference."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from drake_dae.arguments import checked
from drake_dae.arrays import FloatArray, check_whole_number, vector
from drake_dae.dae.references.by_name import references_by_name
from drake_dae.dae.references.pieces import PiecewisePolynomials, PiecewiseReference
from drake_dae.dae.references.reference import Reference
from drake_dae.dae.structure.structure import Structure
from drake_dae.dae.system.layout import DerivativeLayout
from drake_dae.dae.timing.along import AlongCurve
from drake_dae.dae.timing.coarser import coarser
from drake_dae.dae.timing.curve import Curve, Piece
from drake_dae.dae.timing.motion_limits import MotionLimits
from drake_dae.dae.timing.reachable import FastestMotion, LinearLimits, fastest_motion
from drake_dae.dae.timing.rows import EXCESS, LimitRow, LimitRows, checked_pause, rows_along
from drake_dae.dae.timing.smoothing import smoothed
from drake_dae.dae.timing.time_table import at_rest_outside, stacked, time_table
from drake_dae.dae.timing.tool_limits import tool_limits
from drake_dae.errors import ModelError, ReferenceSignalError

_PAUSE = LimitRow("pause of the reference", "", "")

PASSES = 40
"""The largest number of passes where signals are not linear in (a, b)."""

SETTLED = 1e-7
"""Passes end where b changes by less than this share of its largest value."""

BETWEEN = (0.25, 0.5, 0.75)
"""The shares of the time of an interval at which limits are tested between points."""

LOWERINGS = 3
"""The largest number of times that limits are lowered where the motion exceeds them."""


@dataclass(frozen=True, eq=False)
class ProfilePiece:
    """A motion from rest to rest, or a pause.

    Attributes:
        piece: The part of the curve.
        times: The times of the motion at the points, in s after its begin, shape (N + 1,).
        b: s'^2 at the points, shape (N + 1,); zeros in a pause.
        a: s'' at the points, shape (N + 1,).
        highest: The largest b from which the motion can brake, shape (N + 1,).
        limiting: The cause of the limit of each interval, as an index into `TimeProfile.causes`,
            shape (N,).
    """

    piece: Piece
    times: FloatArray
    b: FloatArray
    a: FloatArray
    highest: FloatArray
    limiting: np.typing.NDArray[np.intp]


@dataclass(frozen=True, eq=False, repr=False)
class TimeProfile:
    """The fastest motion along the curve of a reference.

    Attributes:
        pieces: Its motions from rest to rest and its pauses, in their order.
        causes: The limits that can act, to which `ProfilePiece.limiting` refers.
        start_time: The begin of the motion, in s.
        layout: The layout of R.
    """

    pieces: tuple[ProfilePiece, ...]
    causes: tuple[LimitRow, ...]
    start_time: float
    layout: DerivativeLayout

    def __repr__(self) -> str:
        count = sum(not part.piece.is_pause for part in self.pieces)
        return f"TimeProfile({self.duration:.4g} s, {count} motions from rest to rest)"

    @property
    def duration(self) -> float:
        """The duration of the motion, in s."""
        return float(sum(piece.times[-1] for piece in self.pieces))

    @property
    def shares(self) -> dict[str, float]:
        """Name of what limits the motion -> its fraction of the time, the largest first."""
        sums: dict[str, float] = {}
        for part in self.pieces:
            for cause, time in zip(part.limiting.tolist(), np.diff(part.times), strict=True):
                name = self.causes[cause].text
                sums[name] = sums.get(name, 0.0) + float(time) / self.duration
        return dict(sorted(sums.items(), key=lambda item: -item[1]))


@checked(ReferenceSignalError)
class PathTiming:
    """Computes the shortest motions along the curves of references within limits.

    A reference r(t) is taken as a curve r(s), see `dae.timing.curve`. For any s(t) the reference
    r(s(t)) is admissible, so that errors obey (30), (31) whatever s does. With b = s'^2 and a = s''
    the control (28) and the constraint inputs (25) on the curve without error are

        u = m(s) b + n(s) a + c(s),

    with m, n, c from the law itself, and so are accelerations; speeds limit b. The largest b is
    found by reachable sets, see `dae.timing.reachable`. Friction makes u nonlinear in b: it is then
    linearized about the previous profile, at which it is exact, until the profile no longer
    changes.

    Args:
        structure: The structure of the system, `find_structure`: rigid joints, where positions have
            degree 2 and forces degree 0, without zero dynamics.
        limits: The limits of controls, states, their rates, and forces.

    Raises:
        ReferenceSignalError: There is no such profile for the system.
        ModelError: A limit names no signal of the system.
    """

    def __init__(self, structure: Structure, limits: MotionLimits) -> None:
        self.structure, self.limits = structure, limits
        self._along = AlongCurve(structure, limits)

    def profile(
        self,
        references: Sequence[Reference] | Mapping[str, Reference | float],
        end: float,
        *,
        begin: float = 0.0,
        start: ArrayLike | None = None,
        parameters: ArrayLike | None = None,
        largest_rate: float | None = None,
        points: int = 1000,
    ) -> TimeProfile:
        """Returns the shortest motion along the curve of a reference.

        A force is that of the reference at s. Where nothing moves, time passes as in the reference;
        a pause at the end in which no output changes is omitted. Limits of speed and acceleration
        of paths, `PathLimits`, hold as well; their jerk is not limited.

        Args:
            references: The references of all outputs; or name -> reference, or a number.
            end: The last time of the reference, in s.
            begin: The first time of the reference, in s.
            start: A state near which the motion begins, shape (n,); the nominal one if None.
            parameters: Values of all parameters; the defaults if None.
            largest_rate: The largest rate of the reference's time: with 1 the motion is nowhere
                faster than the reference; None for no limit.
            points: The number of intervals of the grid.

        Raises:
            ReferenceSignalError: The system is not within the limits at rest on the curve; nothing
                limits the motion; nothing moves; or the curve is out of reach.
            ModelError: A number makes no sense.
        """
        check_whole_number("points", points, 20)
        if not end > begin or (largest_rate is not None and not largest_rate > 0.0):
            raise ModelError(
                "end must be after begin and largest_rate positive, got "
                f"{begin:g} s, {end:g} s and {largest_rate}"
            )
        along, system = self._along, self.structure.system
        names = [signal.name for signal in system.output_signals]
        if isinstance(references, Mapping):
            references = references_by_name(references, names, along.layout.degrees)
        size = sum(reference.size for reference in references)
        if size != len(names):
            raise ReferenceSignalError(
                f"the references cover {size} outputs, the system has {len(names)}"
            )
        curve = Curve(references, along.layout, begin, end, points)
        guess = system.nominal_state if start is None else vector("start", start, system.num_states)
        numbers = system.parameter_vector(parameters)
        parts, causes = list[ProfilePiece](), tuple[LimitRow, ...]()
        for piece in _without_last_pause(curve.pieces, along.layout):
            if piece.is_pause:
                guess = checked_pause(along, piece, guess, numbers)
                parts.append(_pause(piece))
                continue
            tools = tool_limits(references, piece, along.layout)
            rows = rows_along(along, piece, guess, numbers, tools)
            guess, causes = rows.at_rest[-1], rows.names
            parts.append(_fastest(rows, piece, largest_rate))
        return TimeProfile(tuple(parts), (*causes, _PAUSE), begin, along.layout)


@checked(ReferenceSignalError)
@dataclass(frozen=True, eq=False)
class TimeOptimalReference(PiecewiseReference):
    """The reference of a time-optimal profile, for all outputs, over the time of the motion.

    Before and after, the values are constant. r'' is continuous except at rests, and accurate to
    5e-4 of its largest value; forces have no derivatives.

    Attributes:
        profile: The profile.
    """

    is_table = True

    profile: TimeProfile
    order: int = field(default=2, init=False)

    @property
    def size(self) -> int:
        return len(self.profile.layout.degrees)

    @cached_property
    def table(self) -> PiecewisePolynomials:
        """The polynomials of r, one row for each output."""
        layout = self.profile.layout
        parts = [(part.piece, part.times, part.b, part.a) for part in self.profile.pieces]
        table = time_table(parts, layout, self.profile.start_time)
        return at_rest_outside(coarser(table, layout.dynamic))

    def pieces(self, degrees: Sequence[int]) -> PiecewisePolynomials:
        return stacked(self.table, degrees)

    def _check(self, degrees: Sequence[int]) -> None:
        pairs = zip(degrees, self.profile.layout.degrees, strict=True)
        for i, (needed, degree) in enumerate(pairs):
            if needed > degree:
                raise ReferenceSignalError(
                    f"row {i} of this TimeOptimalReference has {degree} derivatives, the law needs "
                    f"{needed}; make its profile with the structure of that law"
                )


def _without_last_pause(pieces: Sequence[Piece], layout: DerivativeLayout) -> Sequence[Piece]:
    """The pieces without a pause at the end in which no output changes."""
    values = pieces[-1].values[:, layout.lowest]
    is_still = np.ptp(values, axis=0).max() <= 1e-9 * np.abs(values).max()
    return pieces[:-1] if pieces[-1].is_pause and is_still else pieces


def _pause(piece: Piece) -> ProfilePiece:
    count = piece.times.size
    zero = np.zeros(count)
    passed = piece.times - piece.times[0]
    return ProfilePiece(piece, passed, zero, zero, zero, np.full(count - 1, -1, dtype=np.intp))


def _fastest(rows: LimitRows, piece: Piece, largest_rate: float | None) -> ProfilePiece:
    """The fastest motion along a piece.

    Where the acceleration changes from one interval to the next, as where n of a limit passes
    through zero, the smoothed motion exceeds the limit a little, at a point or in the middle of an
    interval. If by too much, the limit is lowered there.

    Raises:
        ReferenceSignalError: Nothing limits the motion, or it cannot leave a rest.
    """
    largest, which = rows.largest(inf if largest_rate is None else largest_rate)
    factor = np.ones(largest.size)
    before: FloatArray | None = None
    for _ in range(LOWERINGS + 1):
        fastest, before = _settled(rows, piece, largest, factor, before)
        b, a, times = smoothed(piece.distances, fastest.b, fastest.a)
        lines = rows.lines(b)
        accepted = np.append(rows.accepted, EXCESS)
        used = _used(lines, largest, b, a, times)
        if (used <= 1.0 + accepted).all():
            break
        over = np.max(used / (1.0 + accepted / 2.0), axis=1)
        wide = np.pad(np.maximum(over, 1.0), 1, mode="edge")
        factor *= np.maximum(np.maximum(wide[:-2], wide[2:]), wide[1:-1])
    limiting = np.where(fastest.active >= 0, fastest.active, which[1:])
    return ProfilePiece(piece, times, b, a, fastest.highest, limiting)


def _used(
    lines: LinearLimits, largest: FloatArray, b: FloatArray, a: FloatArray, times: FloatArray
) -> FloatArray:
    """The used share of each line, and last of the largest b, at points, shape (N + 1, k + 1).

    At a point it is the largest up to its neighbours, between which a is linear in time, and lines
    are.
    """

    def shares(
        alpha: FloatArray, beta: FloatArray, largest: FloatArray, b: FloatArray, a: FloatArray
    ) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            fast = np.where(largest > 0.0, b / largest, 0.0)
        return np.column_stack([alpha * a[:, None] + beta * b[:, None], fast])

    at_points = shares(lines.alpha, lines.beta, largest, b, a)
    used, width, speed = at_points.copy(), np.diff(times), np.sqrt(b[:-1])
    for x in BETWEEN:
        alpha, beta, most, now = (
            (1.0 - x) * part[:-1] + x * part[1:] for part in (lines.alpha, lines.beta, largest, a)
        )
        fast = np.maximum(speed + x * width * (a[:-1] + now) / 2.0, 0.0)
        between = shares(alpha, beta, most, fast**2, now)
        used[:-1], used[1:] = np.maximum(used[:-1], between), np.maximum(used[1:], between)
    return used


def _settled(
    rows: LimitRows,
    piece: Piece,
    largest: FloatArray,
    factor: FloatArray,
    before: FloatArray | None,
) -> tuple[FastestMotion, FloatArray | None]:
    """The fastest motion with all limits divided by a factor, and the b of their linearization."""
    for number in range(1 if rows.is_linear else PASSES):
        lines = rows.lines(before)
        lowered = LinearLimits(lines.alpha * factor[:, None], lines.beta * factor[:, None])
        fastest = fastest_motion(piece.distances, lowered, largest / factor)
        if not np.isfinite(fastest.b).all():
            raise ReferenceSignalError(
                "nothing limits the motion: give limits of controls, joints or forces"
            )
        moves = fastest.b[1:] + fastest.b[:-1] > 0.0
        if not moves.all():
            stop = float(piece.times[int(np.argmin(moves))])
            raise ReferenceSignalError(
                f"the motion cannot continue from t = {stop:.4g} s of the reference: a control or "
                "force is at its limit there even at rest. Raise that limit, or change the path"
            )
        if before is not None and np.abs(fastest.b - before).max() <= SETTLED * fastest.b.max():
            break
        if not rows.is_linear:
            before = fastest.b if before is None or number < 10 else (fastest.b + before) / 2.0
    return fastest, before
