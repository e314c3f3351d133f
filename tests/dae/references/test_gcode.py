"""Programs in G-code: what they move, and the reference over it."""

import casadi as ca
import numpy as np
import pytest
from runs import some

from drake_dae import GCodeReference, PathLimits, ReferenceRows
from drake_dae.dae.references.gcode.program import read_program
from drake_dae.dae.references.pieces import UNROLLED
from drake_dae.errors import ReferenceSignalError
from drake_dae.systems.control.references import traced_references

LIMITS = PathLimits(0.2, 2.0)
SHARES = np.linspace(0.0, 1.0, 101)

PLATE = """
%
N10 (a plate) g21 G90 G17 ; millimetres
M3 S1000
G0 Z5 X0 Y0
G1 Z-1 F6000
X80
G3 X80 Y80 J40 F4500
G1 X0
G3 X0 Y0 J-40
G0 X0 Y40
G1 X80 F3000
M30
G1 X1000
"""


def moves(text):
    return read_program(text, "a.nc").moves


def test_lines_arcs_feeds_and_the_end():
    program = read_program(PLATE, "a.nc")
    ends = [move.end.tolist() for move in program.moves]
    expected = [[0.08, 0.0], [0.08, 0.08], [0.0, 0.08], [0.0, 0.0], [0.0, 0.04], [0.08, 0.04]]
    np.testing.assert_allclose(ends, expected, atol=1e-15)
    speeds = [move.speed for move in program.moves]
    np.testing.assert_allclose(speeds, [0.1, 0.075, 0.075, 0.075, np.inf, 0.05], rtol=1e-15)
    half = np.pi * 0.04
    lengths = [move.length for move in program.moves]
    np.testing.assert_allclose(lengths, [0.08, half, 0.08, half, 0.04, 0.08], rtol=1e-14)
    assert program.ignored == ("M3", "S", "Z")
    # Each begins where the one before ends.
    for before, after in zip(program.moves, program.moves[1:], strict=False):
        np.testing.assert_array_equal(before.end, after.start)


@pytest.mark.parametrize(
    ("text", "center", "sweep"),
    [
        ("G2 X20 I10", (10, 0), -np.pi),
        ("G3 X20 I10", (10, 0), np.pi),
        ("G3 X10 Y10 J10", (0, 10), np.pi / 2),
        ("G2 X10 Y10 J10", (0, 10), -3 * np.pi / 2),
        ("G3 I10", (10, 0), 2 * np.pi),
        ("G2 X0 Y0 I10", (10, 0), -2 * np.pi),
        # By the radius: below half a turn, or above it where it is negative.
        ("G3 X10 Y10 R10", (0, 10), np.pi / 2),
        ("G3 X10 Y10 R-10", (10, 0), 3 * np.pi / 2),
        ("G2 X10 Y10 R10", (10, 0), -np.pi / 2),
        ("G2 X10 Y10 R-10", (0, 10), -3 * np.pi / 2),
    ],
)
def test_arcs(text, center, sweep):
    (move,) = moves(f"G1 F600 {text}" if text.startswith("G1") else f"F600 {text}")
    np.testing.assert_allclose(move.center, np.array(center) / 1000, atol=1e-15)
    assert move.sweep == pytest.approx(sweep)
    points = move.at(SHARES)
    np.testing.assert_allclose(points[[0, -1]], [move.start, move.end], atol=1e-15)
    np.testing.assert_allclose(
        np.linalg.norm(points - move.center, axis=1), move.radius, rtol=1e-12
    )
    # The directions are those of differences, which are off by a hundredth of half a turn or less.
    for share, pair in ((0.0, points[:2]), (1.0, points[-2:])):
        chord = np.diff(pair, axis=0)[0]
        assert move.direction(share) @ chord / np.linalg.norm(chord) > 0.999


def test_head_of_a_cam_program_moves_nothing():
    head = "%\nO1000 (POCKET)\nG21 G90 G94 G17 G40 G49 G80\nT1 M6\nG43 H1 Z5\nS12000 M3\n"
    (move,) = moves(f"{head}G0 X1 Y0\nG1 Z-1 F200\nG1 X2\nM5\nM30\n%")
    np.testing.assert_allclose([move.start, move.end], [[0.001, 0.0], [0.002, 0.0]], atol=1e-18)


def test_inches_and_increments():
    inch, mm = moves("G20 G91 F60\nG0 X1 Y1\nG1 X1\nG21\nY25.4")
    np.testing.assert_allclose(inch.start, [0.0254, 0.0254], rtol=1e-15)
    np.testing.assert_allclose(inch.end, [0.0508, 0.0254], rtol=1e-15)
    assert inch.speed == pytest.approx(0.0254)
    np.testing.assert_allclose(mm.end, [0.0508, 0.0508], rtol=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("G1 X1", "line 1: G1 before any F"),
        ("F100\nX1", "line 2: coordinates before any G0, G1, G2 or G3"),
        ("G41 D1", "line 1: D is not followed"),
        ("G28", "line 1: G28 is not followed; lines and arcs"),
        ("G18", "G18 is not followed"),
        ("M98 P3", "P is not followed"),
        ("M0", "M0 is not followed"),
        ("G1 X1 X2 F1", "X occurs twice"),
        ("G1 X#1 F1", "'X#1' is not understood"),
        ("G1 X1 F0", "F must be positive, got 0"),
        ("G1 X1 I3 F9", "I, J and R are those of arcs"),
        ("G2 X1 F9", "an arc needs its center by I and J, or its radius R"),
        ("G2 X10 I3 F9", "begins 0.003 m from its center and ends 0.007 m"),
        ("G2 X10 R3 F9", "no arc of radius 0.003 m joins two points 0.01 m apart"),
        ("G2 X10 R9 I3 F9", "either R, or I and J"),
        ("G1 X1e9 F9", "'E9' is not understood|E is not followed"),
        ("G1 X9999999999 F9", "X must be below 1e9, got 9999999999"),
        ("(nothing)", "'a.nc' moves nothing along X or Y"),
        ("G0 X5 Y5", "'a.nc' moves nothing"),
    ],
)
def test_what_is_not_followed_is_refused_with_its_line(text, message):
    with pytest.raises(ReferenceSignalError, match=message):
        moves(text)


@pytest.fixture
def file(tmp_path):
    found = tmp_path / "plate.nc"
    found.write_text(PLATE, encoding="utf-8")
    return str(found)


def samples(reference, degree, count=6001):
    function = reference.derivatives([degree] * reference.size)
    times = np.linspace(0.0, reference.spline.duration, count)
    values = np.array([function(time) for time in times])
    return times, values.reshape(count, reference.size, degree + 1)


@pytest.mark.parametrize("order", some([2, 4, 6]))
@pytest.mark.parametrize("tolerance", [1e-3, 1e-4])
def test_the_path_is_within_the_tolerance_and_the_motion_within_limits(file, tolerance, order):
    """By the distances of 600 points of the path from 6,001 of the motion.

    The motion is nearer than its nearest point, which is at most half of their distance beside.
    """
    reference = GCodeReference(file, LIMITS, tolerance=tolerance, order=order)
    _, values = samples(reference, 2)
    curve = values[:, :, 0]
    points = np.concatenate([move.at(SHARES) for move in reference.program.moves])
    off = np.array([np.linalg.norm(curve - point, axis=1).min() for point in points])
    spacing = np.linalg.norm(np.diff(curve, axis=0), axis=1).max()
    assert np.max(off) <= np.hypot(tolerance, spacing / 2.0)
    assert reference.deviation <= tolerance
    assert reference.deviation > 0.5 * tolerance
    np.testing.assert_allclose(curve[[0, -1]], points[[0, -1]], atol=1e-12)
    speeds, accelerations = (np.linalg.norm(values[:, :, k], axis=1).max() for k in (1, 2))
    assert speeds <= LIMITS.speed * (1.0 + 1e-9)
    assert accelerations <= LIMITS.acceleration * (1.0 + 1e-9)


def test_feeds_are_those_programmed(tmp_path):
    """In the middle of a line of 0.4 m the speed is the feed of 0.12 m/s.

    The corners at both ends use the peak of a B-spline by a normal distribution, within 1 %: by so
    much the whole motion may be slowed.
    """
    file = tmp_path / "line.nc"
    file.write_text("G1 X400 F7200")
    reference = GCodeReference(str(file), LIMITS)
    times, values = samples(reference, 1)
    middle = np.abs(times / times[-1] - 0.5) < 0.2
    np.testing.assert_allclose(values[middle, 0, 1], 0.12, rtol=1e-2)
    assert np.ptp(values[middle, 0, 1]) < 1e-9
    np.testing.assert_allclose(values[:, 1], 0.0, atol=1e-15)
    # The rise from rest to the feed and back takes the rest of the time.
    assert 0.4 / 0.12 < reference.spline.duration < 0.4 / 0.12 + 0.3
    assert np.linalg.norm(samples(reference, 2)[1][:, :, 2], axis=1).max() <= 2.0 * (1.0 + 1e-9)


def test_place_force_and_slower_limits(file):
    reference = GCodeReference(
        file, LIMITS, origin=[0.1, 0.2], along=[0.0, 1.0], up=[-1.0, 0.0], press=[15.0, 5.0]
    )
    assert reference.size == 3
    plain = GCodeReference(file, LIMITS)
    _, values = samples(reference, 0, 501)
    _, own = samples(plain, 0, 501)
    turned = np.column_stack([0.1 - own[:, 1, 0], 0.2 + own[:, 0, 0]])
    np.testing.assert_allclose(values[:, :2, 0], turned, atol=1e-12)
    assert values[:, 2, 0].max() == pytest.approx(15.0)
    assert values[:, 2, 0].min() == pytest.approx(5.0)
    slower = GCodeReference(file, PathLimits(0.2, 2.0, 5.0))
    _, values = samples(slower, 3)
    assert np.linalg.norm(values[:, :, 3], axis=1).max() <= 5.0 * (1.0 + 1e-9)
    assert slower.spline.duration > plain.spline.duration
    assert "Z not followed" in plain.remark
    assert f"takes {plain.spline.duration:.3g} s" in plain.remark


def test_wrong_numbers_and_files(file, tmp_path):
    for given, message in (
        ({"tolerance": 0.0}, "tolerance must be positive"),
        ({"tolerance": 1e-9}, "needs .* points, and 20,000 are the most"),
        ({"along": [1, 0], "up": [2, 0]}, "along and up must be two directions"),
        ({"order": 1}, "order must be from 2 to 12"),
        ({"file": str(tmp_path)}, "cannot read"),
        ({"file": str(tmp_path / "none.nc")}, "No such file"),
    ):
        with pytest.raises(ReferenceSignalError, match=message):
            GCodeReference(**{"file": file, "limits": LIMITS, **given}).derivatives([2, 2])
    beside = GCodeReference("plate.nc", LIMITS).beside(tmp_path)
    assert beside.file == file


def test_an_arc_of_many_short_lines_is_as_fast_as_an_arc(tmp_path):
    """As programs of CAM have them: 400 lines of 0.8 mm on a circle."""
    angles = 2.0 * np.pi * np.arange(1, 401) / 400
    lines = [f"X{50 * np.cos(a) - 50:.4f} Y{50 * np.sin(a):.4f}" for a in angles]
    for name, text in (("lines", "\n".join(lines)), ("arc", "G3 X0 Y0 I-50")):
        (tmp_path / f"{name}.nc").write_text(f"G1 F12000\n{text}\n")
    lines, arc = (
        GCodeReference(str(tmp_path / f"{name}.nc"), PathLimits(0.2, 1.0))
        for name in ("lines", "arc")
    )
    assert max(lines.deviation, arc.deviation) <= 1e-4
    assert 0.7 < lines.spline.duration / arc.spline.duration < 1.3
    _, values = samples(lines, 2, 1001)
    assert np.linalg.norm(values[:, :, 2], axis=1).max() <= 1.0 + 1e-9


@pytest.mark.parametrize("seed", range(12))
def test_a_damaged_program_is_refused_or_followed_within_the_tolerance(seed, tmp_path):
    choice = np.random.default_rng(seed)
    text = list(PLATE)
    for _ in range(choice.integers(1, 5)):
        place, letter = choice.integers(len(text)), choice.choice(list("GXYIJRFMZ()-.0159 \n"))
        text[place : place + choice.integers(2)] = [letter] * choice.integers(2)
    file = tmp_path / "damaged.nc"
    file.write_text("".join(text))
    reference = GCodeReference(str(file), LIMITS)
    try:
        _, values = samples(reference, 2, 51)
    except ReferenceSignalError:
        return
    assert np.isfinite(values).all()
    assert reference.deviation <= 1e-4


def test_its_expression_has_the_same_values(file):
    """One by one with a tolerance of 1 mm, and looked up in a table for more than 200 pieces."""
    time = ca.SX.sym("t")
    for tolerance, has_many in ((1e-4, True), (1e-3, False)):
        whole = GCodeReference(file, LIMITS, tolerance=tolerance)
        assert (whole.spline.spans > UNROLLED) == has_many
        reference = ReferenceRows(whole, (1, 0))
        rows = traced_references([reference], [2, 2], time)
        found = ca.Function("rows", [time], [rows])(1.3).full().ravel()
        np.testing.assert_allclose(found, reference.derivatives([2, 2])(1.3), 1e-11, 1e-13)


def test_a_tight_arc_does_not_slow_the_lines_beside_it(tmp_path):
    """On 5 mm with 2 m/s^2 at most 0.1 m/s are possible; the lines have 0.2 m/s all the same."""
    file = tmp_path / "arc.nc"
    file.write_text("G1 X200 F12000\nG3 X200 Y10 J5\nG1 X0")
    _, values = samples(GCodeReference(str(file), LIMITS), 2)
    speeds, accelerations = (np.linalg.norm(values[:, :, k], axis=1) for k in (1, 2))
    assert speeds.max() > 0.98 * 0.2
    assert speeds[values[:, 0, 0] > 0.203].max() < 0.1
    assert accelerations.max() <= 2.0 * (1.0 + 1e-9)


@pytest.mark.parametrize(("column", "factor"), [("feed", 1.0), ("speed", 1.0 / 60.0)])
def test_points_with_speeds_are_the_same_lines_as_a_program(column, factor, tmp_path):
    """In mm, feeds in mm/min as F is, speeds in mm/s; a point that repeats is no move."""
    corners = [(0, 0, 1), (80, 0, 6000), (80, 0, 10), (80, 60, 4500), (10, 20, 3000)]
    rows = [f"{x};{y};{factor * feed}" for x, y, feed in corners]
    (tmp_path / "path.csv").write_text("\n".join([f"x;y;{column}", *rows]))
    lines = [f"G1 X{x} Y{y} F{feed}" for x, y, feed in corners]
    (tmp_path / "path.nc").write_text("\n".join(lines))
    force = {"press": [15.0, 5.0]}
    points = GCodeReference(str(tmp_path / "path.csv"), LIMITS, **force)
    program = GCodeReference(str(tmp_path / "path.nc"), LIMITS, **force)
    np.testing.assert_allclose(points.spline.points, program.spline.points, atol=1e-12)
    assert points.spline.step == pytest.approx(program.spline.step, rel=1e-12)
    assert points.deviation <= points.tolerance


def test_points_without_speeds_go_at_the_limit_and_press_all_the_way(tmp_path):
    (tmp_path / "path.csv").write_text("x,y\n0,0\n400,0\n")
    reference = GCodeReference(str(tmp_path / "path.csv"), LIMITS, press=[15.0, 5.0])
    times, values = samples(reference, 1)
    middle = np.abs(times / times[-1] - 0.5) < 0.1
    np.testing.assert_allclose(values[middle, 0, 1], LIMITS.speed, rtol=1e-2)
    np.testing.assert_allclose(values[:, 2, 0], 15.0, atol=1e-9)


def test_further_columns_are_followed_along_the_path(tmp_path):
    """A column that is linear in x and y stays so, since the spline is linear: round-off alone."""
    rows = [(0, 0), (80, 0), (80, 0), (80, 60), (10, 20)]
    lines = [f"{x},{y},{0.1 + 1e-3 * x - 2e-3 * y},{x / 100}" for x, y in rows]
    (tmp_path / "path.csv").write_text("\n".join(["x,y,nx,ny", *lines]))
    reference = GCodeReference(
        str(tmp_path / "path.csv"), LIMITS, press=[15.0, 5.0], columns=["nx", "ny"]
    )
    _, values = samples(reference, 1)
    assert values.shape[1] == 5
    x, y, force, nx, ny = np.moveaxis(values, 1, 0)
    np.testing.assert_allclose(nx[:, 0], 0.1 + x[:, 0] - 2.0 * y[:, 0], atol=1e-12)
    np.testing.assert_allclose(ny, 10.0 * x, atol=1e-11)
    np.testing.assert_allclose(force[:, 0], 15.0, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,nx\n1,2,0\n1,2,1\n1,3,1", "row 3: nx change while x and y stay"),
        ("x,y\n1,2\n1,3", "has no column nx, but x, y"),
        ("G1 X1 F100", "is a program and has no columns nx"),
    ],
)
def test_columns_that_cannot_be_followed_are_refused(text, message, tmp_path):
    file = tmp_path / ("path.csv" if "," in text else "path.nc")
    file.write_text(text)
    with pytest.raises(ReferenceSignalError, match=message):
        _ = GCodeReference(str(file), LIMITS, columns=["nx"]).spline


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has the columns x and y in mm, .* got none"),
        ("x,z\n1,2\n3,4", "has the columns x and y in mm, .* got x, z"),
        ("x,y,speed,feed\n1,2,3,4\n1,3,3,4", "speed in mm/s or feed in mm/min"),
        ("x,x,y\n1,2,3\n1,3,3", "got x, x, y"),
        ("x,y,nx,ny,nz\n1,2,0,0,1\n1,3,0,0,1", "nx, ny, nz would not be followed"),
        ("x,y,speed\n1,2,3\n1,3,0", "row 3: speed must be positive, got 0"),
        ("x,y\n1,2\n1,2", "moves nothing"),
        ("x,y\n1,2", "has 1 rows of numbers, 2 are needed"),
        ("x,y\n1,2\n1,wide", "row 3, y: expected a number, got 'wide'"),
    ],
)
def test_points_that_are_no_path_are_refused(text, message, tmp_path):
    (tmp_path / "path.csv").write_text(text)
    with pytest.raises(ReferenceSignalError, match=message):
        _ = GCodeReference(str(tmp_path / "path.csv"), LIMITS).spline
