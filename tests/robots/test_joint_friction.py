"""Friction of joints, against Coulomb's law and an implicit step by MultibodyPlant."""

import casadi as ca
import numpy as np
import pytest
from arms import arm, numbers, parse
from numpy.testing import assert_allclose
from pydrake.systems.analysis import Simulator

from drake_dae import CompliantPlant, JointFriction, RobotModel
from drake_dae.errors import ModelError
from drake_dae.systems import PointMaterial

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
