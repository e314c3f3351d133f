"""Limits along a curve as lines alpha a + beta b <= 1, with what each of them limits."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.dae.system.layout import Indices
from drake_dae.dae.timing.along import AlongCurve
from drake_dae.dae.timing.curve import Piece
from drake_dae.dae.timing.reachable import LinearLimits
from drake_dae.dae.timing.tool_limits import ToolLimits
from drake_dae.errors import ReferenceSignalError

LINEAR = 1e-7
"""Signals count as linear in (a, b) up to this share of their size."""

SLOW = 0.01
"""The slowest speed at which friction is evaluated, as a share of the largest."""

TANGENT = 0.9
"""The largest part of friction that grows with the speed, as a share of the room in slow motion,
for which its tangent is used: the tangent takes half of it where nothing moves."""

EXCESS = 0.02
"""The accepted excess over a limit of a drive or a path at a few points, as a fraction of it: less
than the part of the limits that is reserved for the feedback."""

EXCESS_OF_FORCE = 5e-4
"""The same for contact forces and friction cones, of which nothing is reserved."""

CHECKED = 20
"""Every n-th point is tested, with this n."""


@dataclass(frozen=True)
class LimitRow:
    """The signal that a row limits.

    Attributes:
        name: The signal.
        side: "least" or "largest".
        unit: The signal's unit.
    """

    name: str
    side: str
    unit: str

    @property
    def text(self) -> str:
        """The limit as text."""
        return f"{self.side} {self.name}".strip()


@dataclass(frozen=True, eq=False)
class LimitRows:
    """The limited signals along a piece.

    Attributes:
        along: The feedforward along curves.
        piece: The piece.
        parameters: Values of all parameters.
        at_rest: x at rest, shape (N + 1, n).
        moving: dx/dw at rest, shape (N + 1, n).
        still: c, the limited signals at rest, shape (N + 1, k).
        by_a: n, shape (N + 1, k).
        by_b: m if they are linear, shape (N + 1, k).
        scale: The speed s' at which signals are compared, and the square root of a.
        is_linear: Whether signals are m b + n a + c.
        tools: The limits of paths.
    """

    along: AlongCurve
    piece: Piece
    parameters: FloatArray
    at_rest: FloatArray
    moving: FloatArray
    still: FloatArray
    by_a: FloatArray
    by_b: FloatArray
    scale: float
    is_linear: bool
    tools: Sequence[ToolLimits]

    @property
    def names(self) -> tuple[LimitRow, ...]:
        """The possible causes of a limit: all lines, then those that limit only b."""
        limited = self.along.limited
        pairs = [*zip(limited.signals, limited.low, limited.high, strict=True)]
        rows = [LimitRow(s.name, "largest", s.unit) for s, _, high in pairs if np.isfinite(high)]
        rows += [LimitRow(s.name, "least", s.unit) for s, low, _ in pairs if np.isfinite(low)]
        rows += [LimitRow("acceleration of a path", "largest", "")] * sum(
            tool.of_a.shape[1] for tool in self.tools
        )
        rows += [LimitRow(s.name, "largest", s.unit) for s in limited.state_signals]
        rows += [LimitRow("speed of a path", "largest", "")] * len(self.tools)
        return (*rows, LimitRow("rate of the reference's time", "largest", ""))

    def lines(self, before: FloatArray | None) -> LinearLimits:
        """Returns the rows; where signals are not linear, those about a previous profile.

        Args:
            before: b of the profile before, shape (N + 1,), at which lines are exact; None for the
            first.
        """
        by_a, by_b, still = self.by_a, self.by_b, self.still
        if not self.is_linear:
            now = np.full(len(still), self.scale**2) if before is None else before
            by_a, by_b, still = self._about(np.sqrt(now))
        low, high = self.along.limited.low, self.along.limited.high
        up, down = np.isfinite(high), np.isfinite(low)
        above, below = high[up] - still[:, up], still[:, down] - low[down]
        _check_friction(self, above, below)
        tools = self.tools
        none = np.zeros((len(still), 1))  # A line that limits nothing, after all others.
        of_a = [by_a[:, up] / above, -by_a[:, down] / below, *(t.of_a for t in tools), none]
        of_b = [by_b[:, up] / above, -by_b[:, down] / below, *(t.of_b for t in tools), none]
        return LinearLimits(np.hstack(of_a), np.hstack(of_b))

    def _about(self, speed: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """n, m and c of signals with friction, exact at given speeds; rest counts as slow motion.

        The part of friction that grows with the speed, d sqrt(b), is replaced by its tangent, or
        where that leaves too little room by the line from rest, on which rest is possible.
        """
        slow = np.full(len(speed), SLOW * speed.max())
        speed, zero = np.maximum(speed, slow), np.zeros(len(speed))
        values = self._values(speed, zero)
        by_a = (self._values(speed, zero + self.scale**2) - values) / self.scale**2
        still = self._values(slow, zero) - slow[:, None] ** 2 * self.by_b
        grown = values - speed[:, None] ** 2 * self.by_b - still
        limited = self.along.limited
        room = np.where(grown > 0.0, limited.high - still, still - limited.low)
        share = np.where(np.abs(grown) < room * TANGENT, 0.5, 1.0)
        return by_a, self.by_b + share * grown / speed[:, None] ** 2, still + (1.0 - share) * grown

    @property
    def accepted(self) -> FloatArray:
        """The accepted excess over each of the lines, shape (k,)."""
        limited = self.along.limited
        are_forces = [limited.are_forces[np.isfinite(b)] for b in (limited.high, limited.low)]
        other = sum(tool.of_a.shape[1] for tool in self.tools) + 1
        columns = np.concatenate([*are_forces, np.zeros(other, dtype=bool)])
        return np.where(columns, EXCESS_OF_FORCE, EXCESS)

    def largest(self, rate: float) -> tuple[FloatArray, Indices]:
        """Returns the largest b at each point, and its cause as an index into `names`.

        Args:
            rate: The largest rate of the reference's time.
        """
        limited = self.along.limited
        at_rest = self.along.limited_states(self.at_rest)
        slope = self.along.limited_states(self.moving)
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(slope > 0.0, limited.state_high - at_rest, limited.state_low - at_rest)
            room = room / slope
        room = np.where(slope == 0.0, np.inf, room)
        of_rate = rate * self.piece.speeds if np.isfinite(rate) else np.full(len(at_rest), np.inf)
        columns = [room**2, *(tool.largest[:, None] for tool in self.tools), of_rate[:, None] ** 2]
        together = np.hstack(columns)
        least = together.argmin(axis=1)
        first = len(self.names) - together.shape[1]
        return together[np.arange(len(at_rest)), least], least + first

    def _values(self, speed: FloatArray, a: FloatArray) -> FloatArray:
        """The limited signals at given speeds and accelerations, shape (N + 1, k)."""
        rows = self.along.reference(self.piece, speed, a)
        return self.along.values(self.at_rest + speed[:, None] * self.moving, rows, self.parameters)


def rows_along(
    along: AlongCurve,
    piece: Piece,
    guess: FloatArray,
    parameters: FloatArray,
    tools: Sequence[ToolLimits],
) -> LimitRows:
    """Computes the limited signals along a piece.

    Args:
        along: The feedforward along curves.
        piece: The piece; no pause.
        guess: A state near its begin, shape (n,).
        parameters: Values of all parameters.
        tools: The limits of paths.

    Raises:
        ReferenceSignalError: A rest on the piece is not within the limits, or a state has no
            value there.
    """
    at_rest, moving = along.states_at_rest(piece, guess, parameters)
    speed = piece.distances[-1] / (piece.times[-1] - piece.times[0])
    zero = np.zeros(piece.times.size)

    def values(w: float, a: float, every: int = 1) -> FloatArray:
        rows = along.reference(piece, zero + w, zero + a)[::every]
        return along.values((at_rest + w * moving)[::every], rows, parameters)

    still = values(0.0, 0.0)
    _check_rest(along, piece, at_rest, still)
    by_a = (values(0.0, speed**2) - still) / speed**2
    # Without friction, which is constant or grows with the speed.
    once, double, triple = (values(k * speed, 0.0) for k in (1.0, 2.0, 3.0))
    by_b = (triple - 2.0 * double + once) / (2.0 * speed**2)
    twice = values(2.0 * speed, speed**2, CHECKED)
    expected = still + speed**2 * (4.0 * by_b + by_a)
    off = np.abs(twice - expected[::CHECKED]).max(axis=0, initial=0.0)
    bounds = np.abs([along.limited.low, along.limited.high])
    bounds[~np.isfinite(bounds)] = 0.0
    size = np.maximum(np.abs(twice).max(axis=0, initial=0.0), bounds.max(axis=0, initial=0.0))
    is_linear = bool((off <= LINEAR * size).all())
    return LimitRows(
        along, piece, parameters, at_rest, moving, still, by_a, by_b, speed, is_linear, tools
    )


def checked_pause(
    along: AlongCurve, piece: Piece, guess: FloatArray, parameters: FloatArray
) -> FloatArray:
    """Checks the limits in a pause, where forces go on, and returns the state at its end.

    Arguments are as for `rows_along`.

    Raises:
        ReferenceSignalError: The pause is not within the limits.
    """
    at_rest, _ = along.states_at_rest(piece, guess, parameters)
    zero = np.zeros(piece.times.size)
    rows = along.reference(piece, zero, zero)
    _check_rest(along, piece, at_rest, along.values(at_rest, rows, parameters))
    return np.asarray(at_rest[-1])


def _check_friction(rows: LimitRows, above: FloatArray, below: FloatArray) -> None:
    """Checks that friction in slow motion is within the limits.

    Raises:
        ReferenceSignalError: A signal exceeds a limit; the message has the signal and the time.
    """
    room = np.hstack([above, below])
    if not room.size or room.min() > 0.0:
        return
    point, column = np.unravel_index(int(room.argmin()), room.shape)
    row = rows.names[int(column)]
    raise ReferenceSignalError(
        f"in slow motion at t = {rows.piece.times[point]:.4g} s of the reference {row.name} is "
        f"{-room.min():.4g} {row.unit} beyond its limit, with friction: no motion along this path "
        "is within the limits. Choose another path, posture or force, or larger limits"
    )


def _check_rest(along: AlongCurve, piece: Piece, at_rest: FloatArray, still: FloatArray) -> None:
    """Checks that the system is within the limits at rest on a piece.

    Raises:
        ReferenceSignalError: A signal exceeds a limit; the message has signal, time and excess.
    """
    limited = along.limited
    both = (
        (limited.signals, limited.low, limited.high, still),
        (
            limited.state_signals,
            limited.state_low,
            limited.state_high,
            along.limited_states(at_rest),
        ),
    )
    for signals, low, high, values in both:
        if not np.isfinite(values).all():
            time = piece.times[int(np.argmin(np.isfinite(values).all(axis=1)))]
            raise ReferenceSignalError(
                f"the path has no control at t = {time:.4g} s of the reference: it leads through "
                "a singular configuration"
            )
        room = np.minimum(high - values, values - low)
        if not room.size or room.min() > 0.0:
            continue
        size = np.minimum(np.abs(high), np.abs(low))
        share = room / np.where((size > 0.0) & np.isfinite(size), size, 1.0)
        point, column = np.unravel_index(int(share.argmin()), room.shape)
        value, signal = values[point, column], signals[column]
        is_high = high[column] - value <= 0.0
        bound = high[column] if is_high else low[column]
        reached = "may be at most" if is_high else "must be at least"
        raise ReferenceSignalError(
            f"at rest at t = {piece.times[point]:.4g} s of the reference {signal.name} is "
            f"{value:.4g} {signal.unit}, and {reached} {bound:.4g} {signal.unit}: no motion along "
            "this path is within the limits. Choose another path, posture or force, or larger "
            "limits"
        )
