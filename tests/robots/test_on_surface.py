"""A point on a surface that has friction or moves, against MultibodyPlant and NumPy alone."""

import numpy as np
import pytest
from arms import consistent_states, numbers, parse, touching
from numpy.testing import assert_allclose
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces

from drake_dae import (
    AxisCoordinates,
    JointPositions,
    Plane,
    PointOnSurface,
    RobotModel,
    RobotPlant,
    SurfaceCoordinates,
)
from drake_dae.errors import ModelError


def frictional(friction=0.3, stiction_tolerance=0.05, viscous=None, actuation=(), name="two_link"):
    """An arm of `arms` whose wall has friction."""
    model = touching(name, actuation)
    (smooth,) = model.constraints
    contact = PointOnSurface(
        "tool",
        smooth.surface,
        name="wall",
        friction=friction,
        stiction_tolerance=stiction_tolerance,
        viscous_friction=viscous,
    )
    nominal = model.dae.nominal_state[: model.links.q.numel()]
    return RobotModel(model.links, [contact], model.outputs, nominal, name, actuation)


@pytest.mark.parametrize("name", ["two_link", pytest.param("seven_joint", marks=pytest.mark.slow)])
def test_the_motion_is_that_of_multibody_plant_with_the_force_of_friction_on_the_tool(name):
    """M v' + H = J_n^T lambda - J_t^T (mu lambda s + d v_t) + u with J_n v' + J_n' v = 0.

    All numbers are MultibodyPlant's, the unknowns (v', lambda) are solved for at once by NumPy.
    Numbers are of order 100: 1e-9 is round-off with room.
    """
    mu, speed, d = 0.4, 0.05, 7.0
    model = frictional(mu, speed, d, name=name)
    plant, count = RobotPlant(model), model.links.v.numel()
    context, random = plant.CreateDefaultContext(), np.random.default_rng(1)
    for state in consistent_states(name, 5):
        control = random.uniform(-30.0, 30.0, count)
        plant.GetInputPort("control").FixValue(context, control)
        plant.set_state(context, state)
        q, v = np.split(state, 2)
        n = numbers(name, q, v)
        across = n.output_jacobian[: 1 if name == "two_link" else 2]  # Of z; of y and z.
        sliding = across @ v
        s = sliding / np.sqrt(sliding @ sliding + speed**2)
        G = n.constraint_jacobian[0] - mu * across.T @ s
        left = np.block([[n.mass, -G[:, None]], [n.constraint_jacobian, np.zeros((1, 1))]])
        load = control - n.bias - d * across.T @ sliding
        expected = np.linalg.solve(left, [*load, *-n.constraint_acceleration])
        rate = plant.EvalTimeDerivatives(context).CopyToVector()
        force = plant.GetOutputPort("constraint_force").Eval(context)
        assert_allclose(rate[count:], expected[:-1], rtol=1e-9, atol=1e-9)
        assert_allclose(force, expected[-1:], rtol=1e-9, atol=1e-9)

        wrench = plant.GetOutputPort("constraint_wrenches").Eval(context)
        pull = -(mu * force * s + d * sliding)
        wanted = [-force[0], *([0.0] if name == "two_link" else []), *pull]
        assert_allclose(wrench[3:6], wanted, rtol=1e-9, atol=1e-9)
        assert_allclose(wrench[9:], -wrench[3:6], rtol=1e-12)


def test_numbers_of_friction_that_make_no_sense_are_refused():
    wall = Plane((1.2, 0, 0), (-1, 0, 0))
    with pytest.raises(ModelError, match=r"'surface\.friction'"):
        PointOnSurface("tool", wall, friction=-0.1)
    with pytest.raises(ModelError, match=r"'surface\.viscous_friction'"):
        PointOnSurface("tool", wall, viscous_friction=-0.1)
    with pytest.raises(ModelError, match=r"'surface\.stiction_tolerance'"):
        PointOnSurface("tool", wall, friction=0.3, stiction_tolerance=0.0)
    plant = RobotPlant(frictional())
    context = plant.CreateDefaultContext()
    with pytest.raises(ModelError, match=r"wall\.friction"):
        plant.set_parameter(context, "wall.friction", -0.3)


AT_WORK = [0.0, -0.2583, 0.0, -1.5038, 0.0, -1.3795, 0.0]


def arm_on_plate(exogenous=("plate.position", "plate.rpy")):
    """The 7-joint arm with its tool on a plate that can be moved and turned."""
    plate = PointOnSurface("tool", Plane((0.5, 0, 0.4), (0, 0, 1)), name="plate", rpy=(0, 0, 0))
    return RobotModel.from_multibody(
        parse("seven_joint_arm"),
        [plate],
        [
            SurfaceCoordinates(plate),
            AxisCoordinates("tool", "z", "xy"),
            JointPositions(["joint3", "joint7"]),
        ],
        AT_WORK,
        exogenous=exogenous,
    )


def test_a_turning_surface_drags_a_frictional_contact_along():
    """F_t = -(mu lambda s + d v_t) for the velocity v_t relative to what touches of the surface.

    That place moves by c' + R' R^T (p - c), with R' by a central difference of order 2, good to
    1e-8 of turns of 1 rad/s at this step. J is MultibodyPlant's.
    """
    model, speed, h = touching("two_link"), 0.05, 1e-4
    friction, viscous = 0.2, 10.0
    wall = PointOnSurface(
        "tool",
        Plane((1.2, 0, 0), (-1, 0, 0)),
        name="wall",
        rpy=(0, 0, 0),
        friction=friction,
        stiction_tolerance=speed,
        viscous_friction=viscous,
    )
    frictional = RobotModel(
        model.links, [wall], model.outputs, [1.2, -1.6], exogenous=("wall.position", "wall.rpy")
    )
    plant, random = RobotPlant(frictional), np.random.default_rng(3)
    center, rpy = random.uniform(-0.5, 0.5, (3, 3)), random.uniform(-1.0, 1.0, (3, 3))
    center[0], rpy[0] = (1.2, 0.0, 0.1), (0.0, 0.1, 0.0)
    context, control = plant.CreateDefaultContext(), random.uniform(-30.0, 30.0, 2)
    degrees = plant.exogenous_layout.degrees  # In its plane the arm does not feel all of y''.
    columns = zip(np.hstack([center, rpy]).T, degrees, strict=True)
    moving = [number for column, degree in columns for number in column[: degree + 1]]
    plant.GetInputPort("exogenous").FixValue(context, moving)
    plant.GetInputPort("control").FixValue(context, control)
    state = plant.set_consistent_state(context, [1.2, -1.6, 0.3, 0.4])
    acceleration = plant.EvalTimeDerivatives(context).CopyToVector()[2:]
    force = plant.GetOutputPort("constraint_force").Eval(context)[0]

    drake = parse("two_link_arm")
    own, tool, world = (
        drake.CreateDefaultContext(),
        drake.GetFrameByName("tool"),
        drake.world_frame(),
    )
    drake.SetPositionsAndVelocities(own, state)
    place = drake.CalcPointsPositions(own, tool, np.zeros(3), world)[:, 0]
    J = drake.CalcJacobianTranslationalVelocity(
        own, JacobianWrtVariable.kV, tool, np.zeros(3), world, world
    )
    stands, before, after = (
        RollPitchYaw(rpy[0] + t * rpy[1]).ToRotationMatrix().matrix() for t in (0.0, -h, h)
    )
    normal = stands @ np.array([-1.0, 0.0, 0.0])
    surface = center[1] + (after - before) / (2.0 * h) @ stands.T @ (place - center[0])
    sliding = J @ state[2:] - surface
    assert abs(normal @ sliding) < 1e-6
    # Standing still it would slide otherwise.
    assert np.linalg.norm(sliding - (J @ state[2:] - center[1])) > 0.1
    pull = friction * force * sliding / np.sqrt(sliding @ sliding + speed**2)
    drag = viscous * sliding
    applied = MultibodyForces(drake)
    drake.CalcForceElementsContribution(own, applied)
    needed = drake.CalcInverseDynamics(own, acceleration, applied)
    given = drake.MakeActuationMatrix() @ control + J.T @ (normal * force - pull - drag)
    assert_allclose(needed, given, atol=1e-5)


def test_the_placement_is_that_of_the_parameters():
    """Roll, pitch and yaw are those of Drake's RollPitchYaw."""
    plate = arm_on_plate().constraints[0]
    values = np.array([0.1, 0.2, 0.3, 0.4, -0.5, 0.6])
    wanted = RigidTransform(RollPitchYaw(values[3:]), values[:3])
    assert plate.placement(values).IsNearlyEqualTo(wanted, 1e-15)


def test_what_moves_must_be_a_parameter_of_the_robot():
    with pytest.raises(ModelError, match=r"'plate\.positoin'"):
        arm_on_plate(exogenous=["plate.positoin"])
