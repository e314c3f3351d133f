"""Surfaces that move along known signals, against MultibodyPlant and NumPy alone."""

import numpy as np
import pytest
from arms import parse, touching
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
