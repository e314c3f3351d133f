"""The rules of `Surface` on every member, distances against brute force, and layers below them."""

import casadi as ca
import numpy as np
import pytest
from members import Saddle, subclasses
from numpy.testing import assert_allclose
from pydrake import geometry
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    ProximityProperties,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, ContactModel, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder

from drake_dae.errors import ModelError
from drake_dae.robots import (
    Cylinder,
    Ellipsoid,
    ImplicitSurface,
    MeasuredSurface,
    Plane,
    PointOnSurface,
    Sphere,
    Surface,
    SurfaceCoordinates,
    Torus,
)
from drake_dae.trace.functions import TracedFunction

WAVES = 0.1 * np.sin(np.linspace(-4.0, 4.0, 41)) * np.cos(np.linspace(-2.0, 2.0, 31))[:, None]
SURFACES = {
    "plane": Plane((0.3, -0.2, 0.5), (1.0, -2.0, 0.5)),
    "sphere": Sphere((0.1, 0.2, 0.3), 0.7),
    "inside sphere": Sphere((0.1, 0.2, 0.3), 0.7, inside=True),
    "cylinder": Cylinder((0.4, 0.0, 0.1), (1.0, 1.0, 0.3), 0.5),
    "turned cylinder": Cylinder((0.4, 0.0, 0.1), (0.2, 0.0, 1.0), 0.5, zero=(-1.0, 0.5, 0.0)),
    "inside cylinder": Cylinder((0.4, 0.0, 0.1), (0.0, 0.0, 2.0), 0.5, inside=True),
    "ellipsoid": Ellipsoid((0.1, -0.1, 0.2), (0.5, 0.8, 0.3)),
    "torus": Torus((0.0, 0.1, 0.2), (0.2, 0.1, 1.0), 0.8, 0.3),
    "implicit": ImplicitSurface(
        lambda p: 7.0 * (p[2] - 0.3 * ca.sin(2.0 * p[0]) - 0.2 * p[1] ** 2), (0.5, 0.0, 0.1)
    ),
    "saddle": Saddle((0.3, 0.1, -0.2), 0.6),
    "formula": ImplicitSurface("a*cos(3*x) + exp(y/l) - z", (0.5, 0.0, 0.1), {"a": 0.2, "l": 2.0}),
    "height map": MeasuredSurface(
        (2.4, 2.0), WAVES, point=(0.1, 0.2, 0.3), normal=(0.1, -1.0, 0.3)
    ),
}


def test_no_member_is_left_out():
    assert subclasses(Surface) <= {type(surface) for surface in SURFACES.values()}


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
    for p in random.uniform(-1.2, 1.2, (20 * count, 3)):
        for _ in range(50):
            value, gradient = function(p)[:2]
            p = p - value * gradient / max(gradient @ gradient, 1e-3)
        if abs(function(p)[0][0]) < 1e-13:
            found.append(p)
        if len(found) == count:
            return function, np.array(found)
    pytest.fail("there are no such points")


@pytest.mark.parametrize("name", SURFACES)
def test_distance_grows_with_one_along_the_normal(name):
    """phi(p + d n) = d + O(d^2) on both sides: positive on the free side.

    The gradient has length one, up to round-off: so the multiplier is a force in newtons.
    """
    function, points = points_on(SURFACES[name])
    for p in points:
        normal = function(p)[1]
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-11)
        for d in (1e-5, -1e-5):
            # Curvatures here are below 20 1/m.
            assert function(p + d * normal)[0][0] == pytest.approx(d, abs=20 * d * d)


def distance_by_drake(surface):
    """The signed distance from the solids of a surface, by Drake."""
    scene = geometry.SceneGraph()
    source = scene.RegisterSource("test")
    for number, solid in enumerate(surface.solids()):
        shape = geometry.GeometryInstance(solid.pose, solid.form, f"solid {number}")
        shape.set_proximity_properties(geometry.ProximityProperties())
        scene.RegisterAnchoredGeometry(source, shape)
    context = scene.CreateDefaultContext()

    def distance(p):
        query = scene.get_query_output_port().Eval(context)
        return min(found.distance for found in query.ComputeSignedDistanceToPoint(p))

    return distance


@pytest.mark.parametrize("name", [n for n in SURFACES if SURFACES[n].solids()])
def test_a_solid_has_the_distance_of_its_surface(name):
    """By Drake's signed distance, up to 0.1 m away; round-off alone, 1e-12 has room."""
    by_drake = distance_by_drake(SURFACES[name])
    function, points = points_on(SURFACES[name])
    for p, d in zip(points, np.linspace(-0.1, 0.1, len(points)), strict=True):
        near = p + d * function(p)[1]
        assert by_drake(near) == pytest.approx(function(near)[0][0], abs=1e-12)


@pytest.mark.parametrize("name", [n for n in SURFACES if SURFACES[n].coordinate_signals])
def test_coordinates_cover_the_surface(name):
    """Normal and gradients of the two coordinates are independent away from the poles."""
    function, points = points_on(SURFACES[name])
    volumes = [
        abs(np.linalg.det(np.vstack([gradient, jacobian])))
        for _, gradient, _, jacobian in map(function, points)
    ]
    assert min(volumes) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plane", "ellipsoid", "formula"])
def test_any_surface_is_drawn_from_its_distance_alone(name):
    """As `Surface` does where a class has no shape of its own: around a point, on the surface."""
    surface, size = SURFACES[name], 0.4
    function, points = points_on(surface, 5)
    for center in points + 0.1 * np.random.default_rng(2).uniform(-1.0, 1.0, (5, 3)):
        picture = Surface.picture(surface, center, size)
        assert picture.pose.IsExactlyIdentity()
        mesh = picture.form
        vertices = np.array([mesh.vertex(i) for i in range(mesh.num_vertices())])
        distances = [function(vertex)[0][0] for vertex in vertices]
        np.testing.assert_allclose(distances, 0.0, atol=1e-12)
        apart = np.linalg.norm(vertices - center, axis=1)
        # A patch of about this size, the center above its middle.
        assert mesh.num_triangles() > 500
        assert apart.min() < 0.2
        assert 0.5 * size < apart.max() < 2.0 * size


def test_a_cylinder_is_drawn_beside_what_touches_it():
    """Where a parameter puts the surface, and not where it was made."""
    axis = np.array([1.0, 2.0, 2.0]) / 3.0
    position, center = np.array([0.1, 0.2, 0.3]), np.array([0.7, -0.4, 0.9])
    surface = Cylinder((0, 0, 0), (1, 2, 2), 0.5)
    picture = surface.picture(center - position, 2.0).moved(RigidTransform(position))
    np.testing.assert_allclose(picture.pose.rotation().matrix()[:, 2], axis, atol=1e-12)
    foot = position + np.dot(center - position, axis) * axis
    np.testing.assert_allclose(picture.pose.translation(), foot, atol=1e-12)
    assert (picture.form.radius(), picture.form.length()) == (0.5, 2.0)


def test_distance_from_a_torus_is_that_of_the_nearest_point():
    """Against the nearest of a cloud of points on it; other surfaces have Drake's solids."""
    function, cloud = points_on(SURFACES["torus"], 40)
    for p in np.random.default_rng(1).uniform(-1.0, 1.0, (10, 3)):
        distance, gradient = function(p)[:2]
        foot = p - distance * gradient
        # The foot is on the surface and no point of the surface is nearer.
        assert function(foot)[0][0] == pytest.approx(0.0, abs=1e-12)
        assert np.min(np.linalg.norm(cloud - p, axis=1)) >= abs(distance[0]) - 1e-9


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Plane((0, 0), (1, 0, 0)), "point"),
        (lambda: Plane((0, 0, 0), (0, 0, 0)), "normal"),
        (lambda: Sphere((0, 0, 0), 0.0), "radius.*0.0"),
        (lambda: Sphere((0, 0, np.nan), 1.0), "center"),
        (lambda: Cylinder((0, 0, 0), (0, 0, 2), 1.0, zero=(0, 0, -3)), "zero"),
        (lambda: Ellipsoid((0, 0, 0), (1, 0, 1)), "semi_axes"),
        (lambda: Torus((0, 0, 0), (0, 0, 1), 0.2, 0.3), "minor_radius"),
        (lambda: ImplicitSurface("x - force", parameters={"force": 1.0}), "'force'"),
        (lambda: ImplicitSurface(lambda p: p).distance(ca.SX.sym("p", 3)), r"\(3, 1\)"),
        (
            lambda: SurfaceCoordinates(PointOnSurface("tool", ImplicitSurface("x"), name="wall")),
            "'wall'",
        ),
    ],
)
def test_refusals(make, message):
    with pytest.raises(ModelError, match=message):
        make()


def test_a_surface_is_drawn_around_its_tip():
    """The gradient vanishes at the tip of a cone; beside it there is a normal."""
    cone = ImplicitSurface(lambda p: p[2] ** 2 - p[0] ** 2 - p[1] ** 2)
    assert cone.picture([0.0, 0.0, 0.0], 0.4) is not None


RADIUS, DEPTH, MODULUS = 0.01, 0.005, 1e7
HEIGHTS = 0.002 * np.cos(np.linspace(-2.0, 2.0, 33))[:, None] * np.ones(9)

# Each with a point on it, and the sum of its principal curvatures there, positive for a ball.
PIECES = {
    "torus": (Torus((0, 0, 0), (0, 0, 1), 0.3, 0.1), (0.4, 0, 0), 12.5),
    "heights": (MeasuredSurface((0.04, 0.1), HEIGHTS), (0, 0, 0.002), 0.002 * (4.0 / 0.1) ** 2),
}


def forces_on_a_ball(solid):
    """The force of a solid on a rigid ball as a function of its center, by Drake."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    plant.set_contact_model(ContactModel.kHydroelastic)
    soft, hard = ProximityProperties(), ProximityProperties()
    for properties in (soft, hard):
        AddContactMaterial(0.0, 1e5, CoulombFriction(0.0, 0.0), properties)
    AddCompliantHydroelasticProperties(RADIUS, MODULUS, soft)
    AddRigidHydroelasticProperties(RADIUS / 16.0, hard)
    plant.RegisterCollisionGeometry(plant.world_body(), solid.pose, solid.form, "solid", soft)
    body = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(1.0, RADIUS))
    ball = plant.RegisterCollisionGeometry(
        body, RigidTransform(), geometry.Sphere(RADIUS), "ball", hard
    )
    plant.Finalize()
    diagram = builder.Build()
    context = plant.GetMyContextFromRoot(diagram.CreateDefaultContext())

    def force(center):
        plant.SetFreeBodyPose(context, body, RigidTransform(center))
        results = plant.get_contact_results_output_port().Eval(context)
        if not results.num_hydroelastic_contacts():
            return np.zeros(3)
        patch = results.hydroelastic_contact_info(0)
        side = 1.0 if patch.contact_surface().id_M() == ball else -1.0
        return side * patch.F_Ac_W().translational()

    return force


@pytest.mark.slow
@pytest.mark.parametrize("name", ["torus", "heights"])
def test_a_ball_is_pushed_off_a_mesh_along_the_normal_of_its_surface(name):
    """At 9 places, 0.2 mm deep: within 0.1 degrees, and within 8 % of pi E d^2 / (h (1/R + kappa)).

    This is the integral of the pressure E s / h over the overlap, with the mean curvature kappa;
    with h far from the edges. Facets of the ball, inscribed with R / 16, take 5 % of it.
    """
    surface, place, curvature = PIECES[name]
    layer = surface.layer(place, 0.08, DEPTH)
    p = ca.SX.sym("p", 3)
    distance = surface.distance(p)
    function = TracedFunction("d", {"p": p}, {"d": distance, "n": ca.gradient(distance, p)})
    force, depth, random = forces_on_a_ball(layer), 2e-4, np.random.default_rng(1)
    for size in (0.0, *[3e-3] * 8):
        point = np.array(place) + size * random.uniform(-1.0, 1.0, 3)
        for _ in range(5):
            value, normal = function(point)
            point = point - value * normal
        normal = function(point)[1]
        found = force(point + (RADIUS - depth) * normal)
        size = np.linalg.norm(found)
        assert np.degrees(np.linalg.norm(np.cross(found, normal)) / size) < 0.1
        expected = np.pi * MODULUS * depth**2 / (DEPTH * (1.0 / RADIUS + curvature / 2.0))
        assert_allclose(size, expected, rtol=0.08)


@pytest.mark.parametrize(
    ("surface", "place", "size", "depth", "message"),
    [
        (ImplicitSurface("z - sqrt(0.01 - x**2)"), (0, 0, 0.1), 0.3, 0.005, "piece"),
        (Cylinder((0, 0, 0), (0, 0, 1), 0.03), (0.03, 0, 0), 0.3, 0.05, "piece"),
        (Plane((0, 0, 0), (0, 0, 1)), (0, 0, 0), 0.02, 0.005, r"0\.02\b.*piece"),
    ],
)
def test_a_piece_that_cannot_be_a_mesh_is_refused(surface, place, size, depth, message):
    with pytest.raises(ModelError, match=message):
        surface.layer(place, size, depth)
