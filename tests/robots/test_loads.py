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


def loaded(*loads, touches=True):
    """The two-link arm, on its wall or free, with loads."""
    known = arm("two_link").model
    parts = (known.constraints, known.outputs) if touches else ((), ())
    return RobotModel.from_multibody(parse("two_link_arm"), *parts, [1.2, -1.6], known_forces=loads)


@pytest.mark.parametrize("kind", [KnownForce, KnownWrench])
def test_a_load_acts_as_drake_applies_it(kind):
    """v' of a free arm with the same load as an ExternallyAppliedSpatialForce: round-off."""
    lever = np.array([0.05, 0.0, 0.1])
    plant = RobotPlant(loaded(kind("tool", tuple(lever), name="push"), touches=False))
    drake = parse("two_link_arm")
    force, state = np.array([3.0, -2.0, 7.0]), np.array([0.3, -1.1, 0.4, 0.7])
    moment = np.array([2.0, -5.0, 1.0]) if kind is KnownWrench else np.zeros(3)
    context = plant.CreateDefaultContext()
    plant.set_parameter(context, "push.force", force)
    if kind is KnownWrench:
        plant.set_parameter(context, "push.moment", moment)
    plant.set_state(context, state)
    plant.GetInputPort("control").FixValue(context, [1.0, -2.0])

    own = drake.CreateDefaultContext()
    drake.SetPositionsAndVelocities(own, state)
    drake.get_actuation_input_port().FixValue(own, [1.0, -2.0])
    frame = drake.GetFrameByName("tool")
    applied = ExternallyAppliedSpatialForce()
    applied.body_index = frame.body().index()
    applied.p_BoBq_B = frame.GetFixedPoseInBodyFrame() @ lever
    applied.F_Bq_W = SpatialForce(moment, force)
    drake.get_applied_spatial_force_input_port().FixValue(own, [applied])
    assert_allclose(
        plant.EvalTimeDerivatives(context).CopyToVector(),
        drake.EvalTimeDerivatives(own).CopyToVector(),
        rtol=1e-11,
    )


def test_frames_that_are_not_there_are_named():
    with pytest.raises(ModelError, match="'tol'"):
        loaded(KnownForce("tol"))
    settings = ["robot.known_forces=[{frame: tol}]"]
    with pytest.raises(ScenarioError, match=r"robot.known_forces.0: .*'tol'"):
        build_scenario(load_scenario(find_scenario("two_link_wall"), settings))


COULOMB, VISCOUS, SLOW = np.array([3.0, 0.5]), np.array([0.2, 0.1]), 0.01


def with_joint_friction(**more):
    """The two-link arm on its wall, with friction in its joints."""
    return loaded(JointFriction(["joint1", "joint2"], **more))


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
    with pytest.raises(ModelError, match=message):
        loaded(JointFriction(joints, **more))
