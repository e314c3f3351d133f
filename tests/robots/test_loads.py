"""Known forces on frames and friction of joints, against MultibodyPlant and Coulomb's law."""

import casadi as ca
import numpy as np
import pytest
from arms import arm, numbers, parse
from numpy.testing import assert_allclose
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.systems.analysis import Simulator

from drake_dae import CompliantPlant, JointFriction, RobotModel, RobotPlant, load_scenario
from drake_dae.errors import ModelError, ScenarioError
from drake_dae.robots import KnownForce, KnownWrench
from drake_dae.scenario.build import build_scenario
from drake_dae.scenario.shipped import find_scenario
from drake_dae.systems import PointMaterial


def pushed(exogenous=(), frame="tool", actuation=()):
    """The two-link arm on its wall with a known force on its tool."""
    known = arm("two_link").model
    load = KnownForce(frame, (0.05, 0.0, 0.1), name="push")
    return RobotModel.from_multibody(
        parse("two_link_arm"),
        known.constraints,
        known.outputs,
        [1.2, -1.6],
        actuation=actuation,
        exogenous=exogenous,
        known_forces=[load],
    )


def test_a_force_acts_as_drake_applies_it():
    """v' of a free arm with the same force as an ExternallyAppliedSpatialForce: round-off."""
    known = arm("two_link").model
    model = RobotModel.from_multibody(
        parse("two_link_arm"),
        [],
        known.outputs[:0],
        [1.2, -1.6],
        known_forces=pushed().known_forces,
    )
    plant, drake = RobotPlant(model), parse("two_link_arm")
    force, state = np.array([3.0, -2.0, 7.0]), np.array([0.3, -1.1, 0.4, 0.7])
    context = plant.CreateDefaultContext()
    plant.set_parameter(context, "push.force", force)
    plant.set_state(context, state)
    plant.GetInputPort("control").FixValue(context, [1.0, -2.0])

    own = drake.CreateDefaultContext()
    drake.SetPositionsAndVelocities(own, state)
    drake.get_actuation_input_port().FixValue(own, [1.0, -2.0])
    frame = drake.GetFrameByName("tool")
    applied = ExternallyAppliedSpatialForce()
    applied.body_index = frame.body().index()
    applied.p_BoBq_B = frame.GetFixedPoseInBodyFrame() @ np.array([0.05, 0.0, 0.1])
    applied.F_Bq_W = SpatialForce(np.zeros(3), force)
    drake.get_applied_spatial_force_input_port().FixValue(own, [applied])
    assert_allclose(
        plant.EvalTimeDerivatives(context).CopyToVector(),
        drake.EvalTimeDerivatives(own).CopyToVector(),
        rtol=1e-11,
    )


def test_a_wrench_acts_as_a_force_at_another_point_of_the_link():
    """v' of the arm on its wall: round-off."""
    known, levers = arm("two_link").model, (np.zeros(3), np.array([0.05, 0.0, 0.1]))
    force, state = np.array([3.0, -2.0, 7.0]), known.configuration([0.3], [1.2, -1.6])
    found = []
    for lever, kind in zip(levers, (KnownWrench, KnownForce), strict=True):
        load = kind("tool", lever, name="push")
        model = RobotModel.from_multibody(
            parse("two_link_arm"),
            known.constraints,
            known.outputs,
            [1.2, -1.6],
            known_forces=[load],
        )
        plant = RobotPlant(model)
        context = plant.CreateDefaultContext()
        plant.set_parameter(context, "push.force", force)
        if kind is KnownWrench:
            rotation = model.links.rotation("tool")
            turned = ca.Function("R", [model.links.q], [rotation])(state).full()
            plant.set_parameter(context, "push.moment", np.cross(turned @ levers[1], force))
        plant.set_state(context, [*state, 0.0, 0.0])
        plant.GetInputPort("control").FixValue(context, [1.0, -2.0])
        rate = plant.EvalTimeDerivatives(context).CopyToVector()
        found.append(np.append(rate, plant.GetOutputPort("constraint_force").Eval(context)))
    assert_allclose(found[0], found[1], rtol=1e-11, atol=1e-12)
    assert np.abs(found[0]).max() > 0.1


def test_frames_that_are_not_there_are_named():
    with pytest.raises(ModelError, match="'tol'"):
        pushed(frame="tol")
    settings = ["robot.known_forces=[{frame: tol}]"]
    with pytest.raises(ScenarioError, match=r"robot.known_forces.0: .*'tol'"):
        build_scenario(load_scenario(find_scenario("two_link_wall"), settings))


COULOMB, VISCOUS, SLOW = np.array([3.0, 0.5]), np.array([0.2, 0.1]), 0.01


def with_joint_friction(**more):
    """The two-link arm on its wall, with friction in its joints."""
    known = arm("two_link").model
    joints = JointFriction(["joint1", "joint2"], **more)
    return RobotModel.from_multibody(
        parse("two_link_arm"), known.constraints, known.outputs, [1.2, -1.6], known_forces=[joints]
    )


def added(model, velocities):
    """The generalized force that friction adds, shape (2,)."""
    plain = arm("two_link").model
    forces = []
    for robot in (model, plain):
        f = ca.Function("f", [robot.dae.state, robot.dae.parameter_symbol], [robot.dae.f])
        state = np.array([1.2, -1.6, *velocities])
        force = f(ca.DM(state), ca.DM(robot.dae.parameter_values))
        forces.append(np.ravel(force.full())[2:])
    return forces[0] - forces[1]


@pytest.mark.parametrize("velocities", [(0.3, -0.2), (0.0, 0.0), (-1e-3, 2.0)])
def test_joints_have_coulomb_and_viscous_friction(velocities):
    """Within round-off of torques of up to 100 N m."""
    model = with_joint_friction(coulomb=COULOMB, viscous=VISCOUS, stiction_tolerance=SLOW)
    v = np.array(velocities)
    expected = -COULOMB * v / np.hypot(v, SLOW) - VISCOUS * v
    assert_allclose(added(model, v), expected, atol=1e-12)


def test_a_discrete_plant_takes_friction_implicitly():
    """A step off the wall is (M + h D) (v_+ - v) = h (tau - H - D v), with Drake's M and H.

    D is that of the velocities before the step. Within round-off of a 20 kg m^2 arm.
    """
    slow, h, torque = 1e-5, 1e-3, np.array([40.0, -10.0])
    model = with_joint_friction(coulomb=COULOMB, viscous=VISCOUS, stiction_tolerance=slow)
    plant = CompliantPlant(model, PointMaterial(h, stiffness=1e5, radius=1e-5))
    q, v = np.array([1.4, -2.1]), np.array([0.02, -1e-4])  # The tool is 0.25 m from the wall.
    context = plant.CreateDefaultContext()
    plant.set_state(context, np.concatenate([q, v]))
    plant.GetInputPort("control").FixValue(context, torque)
    known = numbers("two_link", q, v)
    D = np.diag(COULOMB / np.hypot(v, slow) + VISCOUS)
    change = np.linalg.solve(known.mass + h * D, h * (torque - known.bias - D @ v))
    Simulator(plant, context).AdvanceTo(h / 2.0)
    after = plant.state(context)[2:]
    assert_allclose(after, v + change, rtol=1e-10)


@pytest.mark.parametrize(
    ("joints", "more", "message"),
    [
        (["joint9"], {}, "joint9"),
        ([], {}, "joints"),
        (["joint1", "joint1"], {}, "joint1"),
        (["joint1"], {"coulomb": -1.0}, "coulomb"),
        (["joint1"], {"coulomb": [1.0, 2.0]}, "coulomb"),
        (["joint1"], {"stiction_tolerance": 0.0}, "stiction_tolerance"),
    ],
)
def test_friction_that_makes_no_sense_is_refused(joints, more, message):
    known = arm("two_link").model
    with pytest.raises(ModelError, match=message):
        RobotModel.from_multibody(
            parse("two_link_arm"),
            known.constraints,
            known.outputs,
            [1.2, -1.6],
            known_forces=[JointFriction(joints, **more)],
        )
