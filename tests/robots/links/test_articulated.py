"""The articulated-body algorithm, against Drake's mass matrix and its equations of motion."""

import casadi as ca
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    FixedOffsetFrame,
    JacobianWrtVariable,
    PrismaticJoint,
    RevoluteJoint,
)
from pydrake.systems.analysis import SimulatorConfig
from random_plants import random_inertia

from drake_dae import (
    JointPositions,
    Plane,
    PointOnSurface,
    RobotModel,
    RobotPlant,
    TrackingLaw,
    make_closed_loop,
    poles,
    rollout,
)
from drake_dae.blocks.block import BlockFunction
from drake_dae.robots import MultibodyExpressions
from drake_dae.running import start_values
from drake_dae.trace.factorization import PositiveDefiniteFactorization
from drake_dae.trace.functions import TracedFunction, count_operations


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


@pytest.mark.slow
def test_operations_grow_with_the_number_of_links_where_those_of_a_triangle_grow_faster():
    counts = []
    for size in (10, 20):
        links = MultibodyExpressions(chain(size))
        right = ca.SX.sym("b", size)
        triangle = PositiveDefiniteFactorization(links.mass_matrix)
        bodies = links.articulated_bodies(np.zeros(size))
        counts.append([count_operations(each.solve(right)) for each in (bodies, triangle)])
    assert counts[1][0] < 2.4 * counts[0][0]
    assert counts[1][1] > 3.5 * counts[0][1]


@pytest.mark.parametrize(
    ("size", "most"), [(6, None), pytest.param(20, 17000, marks=pytest.mark.slow)]
)
def test_a_plant_of_many_joints_obeys_drakes_equations(size, most):
    """M v' + C v = tau_g + B u + J' lambda, J v' + J' v = 0, with the plant's own terms.

    Solved by NumPy; the condition of M is 1e4 at most.
    """
    plant = chain(size)
    random = np.random.default_rng(1)
    q, v, u = 0.3 * random.normal(size=size), random.normal(size=size), random.normal(size=size)
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    tip = plant.GetFrameByName(f"link{size - 1}")
    point = tip.CalcPoseInWorld(context).translation()
    wall = PointOnSurface(f"link{size - 1}", Plane(point, [-1.0, 0.0, 0.0]), name="wall")
    outputs = [JointPositions([f"j{i}" for i in range(size) if i != 1])]
    model = RobotModel.from_multibody(plant, [wall], outputs, nominal_positions=q)
    robot = RobotPlant(model)
    state = robot.structure.manifold.settle(np.concatenate([q, v]))
    motion = BlockFunction(robot.block, "motion", {"rate": robot.block.derivative})
    (rates,) = motion(state, u, model.dae.parameter_values)
    plant.SetPositionsAndVelocities(context, state)
    J, world = JacobianWrtVariable.kV, plant.world_frame()
    normal = np.array([-1.0, 0.0, 0.0])
    arguments = (context, J, tip, np.zeros(3), world, world)
    row = normal @ plant.CalcJacobianTranslationalVelocity(*arguments)
    bias = normal @ plant.CalcBiasTranslationalAcceleration(*arguments).ravel()
    matrix = np.block([[plant.CalcMassMatrix(context), -row[:, None]], [row, 0.0]])
    load = u + plant.CalcGravityGeneralizedForces(context) - plant.CalcBiasTerm(context)
    wanted = np.linalg.solve(matrix, [*load, -bias])
    np.testing.assert_allclose(rates[size:], wanted[:-1], rtol=0, atol=1e-9 * np.abs(wanted).max())
    assert most is None or motion.num_operations < most


@pytest.mark.slow
@pytest.mark.thorough
def test_a_law_of_sixty_joints_tracks_as_predicted():
    """To the accuracy of the integrator, 1e-7 rad; the force to round-off of large torques."""
    size = 60
    plant = chain(size)
    context = plant.CreateDefaultContext()
    q = 0.1 * np.random.default_rng(1).normal(size=size)
    plant.SetPositions(context, q)
    point = plant.GetFrameByName("link59").CalcPoseInWorld(context).translation()
    wall = PointOnSurface("link59", Plane(point, [-1.0, 0.0, 0.0]), name="wall")
    joints = [f"j{i}" for i in range(size) if i != 1]
    model = RobotModel.from_multibody(plant, [wall], [JointPositions(joints)], nominal_positions=q)
    law = TrackingLaw(model.dae, poles(-4.0))
    robot = RobotPlant(model, structure=law.structure)
    references = {name: float(q[int(name[1:])]) + 0.01 for name in joints}
    loop = make_closed_loop(robot, law, {**references, "wall.force": 5.0})
    context = loop.diagram.CreateDefaultContext()
    robot.set_consistent_state(robot.GetMyMutableContextFromRoot(context), model.dae.nominal_state)
    start, parameters = start_values(loop, context)
    config = SimulatorConfig(accuracy=1e-7)
    (run,) = rollout(loop, start, parameters, [0.0, 0.5, 1.0], config=config, compiled=False)
    assert run.failure is None
    record = run.record
    off = np.abs(record["tracking_error"] - loop.predicted_error(record))
    assert off[:, :-1].max() < 1e-7
    np.testing.assert_allclose(record["constraint_force"], 5.0, rtol=1e-6)
