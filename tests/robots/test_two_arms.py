"""Two arms with flexible joints that hold one object: the largest law, against MultibodyPlant.

14 joints, 28 + 28 states, 6 constraints: 8 position outputs of degree 4 and 6 forces of degree 2.
"""

from functools import cache

import numpy as np
import pytest
from actuated import slope
from arms import fixed_step
from assigned_errors import closed_form, coupled, new_input
from pydrake.multibody.tree import JacobianWrtVariable
from two_arms import APART, NOMINAL, REFERENCES, two_arms

from drake_dae import (
    FlexibleJoints,
    RobotPlant,
    TrackingLaw,
    find_structure,
    make_closed_loop,
    poles,
    simulate,
)
from drake_dae.dae import gain_matrices

STIFFNESS = np.tile([2e4, 2e4, 1e4, 1e4, 5e3, 2e3, 2e3], 2)
START = [APART / 2 + 0.02, -0.03, 0.42, 0.03, -0.02, 0.04, 0.05, -0.06]
"""Outputs off the references, in m and rad."""


@cache
def flexible():
    model = two_arms([FlexibleJoints(STIFFNESS)])  # Rotor inertias: what the URDF says.
    return model, find_structure(model.dae)


class Truth:
    """z, z', z'' and lambda of the two arms, from MultibodyPlant and NumPy alone.

    [[M - M_2, -J^T], [J, 0]] (v', lambda) = (K_2 (q_2 - q) - H, -Jdot v), where J v is the velocity
    of the right tool in the object and M_2 the rotors, which turn with the shafts.
    """

    def __init__(self, plant):
        self.plant, self.context = plant, plant.CreateDefaultContext()
        actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
        self.rotors = np.array(
            [a.default_rotor_inertia() * a.default_gear_ratio() ** 2 for a in actuators]
        )
        self.box = plant.GetFrameByName("object")
        self.tool = plant.GetFrameByName("tool", plant.GetModelInstanceByName("right"))
        self.elbows = [
            plant.GetJointByName("joint3", plant.GetModelInstanceByName(side)).position_start()
            for side in ("left", "right")
        ]

    def links(self, q, v):
        """(M without rotors, H, J, Jdot v), and of the positions (z, P, Pdot v)."""
        plant, context, world = self.plant, self.context, self.plant.world_frame()
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        kind, origin = JacobianWrtVariable.kV, np.zeros(3)
        grasp = (context, kind, self.tool, origin, self.box, self.box)
        jacobian = np.roll(plant.CalcJacobianSpatialVelocity(*grasp), 3, axis=0)
        bias = np.roll(plant.CalcBiasSpatialAcceleration(*grasp).get_coeffs(), 3)
        moving = (context, kind, self.box, origin, world, world)
        turning, shifting = np.split(plant.CalcJacobianSpatialVelocity(*moving), 2)
        own = plant.CalcBiasSpatialAcceleration(*moving)
        pose = self.box.CalcPoseInWorld(context)
        omega, frame = turning @ v, pose.rotation().matrix()
        unit = np.eye(q.size)
        outputs, output_jacobian = [*pose.translation()], [*shifting]
        output_bias = [*own.translational()]
        for axis, component in ((0, 1), (0, 2), (1, 2)):
            a = frame[:, axis]
            outputs.append(a[component])
            output_jacobian.append(np.cross(turning.T, a)[:, component])
            change = np.cross(own.rotational(), a) + np.cross(omega, np.cross(omega, a))
            output_bias.append(change[component])
        for i in self.elbows:
            outputs.append(q[i])
            output_jacobian.append(unit[i])
            output_bias.append(0.0)
        mass = plant.CalcMassMatrix(context) - np.diag(self.rotors)
        force = plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context)
        position = tuple(map(np.array, (outputs, output_jacobian, output_bias)))
        return (mass, force, jacobian, bias), position

    def motion(self, x, u):
        """x' under a control, and (z'', lambda)."""
        q, v, q_2, v_2 = x.reshape(4, -1)
        (mass, force, jacobian, bias), (_, output_jacobian, output_bias) = self.links(q, v)
        spring = STIFFNESS * (q_2 - q)
        matrix = np.block([[mass, -jacobian.T], [jacobian, np.zeros((6, 6))]])
        right = np.concatenate([spring - force, -bias])
        acceleration, multiplier = np.split(np.linalg.solve(matrix, right), [q.size])
        rate = np.concatenate([v, acceleration, v_2, (u - spring) / self.rotors])
        return rate, np.concatenate([output_jacobian @ acceleration + output_bias, multiplier])

    def derivative(self, x, u, order):
        """(z'', lambda) differentiated `order` times along the motion."""
        rate, value = self.motion(x, u)
        if order == 0:
            return value
        # 10 mrad of the links, however fast the shafts are.
        step = 1e-2 * np.linalg.norm(rate) / np.linalg.norm(x.reshape(4, -1)[1])
        return slope(lambda x: self.derivative(x, u, order - 1), x, rate, step)

    def state(self, model, structure, random):
        """A state on N*, its joint torques those of links that accelerate with 3 rad/s^2."""
        spread = np.repeat([0.1, 0.5, 0.0, 0.0], 14)
        guess = model.dae.nominal_state + spread * random.standard_normal(56)
        q, v = structure.manifold.project(guess)[:28].reshape(2, -1)
        (mass, force, jacobian, _), _ = self.links(q, v)
        torque = mass @ (3.0 * random.standard_normal(14)) + force
        torque -= jacobian.T @ (10.0 * random.standard_normal(6))
        rate = (mass @ (10.0 * random.standard_normal(14))) / STIFFNESS
        return np.concatenate([q, v, q + torque / STIFFNESS, v + rate])


@pytest.mark.slow
def test_law_commands_the_highest_derivatives():
    """z^(4) and lambda'' under u are r^(mu) - sum Lambda_k+1 (z^(k) - r^(k)), for full Lambda.

    Two levels of differences along the motion of MultibodyPlant leave 3e-9 of the whole.
    """
    model, structure = flexible()
    assert structure.constraint_degrees == (2,) * 6
    assert structure.output_degrees == (4,) * 8 + (2,) * 6
    assert structure.zero_dynamics_dimension == 0
    np.testing.assert_array_equal(model.links.actuation_matrix, np.eye(14))
    truth, random = Truth(model.links.plant), np.random.default_rng(11)
    gains, force_gains = coupled(4, 8, random), coupled(2, 6, random)
    law = TrackingLaw(model.dae, gain_matrices(gains, force_gains), structure=structure)
    for _ in range(3):
        x = truth.state(model, structure, random)
        reference = random.standard_normal(8 * 5 + 6 * 3)
        u = law.control(x, reference)
        outputs, output_jacobian, _ = truth.links(*x[:28].reshape(2, -1))[1]
        second, third, fourth = (truth.derivative(x, u, order) for order in range(3))
        chain = [outputs, output_jacobian @ x[14:28], second[:8], third[:8], fourth[:8]]
        forces = [second[8:], third[8:], fourth[8:]]
        for found, own, r in (
            (chain, gains, reference[:40]),
            (forces, force_gains, reference[40:]),
        ):
            wanted = new_input(r, own, found[:-1])
            scale = np.linalg.norm(wanted)
            np.testing.assert_allclose(found[-1], wanted, rtol=0, atol=1e-7 * scale)


@pytest.mark.slow
def test_errors_are_their_closed_forms():
    """All positions off by cm, all forces off by some N, poles at -14 and -20.

    RK5 at 2.5 ms leaves 1e-9 of an error's start, and 30 times as much at twice the step.
    """
    model, structure = flexible()
    names = [signal.name for signal in model.dae.output_signals]
    poles_of = dict.fromkeys(names, -14.0) | {name: -20.0 for name in names[8:]}
    law = TrackingLaw(model.dae, poles(poles_of), structure=structure)
    loop = make_closed_loop(
        RobotPlant(model, structure=structure),
        law,
        REFERENCES,
    )
    context = loop.diagram.CreateDefaultContext()
    q = model.configuration(START, NOMINAL)
    start = model.rest_state(q, [35.0, 3.0, -4.0, 0.5, -0.6, 0.4])
    loop.plant.set_state(loop.plant.GetMyMutableContextFromRoot(context), start)
    simulate(loop.diagram, context, 0.5, fixed_step(2.5e-3))
    record = loop.record(context)
    predicted = loop.predicted_error(record)
    first, worst = 0, []
    for i, degree in enumerate(law.degrees):
        error = record["tracking_error"][:, i]
        # At rest the derivatives of an output vanish: those of its error are the reference's.
        rest = -record["reference"][0, first + 1 : first + degree]
        exact = closed_form(poles_of[names[i]], [error[0], *rest], record.time)
        scale = np.max(np.abs(exact))
        np.testing.assert_allclose(predicted[:, i], exact, rtol=0, atol=1e-10 * scale)
        worst.append(np.max(np.abs(error - exact)) / np.abs(error[0]))
        first += degree + 1
    assert np.min(np.abs(record["tracking_error"][0, :8])) > 0.015
    assert np.min(np.abs(record["tracking_error"][0, 8:])) > 0.3
    assert np.max(worst) < 2e-8
    assert np.max(np.abs(record["tracking_error"][-1] / record["tracking_error"][0])) < 0.2
    assert np.max(np.abs(record["constraint_residual"])) < 1e-9
