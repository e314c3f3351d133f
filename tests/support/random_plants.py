"""Random robots as MultibodyPlants."""

from functools import cache
from types import SimpleNamespace

import casadi as ca
import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    FixedOffsetFrame,
    LinearSpringDamper,
    MultibodyForces,
    PlanarJoint,
    PrismaticJoint,
    PrismaticSpring,
    RevoluteJoint,
    RevoluteSpring,
    RpyFloatingJoint,
    ScrewJoint,
    SpatialInertia,
    UnitInertia,
    UniversalJoint,
    WeldJoint,
)

from drake_dae.robots import MultibodyExpressions
from drake_dae.trace.functions import TracedFunction

TOLERANCE = 1e-12


JOINTS = (
    "revolute",
    "prismatic",
    "screw",
    "universal",
    "planar",
    "ball_rpy",
    "rpy_floating",
    "weld",
)


def random_inertia(random):
    """Of eight point masses, so that it is physically valid."""
    masses, points = random.uniform(0.1, 1.0, 8), random.normal(0.0, 0.3, (8, 3))
    mass = masses.sum()
    second = (points.T * masses) @ points / mass
    unit = np.trace(second) * np.eye(3) - second
    moments_and_products = [unit[i] for i in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    return SpatialInertia(mass, masses @ points / mass, UnitInertia(*moments_and_products))


def random_pose(random):
    return RigidTransform(RollPitchYaw(random.uniform(-3.0, 3.0, 3)), random.normal(0.0, 0.5, 3))


def random_axis(random):
    axis = random.normal(size=3)
    coordinate = np.eye(3)[random.integers(3)] * random.choice([-1.0, 1.0])
    return coordinate if random.random() < 0.5 else axis / np.linalg.norm(axis)


def make_joint(kind, name, parent, child, random):
    if kind == "revolute":
        return RevoluteJoint(name, parent, child, random_axis(random), damping=random.random())
    if kind == "prismatic":
        return PrismaticJoint(name, parent, child, random_axis(random), damping=random.random())
    if kind == "screw":
        pitch = random.normal()
        return ScrewJoint(name, parent, child, random_axis(random), pitch, random.random())
    if kind == "universal":
        return UniversalJoint(name, parent, child, damping=random.random())
    if kind == "planar":
        return PlanarJoint(name, parent, child, damping=random.random(3))
    if kind == "ball_rpy":
        return BallRpyJoint(name, parent, child, damping=random.random())
    if kind == "rpy_floating":
        return RpyFloatingJoint(name, parent, child, random.random(), random.random())
    return WeldJoint(name, parent, child, random_pose(random))


def random_plant(seed):
    """A tree with every supported joint, at random places in random order, and two more."""
    random = np.random.default_rng(seed)
    plant = MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector(random.normal(0.0, 8.0, 3))
    instances = [plant.AddModelInstance(name) for name in ("first", "second")]
    bodies = [plant.world_body()]
    kinds = [*JOINTS, *random.choice(["revolute", "prismatic", "weld"], 2)]
    for index, kind in enumerate(random.permutation(kinds)):
        instance = instances[random.integers(2)]
        # A welded body may be massless: it moves nothing on its own.
        massless = kind == "weld" and random.random() < 0.5
        inertia = SpatialInertia.Zero() if massless else random_inertia(random)
        body = plant.AddRigidBody(f"body{index}", instance, inertia)
        inboard = bodies[random.integers(max(0, len(bodies) - 3), len(bodies))]
        parent, child = (
            plant.AddFrame(
                FixedOffsetFrame(f"{kind}{index}_{end}", of.body_frame(), random_pose(random))
            )
            for end, of in (("parent", inboard), ("child", body))
        )
        if kind in ("revolute", "prismatic", "weld") and random.random() < 0.4:
            parent, child = child, parent
        joint = plant.AddJoint(make_joint(kind, f"{kind}{index}", parent, child, random))
        bodies.append(body)
        if joint.num_velocities() == 1 and random.random() < 0.7:
            actuator = plant.AddJointActuator(f"motor{index}", joint, random.uniform(1.0, 9.0))
            actuator.set_default_rotor_inertia(random.uniform(0.0, 1e-3))
            actuator.set_default_gear_ratio(random.uniform(-100.0, 100.0))
        if kind == "revolute":
            plant.AddForceElement(RevoluteSpring(joint, random.normal(), random.uniform(0, 9)))
        if kind == "prismatic":
            plant.AddForceElement(PrismaticSpring(joint, random.normal(), random.uniform(0, 9)))
    for _ in range(2):
        first, second = random.choice(len(bodies), 2, replace=False)
        ends, numbers = random.normal(size=(2, 3)), random.uniform(0.5, 9.0, 3)
        plant.AddForceElement(
            LinearSpringDamper(bodies[first], ends[0], bodies[second], ends[1], *numbers)
        )
    if seed % 2:
        plant.set_gravity_enabled(instances[1], False)
    plant.Finalize()
    return plant


@cache
def random_robot(seed):
    """The plant, its expressions, and these as functions of (q, v, masses)."""
    plant = random_plant(seed)
    expressions = MultibodyExpressions(plant)
    return SimpleNamespace(plant=plant, expressions=expressions, terms=terms_of(expressions))


def terms_of(expressions):
    inputs = {
        "q": expressions.q,
        "v": expressions.v,
        "masses": ca.vertcat(*[parameter.symbol for parameter in expressions.parameters]),
    }
    outputs = {"M": expressions.mass_matrix, "H": expressions.bias, "N": expressions.velocity_map}
    return TracedFunction("terms", inputs, outputs)


def default_masses(expressions):
    return np.concatenate([parameter.value for parameter in expressions.parameters])


def random_context(plant, random):
    """A context at a random state, farther out than the comparison on construction goes."""
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, random.uniform(-3.0, 3.0, plant.num_positions()))
    plant.SetVelocities(context, random.normal(0.0, 2.0, plant.num_velocities()))
    return context


def state(plant, context):
    return plant.GetPositions(context), plant.GetVelocities(context)


def plant_bias(plant, context):
    forces = MultibodyForces(plant)
    plant.CalcForceElementsContribution(context, forces)
    return plant.CalcBiasTerm(context) - plant.CalcGeneralizedForces(context, forces)


def assert_close(own, other, what, scale=0.0):
    """Compares up to round-off of the largest entry, or of `scale`."""
    own, other = np.asarray(own), np.asarray(other)
    assert own.shape == other.shape, what
    error = np.abs(own - other).max(initial=0.0)
    assert error <= TOLERANCE * max(np.abs(other).max(initial=0.0), scale), f"{what}: {error}"


def assert_terms_agree(plant, context, terms, masses):
    q, v = state(plant, context)
    M, H, N = terms(q, v, masses)
    assert_close(M.reshape(v.size, v.size), plant.CalcMassMatrix(context), "mass matrix")
    assert_close(H, plant_bias(plant, context), "bias")
    assert_close(N.reshape(v.size, v.size) @ v, plant.MapVelocityToQDot(context, v), "velocity map")


def one_body(joint=None, finalize=True):
    plant = MultibodyPlant(0.0)
    body = plant.AddRigidBody("box", SpatialInertia.SolidCubeWithDensity(1.0, 1.0))
    if joint is not None:
        plant.AddJoint(joint("joint", plant.world_frame(), body.body_frame()))
    if finalize:
        plant.Finalize()
    return plant


def revolute(name, parent, child):
    return RevoluteJoint(name, parent, child, [0, 0, 1])
