"""Members of the families in simulations and closed loops, compared with closed forms.

Most of them the package does not know: each of these is one class in `members`.
"""

import casadi as ca
import numpy as np
import scipy.integrate
from arms import arm, consistent_states, fixed_step, parse
from members import TorqueLag

from drake_dae import (
    FixedDistance,
    FlexibleJoints,
    JointPositions,
    LinkExpressions,
    PointCoordinates,
    RobotModel,
    RobotPlant,
    find_structure,
    simulate,
)

GRAVITY = 9.81


def particle(mass=2.0, slope=0.0):
    """A point mass in the x-z plane, moved by a force along each axis; gravity leans to +x."""
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    weight = mass * GRAVITY * ca.SX([-np.sin(slope), np.cos(slope)])
    place = ca.vertcat(q[0], 0.0, q[1])
    return LinkExpressions(q, v, mass * ca.SX.eye(2), weight, frames={"bob": place})


def run(plant, state, duration, step=1e-3):
    """The state after a while without control."""
    context = plant.CreateDefaultContext()
    plant.GetInputPort("control").FixValue(context, np.zeros(plant.dae.num_controls))
    plant.set_state(context, state)
    simulate(plant, context, duration, fixed_step(step))
    return plant.state(context), plant.GetOutputPort("constraint_force").Eval(context)


# A constraint on positions: two points at a fixed distance.


def test_a_bob_on_a_rod_is_a_pendulum():
    """a'' = -g / l sin a, and the rod pulls with m (l a'^2 + g cos a). RK5 leaves 1e-12."""
    length, mass, duration = 0.7, 2.0, 1.3
    rod = FixedDistance("world", (0.0, 0.0, 1.0), "bob", (0.0, 0.0, 0.0), length)
    model = RobotModel(particle(mass), [rod], [JointPositions(["q0"])], [0.3, 0.4])
    structure = find_structure(model.dae)
    assert structure.constraint_degrees == (2,)
    assert structure.output_degrees == (2, 0)
    angle, speed = 0.8, -1.5
    place = [length * np.sin(angle), 1.0 - length * np.cos(angle)]
    rate = [length * speed * np.cos(angle), length * speed * np.sin(angle)]
    state, thrust = run(RobotPlant(model, structure=structure), [*place, *rate], duration)
    angle, speed = scipy.integrate.solve_ivp(
        lambda t, y: [y[1], -GRAVITY / length * np.sin(y[0])],
        (0.0, duration),
        [angle, speed],
        method="DOP853",
        rtol=1e-13,
        atol=1e-13,
    ).y[:, -1]
    np.testing.assert_allclose(
        state[:2], [length * np.sin(angle), 1.0 - length * np.cos(angle)], atol=1e-11
    )
    pull = mass * (length * speed**2 + GRAVITY * np.cos(angle))
    np.testing.assert_allclose(thrust, -pull, rtol=1e-10)


# A reaction of its own: friction.


# A constraint on velocities alone.


# A surface.


# A stage.


def lagging(*before):
    model = arm("two_link").model
    outputs = [PointCoordinates("tool", "z")]
    stages = [*before, TorqueLag([0.02, 0.03])]
    plant = parse("two_link_arm")
    return RobotModel.from_multibody(
        plant, model.constraints, outputs, [1.2, -1.6], "two_link_arm", stages
    )


def test_a_lag_adds_one_to_every_degree():
    for stages, degrees in (([], (3, 1)), ([FlexibleJoints(8e3, 1.0)], (5, 3))):
        structure = find_structure(lagging(*stages).dae)
        assert structure.constraint_degrees == (2,)
        assert structure.output_degrees == degrees


def test_a_lag_moves_as_it_says():
    """The torques of the state move the links, and tau' = (u - tau) / T."""
    model = lagging()
    plant = RobotPlant(model)
    context = plant.CreateDefaultContext()
    torque, u = np.array([30.0, -20.0]), np.array([7.0, 11.0])
    rigid = RobotPlant(arm("two_link").model)
    other = rigid.CreateDefaultContext()
    for link in consistent_states("two_link", 3):
        plant.set_state(context, [*link, *torque])
        plant.GetInputPort("control").FixValue(context, u)
        rigid.set_state(other, link)
        rigid.GetInputPort("control").FixValue(other, torque)
        rate = plant.EvalTimeDerivatives(context).CopyToVector()
        expected = rigid.EvalTimeDerivatives(other).CopyToVector()
        np.testing.assert_allclose(rate[:4], expected, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(rate[4:], (u - torque) / [0.02, 0.03], rtol=1e-12)
        shown = plant.GetOutputPort("lagged_torque").Eval(context)
        np.testing.assert_array_equal(shown, torque)
    names = [signal.name for signal in model.dae.state_signals[4:]]
    assert names == ["joint1_motor.torque", "joint2_motor.torque"]
