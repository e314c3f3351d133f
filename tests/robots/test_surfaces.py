"""Axioms that every surface keeps, and distances against brute force."""

import casadi as ca
import numpy as np
import pytest

from drake_dae.errors import ModelError
from drake_dae.robots.contact.surfaces import (
    Cylinder,
    Ellipsoid,
    ImplicitSurface,
    Plane,
    Sphere,
    Torus,
    tangents,
)
from drake_dae.trace.functions import TracedFunction

SURFACES = {
    "plane": Plane((0.3, -0.2, 0.5), (1.0, -2.0, 0.5)),
    "sphere": Sphere((0.1, 0.2, 0.3), 0.7),
    "inside sphere": Sphere((0.1, 0.2, 0.3), 0.7, inside=True),
    "cylinder": Cylinder((0.4, 0.0, 0.1), (1.0, 1.0, 0.3), 0.5),
    "inside cylinder": Cylinder((0.4, 0.0, 0.1), (0.0, 0.0, 2.0), 0.5, inside=True),
    "ellipsoid": Ellipsoid((0.1, -0.1, 0.2), (0.5, 0.8, 0.3)),
    "torus": Torus((0.0, 0.1, 0.2), (0.2, 0.1, 1.0), 0.8, 0.3),
    "implicit": ImplicitSurface(
        lambda p: 7.0 * (p[2] - 0.3 * ca.sin(2.0 * p[0]) - 0.2 * p[1] ** 2), (0.5, 0.0, 0.1)
    ),
}


def functions(surface):
    p = ca.SX.sym("p", 3)
    distance = surface.distance(p)
    outputs = {"distance": distance, "gradient": ca.gradient(distance, p)}
    if surface.coordinate_signals:
        outputs["coordinates"] = surface.coordinates(p)
        outputs["jacobian"] = ca.jacobian(surface.coordinates(p), p)
    return TracedFunction("surface", {"p": p}, outputs)


def points_on(surface, count=30):
    """Random offsets from the reference point, brought to the surface along the gradient."""
    function, random, found = functions(surface), np.random.default_rng(0), []
    while len(found) < count:
        p = random.uniform(-1.2, 1.2, 3)
        for _ in range(50):
            value, gradient = function(p)[:2]
            p = p - value * gradient / max(gradient @ gradient, 1e-3)
        if abs(function(p)[0][0]) < 1e-13:
            found.append(p)
    return function, np.array(found)


@pytest.mark.parametrize("name", SURFACES)
def test_gradient_has_length_one_on_the_surface(name):
    """So that the multiplier is a force in newtons; exact up to round-off."""
    function, points = points_on(SURFACES[name])
    for p in points:
        gradient = function(p)[1]
        assert np.linalg.norm(gradient) == pytest.approx(1.0, abs=1e-11)


@pytest.mark.parametrize("name", SURFACES)
def test_distance_grows_with_one_along_the_normal(name):
    """phi(p + d n) = d + O(d^2) on both sides: positive on the free side."""
    function, points = points_on(SURFACES[name])
    for p in points:
        normal = function(p)[1]
        for d in (1e-5, -1e-5):
            # Curvatures here are below 20 1/m.
            assert function(p + d * normal)[0][0] == pytest.approx(d, abs=20 * d * d)


@pytest.mark.parametrize("name", [n for n in SURFACES if n != "implicit"])
def test_coordinates_cover_the_surface(name):
    """Normal and gradients of the two coordinates are independent away from the poles."""
    function, points = points_on(SURFACES[name])
    volumes = [
        abs(np.linalg.det(np.vstack([gradient, jacobian])))
        for _, gradient, _, jacobian in map(function, points)
    ]
    assert min(volumes) > 0.1


@pytest.mark.parametrize("name", ["plane", "sphere", "cylinder", "torus"])
def test_distance_is_the_distance_to_the_nearest_point(name):
    """Against the nearest of a dense cloud of points on the surface."""
    surface = SURFACES[name]
    function = functions(surface)
    random = np.random.default_rng(1)
    for p in random.uniform(-1.0, 1.0, (10, 3)):
        distance, gradient = function(p)[:2]
        foot = p - distance * gradient
        # The foot is on the surface and no point of the surface is nearer.
        assert function(foot)[0][0] == pytest.approx(0.0, abs=1e-12)
        _, cloud = points_on(surface, 40)
        assert np.min(np.linalg.norm(cloud - p, axis=1)) >= abs(distance[0]) - 1e-9


def test_known_values():
    assert float(Plane((1, 0, 0), (-2, 0, 0)).distance(ca.SX([-0.25, 5, 5]))) == 0.25
    assert float(Sphere((0, 0, 0), 2.0).distance(ca.SX([3, 0, 4]))) == 3.0
    assert float(Sphere((0, 0, 0), 2.0, inside=True).distance(ca.SX([0, 0, 1.5]))) == 0.5
    assert float(Cylinder((0, 0, 0), (0, 0, 1), 1.0).distance(ca.SX([3, 4, 9]))) == 4.0
    assert float(Torus((0, 0, 0), (0, 0, 1), 2.0, 0.5).distance(ca.SX([0, 3, 0]))) == 0.5
    # On the long axis F = 3, |grad F| = 4: not the distance 1, but the same to first order.
    assert float(Ellipsoid((0, 0, 0), (1, 1, 1)).distance(ca.SX([2, 0, 0]))) == 0.75


def test_tangents_are_upright():
    np.testing.assert_allclose(tangents([-1, 0, 0]), [[0, 1, 0], [0, 0, 1]], atol=0)
    np.testing.assert_allclose(tangents([0, 0, 1]), [[1, 0, 0], [0, 1, 0]], atol=0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Plane((0, 0), (1, 0, 0)), "point must be three finite numbers"),
        (lambda: Plane((0, 0, 0), (0, 0, 0)), "normal must not be zero"),
        (lambda: Sphere((0, 0, 0), 0.0), "radius must be positive, got 0.0"),
        (lambda: Sphere((0, 0, np.nan), 1.0), "center must be three finite numbers"),
        (lambda: Cylinder((0, 0, 0), (0, 0, 1), -1.0), "radius must be positive"),
        (lambda: Ellipsoid((0, 0, 0), (1, 0, 1)), "semi_axes must be positive"),
        (lambda: Torus((0, 0, 0), (0, 0, 1), 0.2, 0.3), "must exceed minor_radius"),
        (
            lambda: ImplicitSurface(lambda p: p).distance(ca.SX.sym("p", 3)),
            "returns one number",
        ),
        (
            lambda: ImplicitSurface(lambda p: p[0]).coordinates(ca.SX.sym("p", 3)),
            "has no coordinates",
        ),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ModelError, match=message):
        make()
