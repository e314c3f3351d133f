"""Meshes below surfaces: their deviation, and Drake's hydroelastic contact with them."""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, ContactModel, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder

from drake_dae import Cylinder, Ellipsoid, ImplicitSurface, MeasuredSurface, Plane, Torus
from drake_dae import Sphere as Ball
from drake_dae.errors import ModelError
from drake_dae.trace.functions import TracedFunction

RADIUS, DEPTH, MODULUS = 0.01, 0.005, 1e7
HEIGHTS = 0.002 * np.cos(np.linspace(-2.0, 2.0, 33))[:, None] * np.ones(9)

# Each with a point on it, and the sum of its principal curvatures there, positive for a ball.
SURFACES = {
    "plane": (Plane((1, 2, 3), (1, 0, 1)), (0, 0, 0), 0.0),
    "inside": (Ball((0, 0, 0), 0.2, inside=True), (0, 0, -0.2), -10.0),
    "ellipsoid": (Ellipsoid((0, 0, 0), (0.2, 0.2, 0.2)), (0, 0, 0.2), 10.0),
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
    ball = plant.RegisterCollisionGeometry(body, RigidTransform(), Sphere(RADIUS), "ball", hard)
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
    surface, place, curvature = SURFACES[name]
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


def test_a_mesh_is_as_fine_as_its_surface_is_curved():
    """Its vertices but for the lowest stand on the surface and at the depth below it, by pairs."""

    def vertices(surface, place, size):
        text = surface.layer(place, size, DEPTH).form.source().in_memory().mesh_file.contents()
        lines = text.decode().splitlines()
        count = next(int(line.split()[1]) for line in lines if line.startswith("POINTS"))
        begin = next(k for k, line in enumerate(lines) if line.startswith("POINTS")) + 1
        return np.array([[float(x) for x in line.split()] for line in lines[begin : begin + count]])

    plane, dome = (SURFACES[name][0] for name in ("plane", "ellipsoid"))
    flat, curved = vertices(plane, (0, 0, 0), 0.1), vertices(dome, (0, 0, 0.2), 0.1)
    assert len(flat) == 2 * 7 * 7 + 1
    assert len(curved) > 2 * 20 * 20
    np.testing.assert_allclose(flat[:-1:2] @ [0.5**0.5, 0, 0.5**0.5], 0.0, atol=1e-9)
    np.testing.assert_allclose(flat[1:-1:2] @ [0.5**0.5, 0, 0.5**0.5], -DEPTH, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(curved[:-1:2], axis=1), 0.2, atol=1e-9)
    heights = vertices(SURFACES["heights"][0], (0, 0, 0), 9.0)[:-1:2]
    assert np.ptp(heights[:, :2], axis=0) == pytest.approx((0.04, 0.1))


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
