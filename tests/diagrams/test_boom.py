"""The shipped boom with a linear actuator against Lagrange's equation in its one coordinate."""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from runs import run_scenario, scenario

from drake_dae import build_scenario
from drake_dae.errors import ScenarioError
from drake_dae.scenario.judging import find_feasibility

NAME = "boom"
HINGE, FOOT, LUG, DAMPING = np.array([0.0, 0.8]), np.array([0.3, 0.0]), 0.7, 40.0


def rod(mass, length, radius, end, along, rate):
    """Kinetic and potential energy of a uniform round rod from its end, in the x-z plane.

    Args:
        end, along: Where it begins, and its direction, shape (2, 1).
        rate: The time derivative of an expression.
    """
    centre = end + along * length / 2
    moving, turning = rate(centre), rate(along)
    inertia = mass * (3 * radius**2 + length**2) / 12
    energy = mass / 2 * ca.sumsqr(moving) + inertia / 2 * ca.sumsqr(turning)
    return energy, mass * 9.81 * centre[1]


def lagrange():
    """(angle, rate, acceleration) -> the actuator's force, its length, and the length's rate."""
    angle, speed, second = (ca.SX.sym(name) for name in ("angle", "speed", "second"))

    def rate(expression):
        return ca.jtimes(expression, angle, speed)

    boom = ca.vertcat(ca.cos(angle), ca.sin(angle))
    lug = HINGE + LUG * boom
    length = ca.norm_2(lug - FOOT)
    along = (lug - FOOT) / length
    parts = [
        rod(12.0, 2.0, 0.04, ca.SX(HINGE), boom, rate),
        rod(3.0, 0.5, 0.03, ca.SX(FOOT), along, rate),
        rod(2.0, 0.5, 0.015, lug - 0.5 * along, along, rate),
    ]
    kinetic, potential = (sum(part[k] for part in parts) for k in (0, 1))
    momentum = ca.jacobian(kinetic, speed)
    force = rate(momentum) + ca.jtimes(momentum, speed, second)
    force += -ca.jacobian(kinetic, angle) + ca.jacobian(potential, angle)
    lever = ca.jacobian(length, angle)
    needed = force / lever + DAMPING * rate(length)
    return ca.Function("lagrange", [angle, speed, second], [needed, length, rate(length)])


@pytest.mark.slow
def test_the_actuator_pushes_as_lagrange_says_and_the_prediction_is_kept():
    """The accuracy of 1e-8 in a step leaves some 1e-9 along the way; forces up to 300 N."""
    loop, _, record = run_scenario(scenario(NAME, "duration=2"))
    off = np.abs(record["tracking_error"] - loop.predicted_error(record))
    assert np.max(off) < 1e-8
    assert record["tracking_error"][0, 0] == pytest.approx(0.05, abs=1e-12)
    law, by_hand = loop.controller.law, lagrange()
    assert law.structure.constraint_degrees == (2, 2)
    assert law.structure.output_degrees == (2,)
    for row in range(0, len(record.time), 10):
        (angle, speed), target = record["state"][row][[0, 3]], record["reference"][row]
        names = [s.name for s in loop.plant.dae.state_signals]
        assert (names[0], names[3]) == ("boom", "boom_w")
        second = target[2] - 8.0 * (speed - target[1]) - 16.0 * (angle - target[0])
        force, length, rate = (float(value) for value in by_hand(angle, speed, second))
        assert record["control"][row, 0] == pytest.approx(force, rel=1e-9)
        assert_allclose(record["loop_state"][row], [length, rate], rtol=1e-9, atol=1e-10)
    assert np.abs(record["constraint_residual"]).max() < 1e-9


@pytest.mark.slow
def test_limits_of_the_actuator_are_reported_before_it_runs():
    report = find_feasibility(scenario(NAME, "constraints.0.upper=1.05", "duration=6"))
    assert any("actuator.travel" in problem for problem in report.problems)
    assert not find_feasibility(scenario(NAME, "duration=6")).problems
    weak = find_feasibility(scenario(NAME, "constraints.0.effort_limit=200", "duration=6"))
    assert any("actuator.motor" in problem for problem in weak.problems)


def test_stages_do_not_reach_a_motor_in_a_loop():
    text = "actuation=[{_tag: '!FlexibleJoints', stiffness: 100.0}]"
    with pytest.raises(ScenarioError, match="actuation"):
        build_scenario(scenario(NAME, text))
