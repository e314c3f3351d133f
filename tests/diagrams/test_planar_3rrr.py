"""The shipped 3-RRR robot against Newton's and Euler's equations by hand, from its own pose up."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from runs import run_scenario, scenario

from drake_dae import build_scenario
from drake_dae.arrays import FloatArray

NAME = "planar_3rrr"

PROXIMAL, DISTAL = (0.25, 0.8, 0.015), (0.3, 0.5, 0.012)  # length m, mass kg, radius m
DISK = 1.2, 1.2 * 0.12**2 / 2  # kg, kg m^2
BASE, CORNER = 0.5, 0.12  # m from the middle
DIRECTIONS = np.deg2rad([90.0, 210.0, 330.0])


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
    corner_rate = rate[:2] + CORNER * across(turned) * rate[2]
    rates = np.linalg.solve(columns, corner_rate)
    corner_second = second[:2] + CORNER * across(turned) * second[2] - lever * rate[2] ** 2
    inward = a * along(angles[0]) * rates[0] ** 2 + b * along(angles[1]) * rates[1] ** 2
    return lever, angles, rates, np.linalg.solve(columns, corner_second + inward)


def by_hand(z: FloatArray, rate: FloatArray, second: FloatArray):
    """Motor torques, shape (3,), and what the platform exerts on the legs, shape (6,).

    The platform moves as given. Its three equations, and the moments of each distal link about its
    elbow, are six equations in the six forces; the proximal links then tell the torques.
    """
    (a, m_1, _), (b, m_2, _) = PROXIMAL, DISTAL
    matrix, right, legs = np.zeros((6, 6)), np.zeros(6), []
    matrix[:2] = -np.tile(np.eye(2), 3)
    right[:3] = DISK[0] * second[0], DISK[0] * second[1], DISK[1] * second[2]
    for k in range(3):
        lever, angles, _, accelerations = found = leg(k, z, rate, second)
        rates = found[2]
        elbow = a * (across(angles[0]) * accelerations[0] - along(angles[0]) * rates[0] ** 2)
        own = across(angles[1]) * accelerations[1] - along(angles[1]) * rates[1] ** 2
        inertial = m_2 * (elbow + b / 2 * own)
        place = slice(2 * k, 2 * k + 2)
        matrix[2, place] = lever[1], -lever[0]
        matrix[3 + k, place] = b * across(angles[1])
        right[3 + k] = about_centre(*DISTAL) * accelerations[1]
        right[3 + k] += b / 2 * moment(along(angles[1]), inertial)
        legs.append((angles[0], accelerations[0], inertial))
    forces = np.linalg.solve(matrix, right)
    torques = []
    for (angle, acceleration, inertial), force in zip(legs, forces.reshape(3, 2), strict=True):
        about_base = about_centre(*PROXIMAL) + m_1 * (a / 2) ** 2
        torques.append(about_base * acceleration + a * moment(along(angle), inertial - force))
    return np.array(torques), forces


@pytest.mark.slow
def test_the_law_and_the_pins_are_those_of_newton_and_euler():
    """The law of double poles at -5 asks for z'' = r'' - 10 e' - 25 e, and for nothing else.

    To round-off: of torques up to 8 N m and forces up to 20 N, 3e-14.
    """
    loop, _ = build_scenario(scenario(NAME))
    plant, law = loop.plant, loop.controller.law
    assert law.structure.constraint_degrees == (2,) * 6
    assert law.structure.output_degrees == (2, 2, 2)
    assert law.structure.zero_dynamics_dimension == 0
    context, random = plant.CreateDefaultContext(), np.random.default_rng(0)
    largest = 0.0
    for _ in range(6):
        z = random.uniform(-1.0, 1.0, 3) * [0.08, 0.08, 0.3]
        rate, target = random.uniform(-1.0, 1.0, 3), random.uniform(-1.0, 1.0, (3, 3))
        target[:, 0] = z + 0.05 * target[:, 0]
        second = target[:, 2] - 10.0 * (rate - target[:, 1]) - 25.0 * (z - target[:, 0])
        positions, velocities = [*z], [*rate]
        for k in range(3):
            _, angles, rates, _ = leg(k, z, rate, second)
            positions += [angles[0], np.remainder(angles[1] - angles[0], 2 * np.pi) - 2 * np.pi]
            velocities += [rates[0], rates[1] - rates[0]]
        state = np.concatenate([positions, velocities])
        assert_allclose(law.structure.manifold.residual(state), 0.0, atol=1e-12)
        torques, forces = by_hand(z, rate, second)
        control = law.control(state, target.reshape(-1))
        assert_allclose(control, torques, atol=1e-11)
        plant.set_state(context, state)
        plant.GetInputPort("control").FixValue(context, control)
        assert_allclose(plant.GetOutputPort("constraint_force").Eval(context), forces, atol=1e-11)
        accelerations = plant.EvalTimeDerivatives(context).CopyToVector()[9:12]
        assert_allclose(accelerations, second, atol=1e-11)
        largest = max(largest, np.abs(torques).max())
    assert largest > 1.0


@pytest.mark.slow
def test_it_keeps_its_prediction_within_what_its_motors_have():
    """The accuracy of 1e-8 in a step leaves some 1e-8 along the way.

    Torques stay below 3 N m, and the pins meet before each projection.
    """
    loop, _, record = run_scenario(scenario(NAME, "duration=3"))
    off = np.abs(record["tracking_error"] - loop.predicted_error(record))
    assert np.max(off) < 1e-7
    assert_allclose(record["tracking_error"][0], [-0.03, 0.02, 0.1], atol=1e-12)
    assert np.max(np.abs(record["tracking_error"][-1])) < 1e-5
    assert np.max(np.abs(record["constraint_residual"])) < 1e-9
    assert np.all(np.abs(record["control"]) < loop.plant.model.links.effort_limits)
    state = record["state"][-1]
    torques, forces = by_hand(state[:3], state[9:12], _accelerations(loop, record, -1))
    assert_allclose(record["control"][-1], torques, atol=1e-9)
    assert_allclose(record["constraint_force"][-1], forces, atol=1e-9)


def _accelerations(loop, record, row):
    """z'' that the law asks for, by its gains and the reference of the record."""
    state, target = record["state"][row], record["reference"][row].reshape(3, 3)
    return target[:, 2] - 10 * (state[9:12] - target[:, 1]) - 25 * (state[:3] - target[:, 0])
