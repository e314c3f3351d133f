"""Programs in G-code, read into moves in a plane."""

import re
from dataclasses import dataclass, field
from math import inf, tau

import numpy as np

from drake_dae.arrays import FloatArray
from drake_dae.errors import ReferenceSignalError

INCH, MILLIMETRE, MINUTE = 0.0254, 1e-3, 60.0

WITHOUT_EFFECT = frozenset({17.0, 40.0, 43.0, 49.0, 54.0, 80.0, 91.1, 94.0})
"""The G codes that select what is the default here: the plane XY, no compensation, centers from the
start of an arc, feeds per minute; and an offset of the tool's length, which is along Z."""

NOT_FOLLOWED = frozenset({3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0})
"""The M codes that move nothing: spindle, tool change and coolant."""

ENDS = frozenset({2.0, 30.0})
"""The M codes that end a program."""

RADII = 2e-3
"""The allowed relative difference of the radii at both ends of an arc, since programs round."""

_WORD = re.compile(r"([A-Z])\s*([-+]?(?:\d+\.?\d*|\.\d+))")


@dataclass(frozen=True, eq=False)
class GCodeMove:
    """A straight move, or an arc, in m.

    Attributes:
        start, end: Its ends, shape (2,).
        speed: The programmed speed in m/s; infinite for G0.
        center: The center of an arc, shape (2,); None for a straight move.
        sweep: The angle of an arc in rad, positive for counterclockwise.
    """

    start: FloatArray
    end: FloatArray
    speed: float
    center: FloatArray | None = None
    sweep: float = 0.0

    @property
    def length(self) -> float:
        """The length of the move in m; that of an arc is computed with its mean radius."""
        if self.center is None:
            return float(np.linalg.norm(self.end - self.start))
        return abs(self.sweep) * self.radius

    @property
    def _radii(self) -> FloatArray:
        ends = np.array([self.start, self.end])
        return np.asarray(np.linalg.norm(ends - self.center, axis=1))

    @property
    def radius(self) -> float:
        """The mean radius of an arc in m; infinite for a straight move."""
        return inf if self.center is None else float(np.mean(self._radii))

    def direction(self, share: float) -> FloatArray:
        """Returns the unit tangent at a fraction of the length of the move, shape (2,)."""
        along = self.end - self.start
        if self.center is not None:
            x, y = (self.at(np.array([share])) - self.center)[0] * np.sign(self.sweep)
            along = np.array([-y, x])
        return np.asarray(along / np.linalg.norm(along))

    def at(self, shares: FloatArray) -> FloatArray:
        """Returns the points at fractions of the length of the move, shape (n, 2)."""
        if self.center is None:
            return self.start + shares[:, None] * (self.end - self.start)
        first = self.start - self.center
        angles = np.arctan2(first[1], first[0]) + self.sweep * shares
        # Programs round the ends, so that the two radii differ by a little.
        radii = (1.0 - shares) * self._radii[0] + shares * self._radii[1]
        circle = np.column_stack([np.cos(angles), np.sin(angles)])
        return np.asarray(self.center + radii[:, None] * circle)


@dataclass(frozen=True, eq=False)
class GCodeProgram:
    """The moves of a program.

    Attributes:
        moves: The moves that have a length, each from where the one before ends.
        ignored: The words without a move, such as "M3" and "Z", in order.
        further: The values of k further outputs at the start and at the ends of all moves, shape
            (moves + 1, k).
    """

    moves: tuple[GCodeMove, ...]
    ignored: tuple[str, ...]
    further: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))


@dataclass
class _Machine:
    """The modal state of a machine that reads a program."""

    unit: float = MILLIMETRE
    is_absolute: bool = True
    mode: float | None = None
    speed: float | None = None
    place: FloatArray = field(default_factory=lambda: np.zeros(2))
    has_moved: bool = False
    ignored: dict[str, None] = field(default_factory=dict)


def read_program(text: str, name: str) -> GCodeProgram:
    """Reads the moves of a program.

    It follows G0, G1, G2 and G3 with X and Y, with I and J or R, F per minute, G20 and G21, G90 and
    G91, and ends at M2, M30 or the end of the text. Comments stand in parentheses or after a
    semicolon. The program begins where its first G0 leads; if that is no G0, at X0 Y0.

    Args:
        text: The program.
        name: The name of the program in messages.

    Raises:
        ReferenceSignalError: A line is not understood, or would not be followed, or nothing moves.
    """
    machine, moves = _Machine(), list[GCodeMove]()
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            goes_on = _follow(machine, line, moves)
        except ReferenceSignalError as error:
            raise ReferenceSignalError(f"'{name}', line {number}: {error}") from None
        if not goes_on:
            break
    if not moves:
        raise ReferenceSignalError(f"'{name}' moves nothing along X or Y")
    return GCodeProgram(tuple(moves), tuple(machine.ignored))


def _follow(machine: _Machine, line: str, moves: list[GCodeMove]) -> bool:
    """Follows a line, and returns whether the program continues after it."""
    codes, values = _words(line)
    ends = False
    for letter, code in codes:
        if letter == "M":
            if code not in NOT_FOLLOWED | ENDS:
                raise ReferenceSignalError(f"M{code:g} is not followed")
            ends |= code in ENDS
            if code in NOT_FOLLOWED:
                machine.ignored[f"M{code:g}"] = None
        elif code in (20.0, 21.0):
            machine.unit = INCH if code == 20.0 else MILLIMETRE
        elif code in (90.0, 91.0):
            machine.is_absolute = code == 90.0
        elif code in (0.0, 1.0, 2.0, 3.0):
            machine.mode = code
        elif code not in WITHOUT_EFFECT:
            raise ReferenceSignalError(
                f"G{code:g} is not followed; lines and arcs in the plane are: G0, G1, G2, G3"
            )
    for letter in "HOSTZ":
        if letter in values:
            machine.ignored[letter] = None
    if "F" in values:
        if not values["F"] > 0.0:
            raise ReferenceSignalError(f"F must be positive, got {values['F']:g}")
        machine.speed = values["F"] * machine.unit / MINUTE
    if {"X", "Y"} & values.keys() or {"I", "J", "R"} & values.keys():
        _move(machine, values, moves)
    return not ends


def _words(line: str) -> tuple[list[tuple[str, float]], dict[str, float]]:
    """The G and M codes of a line in order, and the numbers of its other letters."""
    plain = re.sub(r"\([^()]*\)", " ", line).partition(";")[0].upper().replace("%", " ")
    rest = _WORD.sub(" ", plain).strip()
    if rest:
        raise ReferenceSignalError(f"'{rest[:40]}' is not understood")
    codes, values = list[tuple[str, float]](), dict[str, float]()
    for letter, digits in _WORD.findall(plain):
        value = float(digits)
        if letter in "GM":
            codes.append((letter, value))
        elif letter not in "XYZIJRFSTNHO":
            raise ReferenceSignalError(f"{letter} is not followed: the path lies in X and Y")
        elif letter in values:
            raise ReferenceSignalError(f"{letter} occurs twice")
        elif not abs(value) < 1e9:
            raise ReferenceSignalError(f"{letter} must be below 1e9, got {digits[:40]}")
        else:
            values[letter] = value
    return codes, values


def _move(machine: _Machine, values: dict[str, float], moves: list[GCodeMove]) -> None:
    """Follows the coordinates of a line."""
    if machine.mode is None:
        raise ReferenceSignalError("coordinates before any G0, G1, G2 or G3")
    start, end = machine.place, machine.place.copy()
    for axis, letter in enumerate("XY"):
        if letter in values:
            length = values[letter] * machine.unit
            end[axis] = length if machine.is_absolute else start[axis] + length
    is_arc, is_first = machine.mode in (2.0, 3.0), not machine.has_moved
    machine.place, machine.has_moved = end, True
    if machine.mode == 0.0 and is_first:
        return  # Where the machine was before is not known.
    speed = inf if machine.mode == 0.0 else machine.speed
    if speed is None:
        raise ReferenceSignalError(f"G{machine.mode:g} before any F")
    if not is_arc:
        if {"I", "J", "R"} & values.keys():
            raise ReferenceSignalError("I, J and R are those of arcs, G2 and G3")
        if np.any(start != end):
            moves.append(GCodeMove(start, end, speed))
        return
    center = _center(machine, values, start, end)
    first, last = (np.arctan2(*(place - center)[::-1]) for place in (start, end))
    sweep = (last - first) % tau or tau
    if machine.mode == 2.0:
        sweep = sweep - tau or -tau
    moves.append(GCodeMove(start, end, speed, center, float(sweep)))


def _center(
    machine: _Machine, values: dict[str, float], start: FloatArray, end: FloatArray
) -> FloatArray:
    """The center of an arc."""
    offsets = [values.get(letter, 0.0) * machine.unit for letter in "IJ"]
    if "R" not in values:
        if not any(offsets):
            raise ReferenceSignalError("an arc needs its center by I and J, or its radius R")
        center = start + np.array(offsets)
        radii = [float(np.linalg.norm(place - center)) for place in (start, end)]
        if abs(radii[0] - radii[1]) > RADII * max(radii):
            raise ReferenceSignalError(
                f"the arc begins {radii[0]:.6g} m from its center and ends {radii[1]:.6g} m from it"
            )
        return np.asarray(center)
    if any(offsets):
        raise ReferenceSignalError("an arc has either R, or I and J")
    radius, chord = values["R"] * machine.unit, end - start
    half = float(np.linalg.norm(chord)) / 2.0
    if not 0.0 < half <= abs(radius) * (1.0 + RADII):
        raise ReferenceSignalError(
            f"no arc of radius {abs(radius):.6g} m joins two points {2.0 * half:.6g} m apart"
        )
    # A positive R is the arc below half a turn; clockwise its center lies on the right.
    height = np.sqrt(max(radius**2 - half**2, 0.0)) * (1.0 if radius > 0.0 else -1.0)
    side = np.array([chord[1], -chord[0]]) / (2.0 * half)
    turn = 1.0 if machine.mode == 2.0 else -1.0
    return np.asarray((start + end) / 2.0 + turn * height * side)
