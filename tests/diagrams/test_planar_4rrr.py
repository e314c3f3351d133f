"""The shipped 4-RRR robot, four motors for three freedoms, against Newton and Euler by hand."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from runs import scenario

from drake_dae import build_scenario
from drake_dae.arrays import FloatArray

NAME = "planar_4rrr"
PROXIMAL, DISTAL = (0.25, 0.8, 0.015), (0.3, 0.5, 0.012)  # length m, mass kg, radius m
DISK = 1.2, 1.2 * 0.12**2 / 2  # kg, kg m^2
BASE, CORNER = 0.5, 0.12  # m from the middle
DIRECTIONS = np.deg2rad([45.0, 135.0, 225.0, 315.0])


def along(angle: FloatArray) -> FloatArray:
    return np.array([np.cos(angle), np.sin(angle)])


def across(angle: FloatArray) -> FloatArray:
    return np.array([-np.sin(angle), np.cos(angle)])


def moment(lever: FloatArray, force: FloatArray) -> float:
    return float(lever[0] * force[1] - lever[1] * force[0])


def about_centre(length: float, mass: float, radius: float) -> float:
    """Of a round rod, about an axis across it, kg m^2."""
    return mass * (3 * radius**2 + length**2) / 12


def leg(k: int, z: FloatArray, rate: FloatArray, second: FloatArray):
    """A leg's corner from the platform's middle, and its absolute angles with two derivatives."""
    turned = DIRECTIONS[k] + z[2]
    lever = CORNER * along(turned)
    apart = z[:2] + lever - BASE * along(DIRECTIONS[k])
    reach, (a, b) = np.hypot(*apart), (PROXIMAL[0], DISTAL[0])
    inner = np.arccos((reach**2 + a**2 - b**2) / (2 * reach * a))
    first = np.arctan2(apart[1], apart[0]) + inner
    angles = np.array([first, np.arctan2(*(apart - a * along(first))[::-1])])
    columns = np.array([a * across(angles[0]), b * across(angles[1])]).T
    rates = np.linalg.solve(columns, rate[:2] + CORNER * across(turned) * rate[2])
    corner_second = second[:2] + CORNER * across(turned) * second[2] - lever * rate[2] ** 2
    inward = a * along(angles[0]) * rates[0] ** 2 + b * along(angles[1]) * rates[1] ** 2
    return lever, angles, rates, np.linalg.solve(columns, corner_second + inward)


def by_hand(z: FloatArray, rate: FloatArray, second: FloatArray, weights, free):
    """Motor torques, shape (4,), and what the platform exerts on the legs, shape (8,).

    The platform moves as given. Its three equations and the moments of each distal link about its
    elbow are seven equations in the eight forces, so that one direction of them is open; the
    proximal links tell the torques of each, and the weights choose.
    """
    (a, m_1, _), (b, m_2, _) = PROXIMAL, DISTAL
    matrix, right, legs = np.zeros((7, 8)), np.zeros(7), []
    matrix[:2] = -np.tile(np.eye(2), 4)
    right[:3] = DISK[0] * second[0], DISK[0] * second[1], DISK[1] * second[2]
    for k in range(4):
        lever, angles, rates, accelerations = leg(k, z, rate, second)
        elbow = a * (across(angles[0]) * accelerations[0] - along(angles[0]) * rates[0] ** 2)
        own = across(angles[1]) * accelerations[1] - along(angles[1]) * rates[1] ** 2
        inertial = m_2 * (elbow + b / 2 * own)
        place = slice(2 * k, 2 * k + 2)
        matrix[2, place] = lever[1], -lever[0]
        matrix[3 + k, place] = b * across(angles[1])
        right[3 + k] = about_centre(*DISTAL) * accelerations[1]
        right[3 + k] += b / 2 * moment(along(angles[1]), inertial)
        legs.append((angles[0], accelerations[0], inertial))
    about_base = about_centre(*PROXIMAL) + m_1 * (a / 2) ** 2

    def torques(forces):
        return np.array(
            [
                about_base * acceleration + a * moment(along(angle), inertial - force)
                for (angle, acceleration, inertial), force in zip(
                    legs, forces.reshape(4, 2), strict=True
                )
            ]
        )

    forces, inner = np.linalg.lstsq(matrix, right)[0], np.linalg.svd(matrix)[2][-1]
    one, change = torques(forces), torques(forces + inner) - torques(forces)
    share = -(change * weights) @ (one - free) / ((change * weights) @ change)
    return one + share * change, forces + share * inner


def state_at(z: FloatArray, rate: FloatArray, second: FloatArray) -> FloatArray:
    positions, velocities = [*z], [*rate]
    for k in range(4):
        _, angles, rates, _ = leg(k, z, rate, second)
        bend = np.remainder(angles[1] - angles[0], 2 * np.pi) - 2 * np.pi
        positions += [angles[0], bend]
        velocities += [rates[0], rates[1] - rates[0]]
    return np.concatenate([positions, velocities])


@pytest.mark.slow
def test_the_law_and_the_pins_are_those_of_newton_and_euler():
    """Of all torques that move the platform so, those with the least weighted squares.

    To round-off: of torques up to 8 N m and forces up to 20 N, 3e-14.
    """
    loop, _ = build_scenario(scenario(NAME, "law.control_weights=[1, 2, 0.5, 3]"))
    plant, law, weights = loop.plant, loop.controller.law, np.array([1.0, 2.0, 0.5, 3.0])
    assert law.structure.output_degrees == (2, 2, 2)
    assert law.structure.zero_dynamics_dimension == 0
    assert law.structure.control_matrix.shape == (3, 4)
    context, random = plant.CreateDefaultContext(), np.random.default_rng(0)
    place = law.system.parameter_slice("free_control")
    for _ in range(6):
        z = random.uniform(-1.0, 1.0, 3) * [0.08, 0.08, 0.3]
        rate, target = random.uniform(-1.0, 1.0, 3), random.uniform(-1.0, 1.0, (3, 3))
        target[:, 0] = z + 0.05 * target[:, 0]
        second = target[:, 2] - 10.0 * (rate - target[:, 1]) - 25.0 * (z - target[:, 0])
        state, free = state_at(z, rate, second), random.uniform(-2.0, 2.0, 4)
        assert_allclose(law.structure.manifold.residual(state), 0.0, atol=1e-12)
        parameters = law.system.parameter_values
        parameters[place] = free
        control = law.control(state, target.reshape(-1), parameters=parameters)
        torques, forces = by_hand(z, rate, second, weights, free)
        assert_allclose(control, torques, atol=1e-11)
        plant.set_state(context, state)
        plant.GetInputPort("control").FixValue(context, control)
        assert_allclose(plant.GetOutputPort("constraint_force").Eval(context), forces, atol=1e-11)
        accelerations = plant.EvalTimeDerivatives(context).CopyToVector()[11:14]
        assert_allclose(accelerations, second, atol=1e-11)
