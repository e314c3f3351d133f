"""The port `constraint_wrenches`: a plant of Drake that feels it moves as the robot does.

A continuous MultibodyPlant knows no constraints; what it lacks are the wrenches of the port.
"""

import numpy as np
import pytest
from arms import parse
from members import FrictionalPoint
from numpy.testing import assert_allclose
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.multibody.tree import JacobianWrtVariable

from drake_dae import (
    JointPositions,
    Plane,
    PointCoordinates,
    PointOnSurface,
    RobotModel,
    RobotPlant,
    Sphere,
)
from drake_dae.robots import ConstraintSet, ConstraintWrenches, contact_normals


def accelerations(plant, q, v, u, wrenches, frames):
    """v' of a continuous MultibodyPlant, with wrenches at the origins of frames, by Drake."""
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    plant.get_actuation_input_port().FixValue(context, u)
    applied = []
    for name, wrench in zip(frames, wrenches.reshape(-1, 6), strict=True):
        *instance, own = name.split("::")
        frame = plant.GetFrameByName(own, *map(plant.GetModelInstanceByName, instance))
        force = ExternallyAppliedSpatialForce()
        force.body_index = frame.body().index()
        force.p_BoBq_B = frame.GetFixedPoseInBodyFrame().translation()
        force.F_Bq_W = SpatialForce(wrench[:3], wrench[3:])
        applied.append(force)
    plant.get_applied_spatial_force_input_port().FixValue(context, applied)
    return plant.EvalTimeDerivatives(context).CopyToVector()[q.size :]


def frames_of(block):
    return [signal.name.split(".")[1] for signal in block.wrench_signals[::6]]


def wall():
    return PointOnSurface("tool", Plane((1.2, 0, 0), (-1, 0, 0)), name="wall")


def rubbing_arm():
    contact = FrictionalPoint("tool", wall().surface, name="wall", coefficient=0.3, speed=0.05)
    plant = parse("two_link_arm")
    outputs = [PointCoordinates("tool", "z")]
    return RobotModel.from_multibody(plant, [contact], outputs, [1.2, -1.6])


def sphere_arm():
    contact = PointOnSurface("tool", Sphere((1.5, 0, 0.2), 0.4), name="ball")
    outputs = [JointPositions(["joint1"])]
    return RobotModel.from_multibody(parse("two_link_arm"), [contact], outputs, [1.2, -1.6])


def test_a_plant_that_feels_the_wrenches_moves_as_the_robot():
    """The names of `wrench_signals` are those of the frames; 1e-8 on up to 1e3 rad/s^2."""
    model = rubbing_arm()
    block = RobotPlant(model)
    plant, dae, random = model.links.plant, model.dae, np.random.default_rng(1)
    context = block.CreateDefaultContext()
    nominal = block.state(context)
    count = plant.num_positions()
    for _ in range(3):
        guess = nominal + 0.1 * random.standard_normal(nominal.size)
        state = block.set_consistent_state(context, guess)
        u = random.uniform(-20.0, 20.0, dae.num_controls)
        block.GetInputPort("control").FixValue(context, u)
        wrenches = block.GetOutputPort("constraint_wrenches").Eval(context)
        ours = block.EvalTimeDerivatives(context).CopyToVector()[count:]
        q, v = state[:count], state[count : 2 * count]
        drake = accelerations(plant, q, v, u, wrenches, frames_of(block))
        np.testing.assert_allclose(ours, drake, rtol=1e-8, atol=1e-8)
        assert np.abs(wrenches).max() > 1.0


@pytest.mark.parametrize("make", [rubbing_arm, sphere_arm], ids=["friction", "sphere"])
def test_normal_is_the_direction_in_which_the_residual_grows(make):
    """n = d phi / d(point), the tool's row of the constraint's Jacobian by MultibodyPlant: phi'
    is n . (J_point v) for any v, where friction does not enter; 1e-12 is round-off."""
    model = make()
    plant, rng = model.links.plant, np.random.default_rng(3)
    own = plant.CreateDefaultContext()
    normals, wrenches = contact_normals(model), ConstraintWrenches(model)
    kinematics = model.links.kinematics()
    rate = kinematics.value(ConstraintSet(model.constraints).rate(kinematics))
    rates = model.dae.trace("rate", {"value": rate})
    for _ in range(5):
        state = rng.normal(size=model.dae.num_states)
        plant.SetPositionsAndVelocities(own, state)
        (normal,) = normals(state, model.dae.parameter_values)
        (point,) = wrenches(state, [1.0]).points
        body = plant.GetFrameByName(wrenches.frames[0])
        seen = body.CalcPoseInWorld(own).inverse() @ point
        world = plant.world_frame()
        jacobian = plant.CalcJacobianTranslationalVelocity(
            own, JacobianWrtVariable.kV, body, seen, world, world
        )
        moving = jacobian @ plant.GetVelocities(own)
        assert_allclose(normal @ moving, rates(state, model.dae.parameter_values)[0], atol=1e-12)
