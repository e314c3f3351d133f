"""The articulated-body algorithm, against Drake's mass matrix and its equations of motion."""

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    FixedOffsetFrame,
    PrismaticJoint,
    RevoluteJoint,
)
from random_plants import random_inertia

from drake_dae.robots import MultibodyExpressions
from drake_dae.trace.functions import TracedFunction


def tree(joints, parents, motors=True):
    """A plant of revolute (R), prismatic (P) and ball (B) joints; each link has a parent."""
    plant, random = MultibodyPlant(0.0), np.random.default_rng(5)
    kinds = {"R": RevoluteJoint, "P": PrismaticJoint}
    frames = [plant.world_frame()]
    for i, (kind, parent) in enumerate(zip(joints, parents, strict=True)):
        body = plant.AddRigidBody(f"link{i}", random_inertia(random))
        pose = RigidTransform(RollPitchYaw(random.uniform(-1.0, 1.0, 3)), [0.05, 0.0, 0.2])
        frame = plant.AddFrame(FixedOffsetFrame(f"at{i}", frames[parent], pose))
        if kind == "B":
            plant.AddJoint(BallRpyJoint(f"j{i}", frame, body.body_frame()))
        else:
            joint = plant.AddJoint(kinds[kind](f"j{i}", frame, body.body_frame(), np.eye(3)[i % 3]))
            if motors:
                actuator = plant.AddJointActuator(f"m{i}", joint)
                actuator.set_default_rotor_inertia(0.01)
                actuator.set_default_gear_ratio(3.0)
        frames.append(body.body_frame())
    plant.Finalize()
    return plant


def chain(count):
    return tree("R" * count, range(count))


def test_its_factors_are_those_of_drakes_mass_matrix():
    """Of a tree with rotors: a solution, both halves of it, and the product of two of them."""
    plant = tree("RPRRPRRR", [0, 1, 2, 1, 4, 5, 0, 7])
    links = MultibodyExpressions(plant)
    B = links.actuation_matrix
    bodies = links.articulated_bodies(np.diag(B * links.reflected_inertia @ B.T))
    right = ca.SX.sym("b", 8, 2)
    half = bodies.forward(right)
    function = TracedFunction(
        "factors",
        {
            "q": links.q,
            "b": ca.vec(right),
            "mass": ca.vertcat(*[p.symbol for p in links.parameters]),
        },
        {"x": bodies.solve(right), "product": ca.mtimes(half.T, bodies.scaled(half))},
    )
    context, random = plant.CreateDefaultContext(), np.random.default_rng(0)
    masses = np.concatenate([p.value for p in links.parameters])
    for _ in range(5):
        q, b = random.normal(size=8), random.normal(size=(8, 2))
        plant.SetPositions(context, q)
        wanted = np.linalg.solve(plant.CalcMassMatrix(context), b)
        x, product = function(q, b.T.ravel(), masses)
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(x, wanted, rtol=0.0, atol=1e-13 * scale)
        wanted = b.T @ wanted
        np.testing.assert_allclose(product, wanted, 0.0, 1e-13 * np.abs(wanted).max())


def test_structural_zeros_are_kept():
    bodies = MultibodyExpressions(chain(3)).articulated_bodies(np.zeros(3))
    assert bodies.solve(ca.SX(3, 2)).nnz() == 0


def test_joints_with_several_velocities_have_none():
    links = MultibodyExpressions(tree("RBR", [0, 1, 2], motors=False))
    assert links.articulated_bodies(np.zeros(5)) is None
