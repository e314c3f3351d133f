"""Operations and structure of what is read from a MultibodyPlant."""

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint
from random_plants import (
    TOLERANCE,
    assert_terms_agree,
    default_masses,
    one_body,
    random_context,
    random_inertia,
    random_pose,
    revolute,
    terms_of,
)

from drake_dae.robots import MultibodyExpressions
from drake_dae.trace.functions import TracedFunction


def arm(twist=np.pi / 2, random_offsets=True):
    """Seven revolute z axes, each at `twist` to the last, with random inertias."""
    random = np.random.default_rng(0)
    plant = MultibodyPlant(0.0)
    parent = plant.world_frame()
    for k in range(7):
        body = plant.AddRigidBody(f"link{k + 1}", random_inertia(random))
        angle = 0.0 if k == 0 else twist if k % 2 else -twist
        offset = random.normal(size=3) if random_offsets else [0.0, 0.0, 0.4]
        pose = RigidTransform(RollPitchYaw(angle, 0.0, 0.0), offset)
        frame = plant.AddFrame(FixedOffsetFrame(f"frame{k + 1}", parent, pose))
        plant.AddJoint(RevoluteJoint(f"joint{k + 1}", frame, body.body_frame(), [0, 0, 1]))
        parent = body.body_frame()
    plant.Finalize()
    return plant


def operations(plant):
    expressions = MultibodyExpressions(plant)
    masses = ca.vertcat(*[parameter.symbol for parameter in expressions.parameters])
    inputs = {"q": expressions.q, "v": expressions.v, "masses": masses}
    return tuple(
        TracedFunction("term", inputs, {"term": term}).num_operations
        for term in (expressions.mass_matrix, expressions.bias)
    )


def test_seven_joint_arm_takes_few_operations():
    """A law differentiates these up to four times: 1002 and 1030 now, a regression counts."""
    assert max(operations(arm())) < 1100
    assert max(operations(arm(random_offsets=False))) < 950


def test_branches_are_structurally_decoupled():
    plant = MultibodyPlant(0.0)
    random = np.random.default_rng(1)
    parents = {"trunk": None, "left": "trunk", "right": "trunk", "hand": "left"}
    for name, parent in parents.items():
        body = plant.AddRigidBody(name, random_inertia(random))
        base = plant.GetBodyByName(parent) if parent else plant.world_body()
        frame = plant.AddFrame(
            FixedOffsetFrame(f"{name}_base", base.body_frame(), random_pose(random))
        )
        plant.AddJoint(RevoluteJoint(name, frame, body.body_frame(), [1, 2, 3]))
    plant.Finalize()
    expressions = MultibodyExpressions(plant)
    names = [signal.name for signal in expressions.position_signals]
    coupled = {
        (names[i], names[j])
        for i in range(4)
        for j in range(4)
        if expressions.mass_matrix.has_nz(i, j)
    }
    apart = {("left", "right"), ("hand", "right")}
    apart |= {pair[::-1] for pair in apart}
    assert coupled == {(a, b) for a in names for b in names} - apart


def test_gravity_can_be_disabled_for_a_body_welded_to_a_heavy_one():
    plant = MultibodyPlant(0.0)
    instance = plant.AddModelInstance("balloon")
    inertia = random_inertia(np.random.default_rng(2))
    body = plant.AddRigidBody("body", plant.GetModelInstanceByName("DefaultModelInstance"), inertia)
    light = plant.AddRigidBody("light", instance, inertia)
    plant.AddJoint(RevoluteJoint("joint", plant.world_frame(), body.body_frame(), [0, 1, 0]))
    plant.WeldFrames(body.body_frame(), light.body_frame(), RigidTransform([0.3, 0.2, 0.1]))
    plant.set_gravity_enabled(instance, False)
    plant.Finalize()
    expressions = MultibodyExpressions(plant)
    context = random_context(plant, np.random.default_rng(3))
    assert_terms_agree(plant, context, terms_of(expressions), default_masses(expressions))


def test_of_two_motors_on_a_joint_the_last_rotor_counts():
    """So does Drake, where one might expect the sum."""
    plant = one_body(revolute, finalize=False)
    for name, rotor_inertia in (("first", 0.5), ("last", 0.25)):
        actuator = plant.AddJointActuator(name, plant.GetJointByName("joint"))
        actuator.set_default_rotor_inertia(rotor_inertia)
    plant.Finalize()
    expressions = MultibodyExpressions(plant)
    np.testing.assert_array_equal(expressions.actuation_matrix, [[1.0, 1.0]])
    M = terms_of(expressions)([0.0], [0.0], default_masses(expressions))[0]
    # A unit cube of mass 1 turns about z with 1 / 6.
    np.testing.assert_allclose(M, 1 / 6 + 0.25, rtol=TOLERANCE)
