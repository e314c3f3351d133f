"""Surfaces from formulas and from data: what they are, and how far they are off it."""

import casadi as ca
import numpy as np
import pytest
from meshes import obj_of_grid, stl_of

from drake_dae import Cylinder, ImplicitSurface, MeasuredSurface, PointOnSurface, Sphere
from drake_dae.errors import ModelError
from drake_dae.robots import LinkExpressions, tangents
from drake_dae.trace.expressions import find_flaw
from drake_dae.trace.functions import TracedFunction

X, Y = np.linspace(-0.2, 0.2, 33), np.linspace(-0.15, 0.15, 25)
A, B = 0.02, 15.0
WAVES = A * np.sin(B * X) + 0.0 * Y[:, None]


def derivatives(surface, order):
    """The distance and its derivatives by x, up to an order."""
    p = ca.SX.sym("p", 3)
    rows = [surface.distance(p)]
    for _ in range(order):
        rows.append(ca.jacobian(rows[-1], p)[0])
    return TracedFunction("rows", {"p": p}, {"rows": ca.vertcat(*rows)})


# Formulas.


@pytest.mark.parametrize("x", [1.2, -1.2])
def test_a_formula_of_one_length_is_smooth_where_its_gradient_is_not_zero(x):
    """|F'| of one variable is the root of a square, of which CasADi makes fabs: with F = 1.44 - x^2

    phi = (1.44 / |x| - |x|) / 2, whose second derivative is 1.44 / |x|^3.
    """
    p = ca.SX.sym("p", 3)
    found = ImplicitSurface("1.44 - x**2").distance(p)
    assert not find_flaw(found, p, ca.SX(0, 1))
    wanted = np.diag([1.44 / abs(x) ** 3, 0.0, 0.0])
    hessian = ca.Function("hessian", [p], [ca.hessian(found, p)[0]])
    np.testing.assert_allclose(np.array(hessian([x, 0.0, 0.0])), wanted, atol=1e-12)


@pytest.mark.parametrize(
    ("formula", "numbers", "built_in"),
    [
        ("sqrt(x**2 + y**2 + z**2) - r", {"r": 0.7}, Sphere((0, 0, 0), 0.7)),
        ("r - sqrt(x**2 + y**2)", {"r": 0.7}, Cylinder((0, 0, 0), (0, 0, 1), 0.7, inside=True)),
    ],
)
def test_a_formula_is_the_built_in_surface(formula, numbers, built_in):
    """The same function, divided by a gradient that is one: all derivatives, to round-off."""
    own = derivatives(ImplicitSurface(formula, parameters=numbers), 4)
    known = derivatives(built_in, 4)
    for p in np.random.default_rng(0).uniform(0.3, 0.8, (10, 3)):
        np.testing.assert_allclose(own(p)[0], known(p)[0], rtol=1e-12, atol=1e-12)


def test_numbers_of_a_formula_are_parameters_of_the_constraint():
    surface = ImplicitSurface("sqrt(x**2 + y**2 + z**2) - r", parameters={"r": 0.5})
    first, second = (PointOnSurface("tool", surface, name=name) for name in ("a", "b"))
    assert [p.name for p in first.parameters] == ["a.position", "a.r"]
    assert first.parameters[1].value == 0.5
    # One surface of two constraints has a number for each.
    links = LinkExpressions(
        ca.SX.sym("q", 3), ca.SX.sym("v", 3), ca.SX.eye(3), ca.SX(3, 1), {"tool": ca.SX.sym("p", 3)}
    )
    radius = first.parameters[1].symbol
    assert ca.depends_on(first.residual(links), radius)
    assert not ca.depends_on(second.residual(links), radius)
    # Drawn with the number that it has now.
    mesh = first.surface_at(np.array([0, 0, 0, 0.9])).picture([0.0, 0.0, 0.9], 0.4).form
    vertices = np.array([mesh.vertex(i) for i in range(mesh.num_vertices())])
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.9, atol=1e-12)


def test_a_function_may_take_parameters():
    surface = ImplicitSurface(lambda p, n: p[2] - n.a * p[0] ** 2, parameters={"a": 2.0})
    formula = ImplicitSurface("z - a*x**2", parameters={"a": 2.0})
    p = np.array([0.1, 0.2, 0.3])
    np.testing.assert_array_equal(derivatives(surface, 2)(p)[0], derivatives(formula, 2)(p)[0])


@pytest.mark.parametrize(
    ("formula", "numbers", "words"),
    [
        ("z - q*x", {}, "'q'"),
        ("z - sine(x)", {}, "sine"),
        ("z - min(x, 1)", {}, "'min(x, 1)'"),
        ("z - x^2", {}, "'z - x^2'"),
        ("atan2(x)", {}, "'atan2(x)'"),
        ("z - (x", {}, "z - (x"),
        ("__import__('os').system('ls')", {}, "__import__"),
        ("x.__class__", {}, "'x.__class__'"),
        ("z - 1e999", {}, "1e999"),
        ("z" + " + z" * 3000, {}, "long"),
        ("(" * 900 + "z" + ")" * 900, {}, "formula"),
        ("z - \0", {}, ""),
        ("1 + a", {"a": 1.0}, "x, y"),
        ("z - x", {"x": 1.0}, "'x'"),
        ("z - a", {"a b": 1.0}, "'a b'"),
    ],
)
def test_formulas_that_are_none(formula, numbers, words):
    with pytest.raises(ModelError) as caught:
        ImplicitSurface(formula, parameters=numbers)
    assert words in str(caught.value)
    assert len(str(caught.value)) < 500


# Data.


def test_a_height_map_of_a_wave_is_the_wave():
    """At its points to 1e-8 m, between them at the edge to 1e-7 m.

    Each derivative loses a factor of 1 / 0.025 m, the width of the bells, against one of b: four of
    them, as springs need, are right to 3e-3 of a b^4.
    """
    surface = MeasuredSurface((0.4, 0.3), WAVES)
    assert surface.fit.largest < 1e-8
    x, y = np.linspace(-0.2, 0.2, 101), np.linspace(-0.15, 0.15, 41)
    np.testing.assert_allclose(
        surface.fit.heights(x, y), A * np.sin(B * x) + 0 * y[:, None], rtol=0, atol=1e-7
    )
    own = derivatives(surface, 4)
    exact = derivatives(ImplicitSurface(lambda p: p[2] - A * ca.sin(B * p[0])), 4)
    for p in np.random.default_rng(0).uniform(-0.15, 0.15, (20, 3)):
        found, wanted = (
            own([*p[:2], A * np.sin(B * p[0])])[0],
            exact([*p[:2], A * np.sin(B * p[0])])[0],
        )
        scale = A * B ** np.arange(5)
        np.testing.assert_array_less(np.abs(found - wanted) / scale, [1e-6, 2e-6, 2e-5, 3e-4, 3e-3])


def test_the_error_of_smoothing_is_reported():
    """Measured again from the distances of the data's own points, and a tenth of it is noise."""
    noise = 1e-4 * np.random.default_rng(0).normal(size=WAVES.shape)
    surface = MeasuredSurface((0.4, 0.3), WAVES + noise, resolution=0.05)
    off = surface.fit.heights(X, Y) - WAVES - noise
    assert surface.fit.largest == pytest.approx(np.max(np.abs(off)), rel=1e-12)
    assert f"{1e3 * surface.fit.largest:.2g} mm" in surface.remark
    assert 0.5e-4 < np.sqrt(np.mean(off**2)) < 1.2e-4
    # It is nearer to the wave than the noise is.
    assert np.sqrt(np.mean((surface.fit.heights(X, Y) - WAVES) ** 2)) < 0.7e-4


@pytest.mark.parametrize("rough", [np.abs(X - 0.13), 1.0 * (X > 0.17), np.sin(300 * X)])
def test_beyond_its_edges_a_map_is_calm(rough):
    """Whatever the data: at most 1.5 times their range off the plane, as far out as one likes."""
    heights = 0.05 * rough + 0.0 * Y[:, None]
    fit = MeasuredSurface((0.4, 0.3), heights).fit
    far = np.linspace(-1.0, 1.0, 401)
    flat = fit.plane[0] + fit.plane[1] * far + fit.plane[2] * far[:, None]
    assert np.max(np.abs(fit.heights(far, far) - flat)) < 1.6 * np.ptp(heights)
    assert np.max(np.abs(fit.heights(far[:5], far[:5]) - flat[:5, :5])) < 1e-9


@pytest.mark.parametrize(
    "data",
    [
        WAVES,
        0.04 * (X > 0.03) + 0.0 * Y[:, None],
        WAVES + 1e-4 * np.random.default_rng(1).normal(size=WAVES.shape),
    ],
    ids=["wave", "step", "noisy"],
)
@pytest.mark.parametrize("resolution", [None, 0.1])
def test_a_fit_does_not_multiply_the_round_off_of_its_data(data, resolution):
    """Heights that differ in their last digit, some 1e-17 m, give surfaces that do.

    At the data, where a fit is a projection; 100 of them are the round-off of some 20 bells.
    """
    random, largest = np.random.default_rng(0), np.max(np.abs(data))
    fitted = MeasuredSurface((0.4, 0.3), data, resolution=resolution).fit
    for _ in range(3):
        last_digit = np.finfo(float).eps * random.choice([-1.0, 0.0, 1.0], data.shape)
        again = MeasuredSurface((0.4, 0.3), data * (1.0 + last_digit), resolution=resolution).fit
        off = again.heights(X, Y) - fitted.heights(X, Y)
        assert np.max(np.abs(off)) < 100 * np.finfo(float).eps * largest


def test_files_hold_what_the_table_does(tmp_path):
    tall = 0.05 + 0.02 * np.sin(10 * X) * np.cos(12 * Y)[:, None] + 0.1 * Y[:, None]
    table = MeasuredSurface((0.4, 0.3), tall)
    np.savetxt(tmp_path / "a.csv", tall, delimiter=",")
    np.savetxt(tmp_path / "b.csv", 1e3 * tall, delimiter="; ")
    wanted = table.fit.heights(X, Y)
    for name, scale in (("a.csv", 1), ("b.csv", 1e-3)):
        own = MeasuredSurface((0.4, 0.3), file=tmp_path / name, scale=float(scale))
        np.testing.assert_allclose(own.fit.heights(X, Y), wanted, rtol=0, atol=1e-12)
        assert name in own.remark
    np.savetxt(tmp_path / "a.csv", 2.0 * tall[:-1], delimiter=",")
    changed = MeasuredSurface((0.4, 0.3), file=tmp_path / "a.csv")
    assert changed.fit.heights(X, Y)[0, 0] == pytest.approx(2.0 * wanted[0, 0], rel=1e-3)


def test_a_map_stands_where_its_point_and_normal_say():
    """On the wall x = 1: sideways along y, upward along z, and heights toward the robot."""
    surface = MeasuredSurface((0.4, 0.3), WAVES, point=(1.0, 0.1, 0.5), normal=(-1.0, 0.0, 0.0))
    y, z = 0.07, -0.02
    height = A * np.sin(B * y)
    distance = derivatives(surface, 0)
    assert distance([-height, y, z])[0][0] == pytest.approx(0.0, abs=1e-8)
    assert distance([-height - 0.1, y, z])[0][0] > 0.09
    p = ca.SX.sym("p", 3)
    along = TracedFunction("along", {"p": p}, {"c": surface.coordinates(p)})([0.3, y, z])[0]
    np.testing.assert_allclose(along, [y, z], atol=1e-15)
    mesh = surface.picture([0.0, 0.0, 0.0], 1.0).form
    vertices = np.array([mesh.vertex(i) for i in range(mesh.num_vertices())])
    np.testing.assert_allclose([distance(v)[0][0] for v in vertices], 0.0, atol=1e-14)
    np.testing.assert_allclose(np.ptp(vertices[:, 1:], axis=0), [0.4, 0.3], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["obj", "stl"])
def test_a_mesh_is_sampled_along_the_normal(kind, tmp_path):
    """In millimetres, from two sides; a sheet of triangles is off the wave by a^2 b^2 / 8."""
    fine_x, fine_y = np.linspace(-200, 200, 81), np.linspace(-150, 150, 13)
    heights = 1e3 * A * np.sin(B * fine_x / 1e3) + 0 * fine_y[:, None]
    file = obj_of_grid(tmp_path / "sheet.obj", fine_x, fine_y, heights)
    if kind == "stl":
        lines = [line.split() for line in file.read_text().splitlines()]
        vertices = [[float(x) for x in line[1:]] for line in lines if line[0] == "v"]
        triangles = [[int(k) - 1 for k in line[1:]] for line in lines if line[0] == "f"]
        file = stl_of(tmp_path / "sheet.stl", vertices, triangles)
    off = A * (B * 0.005) ** 2 / 8
    x, y = np.linspace(-0.19, 0.19, 50), np.linspace(-0.14, 0.14, 30)
    above = MeasuredSurface(file=file, scale=1e-3)
    np.testing.assert_allclose(
        above.fit.heights(x, y), A * np.sin(B * x) + 0 * y[:, None], rtol=0, atol=3 * off
    )
    assert above.fit.largest < 2 * off
    # From below the heights are the other way round, and so is one of the coordinates.
    below = MeasuredSurface(file=file, scale=1e-3, normal=(0.0, 0.0, -1.0), resolution=0.02)
    _, second = tangents([0.0, 0.0, -1.0])
    np.testing.assert_allclose(
        below.fit.heights(x, second[1] * y), -A * np.sin(B * x) + 0 * y[:, None], atol=3 * off
    )


def box(corner, size):
    """A closed box, its fronts outward."""
    unit = np.array([[(i >> k) & 1 for k in range(3)] for i in range(8)], float)
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    halves = [(a, b, c) for a, b, c, _ in faces] + [(a, c, d) for a, _, c, d in faces]
    return np.array(corner) + unit * size, np.array(halves)


def test_a_solid_has_the_side_that_is_seen(tmp_path):
    file = stl_of(tmp_path / "box.stl", *box([0.1, 0.2, 0.3], [0.4, 0.3, 0.2]))
    for normal, height in (((0, 0, 1), 0.5), ((0, 0, -1), -0.3), ((1, 0, 0), 0.5)):
        surface = MeasuredSurface(file=file, normal=tuple(map(float, normal)))
        found = surface.fit.heights(*(np.linspace(*side, 5) for side in surface.extent.T))
        np.testing.assert_allclose(found, height, atol=1e-9)


def test_overhangs_and_holes_are_refused_with_the_place(tmp_path):
    """A shelf over the half x > 0.5 of a table, and a rectangle that is wider than the table."""
    low, high = box([0, 0, 0], [1, 1, 0.1]), box([0.5, 0, 0.4], [0.5, 1, 0.1])
    both = np.vstack([low[0], high[0]]), np.vstack([low[1], high[1] + 8])
    with pytest.raises(ModelError, match=r"at \[0\.5\d* *, +0\.\d* *\] m"):
        MeasuredSurface(file=stl_of(tmp_path / "shelf.stl", *both))
    file = stl_of(tmp_path / "table.stl", *low)
    part = MeasuredSurface((0.4, 0.8), file=file)
    assert part.fit.heights(np.array([0.5]), np.array([0.5]))[0, 0] == pytest.approx(0.1)
    with pytest.raises(ModelError, match=r"at \[-1\.\d* *, +0\.\d* *\] m"):
        MeasuredSurface((3.0, 0.8), file=file)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda f: MeasuredSurface((0.4, 0.3)), "heights"),
        (lambda f: MeasuredSurface((0.4, 0.3), [[0, 1], [0, 1]], f / "a.npy"), "heights"),
        (lambda f: MeasuredSurface(heights=[[0, 1], [0, 1]]), "size"),
        (lambda f: MeasuredSurface((0.4, 0.3), [[0, 1]]), "(1, 2)"),
        (lambda f: MeasuredSurface((0.4, 0.3), [[0, 1], [0, np.nan]]), "nan"),
        (lambda f: MeasuredSurface((0.4, 0.0), [[0, 1], [0, 1]]), "size"),
        (lambda f: MeasuredSurface((0.4, 0.3), [[0, 1], [0, 1]], scale=-1.0), "scale"),
        (lambda f: MeasuredSurface((0.4, 0.3), [[0, 1e200], [0, 1]]), "1e+200"),
        (lambda f: MeasuredSurface((0.4, 0.3), file=f / "none.npy"), "none.npy"),
        (lambda f: MeasuredSurface((0.4, 0.3), file=f / "none.csv"), "none.csv': No such file"),
        (lambda f: MeasuredSurface((0.4, 0.3), file=f / "a\0.npy"), "a\0.npy"),
        (lambda f: MeasuredSurface((0.4, 0.3), file=f), "directory"),
        (lambda f: MeasuredSurface((0.4, 0.3), file=f / "hole.csv"), "row 2, column 1"),
        *(
            (lambda f, kind=kind: MeasuredSurface((0.4, 0.3), file=f / f"words.{kind}"), kind)
            for kind in ("csv", "npy", "zip", "obj")
        ),
        (lambda f: MeasuredSurface(file=f / "none.stl"), "none.stl"),
        (lambda f: MeasuredSurface(file=f / "wide.obj"), "wide.obj"),
        (lambda f: MeasuredSurface(file=f / "ninth.obj"), "ninth.obj"),
        (lambda f: MeasuredSurface((0.4, 0.3), file=f / "uneven.csv"), "uneven.csv"),
        (lambda f: MeasuredSurface((0.4, 0.3), file=f / "commas.csv"), "commas.csv"),
    ],
)
def test_refusals(make, words, tmp_path):
    (tmp_path / "hole.csv").write_text("1, 2\nnan, 4\n")
    (tmp_path / "uneven.csv").write_text("1,2\n3\n")
    (tmp_path / "commas.csv").write_text("0,5 0,7\n0,1 0,2\n")
    (tmp_path / "ninth.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")
    (tmp_path / "wide.obj").write_text("v 0 0 0\nv 1e200 0 0\nv 0 1 0\nf 1 2 3\n")
    for kind in ("csv", "png", "npy", "npz", "zip", "obj", "stl"):
        (tmp_path / f"words.{kind}").write_text("these are words\n")
    with pytest.raises(ModelError) as caught:
        make(tmp_path)
    assert words in str(caught.value)
    assert len(str(caught.value)) < 400
