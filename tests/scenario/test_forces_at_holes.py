"""The forces of a tool at a hole, which `analyze` predicts."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from runs import scenario
from scipy.integrate import solve_ivp

from drake_dae import Insert
from drake_dae.scenario.feasibility.feasibility import find_feasibility
from drake_dae.scenario.feasibility.holes import ToolAtHole, fall_speed

PHASE = Insert(depth=0.01, speed=0.02, lag=0.004)


def random_tool(seed, rows):
    """A tool of a random robot of seven joints, and its M^-1."""
    draw = np.random.default_rng(seed)
    factor = draw.normal(size=(7, 7))
    mobility = factor @ factor.T + 0.5 * np.eye(7)
    jacobian, outputs = draw.normal(size=(rows, 7)), draw.normal(size=(7, 7))
    stiff = 20.0 * np.eye(7) + draw.normal(size=(7, 7))
    damped = draw.normal(size=7)
    tool = ToolAtHole(jacobian, mobility @ jacobian.T, outputs, stiff, damped, 0.0, 0.0)
    return tool, mobility


@pytest.mark.parametrize("rows", [3, 5])
def test_no_tool_that_stands_still_presses_harder(rows):
    """Against the balance of joint torques in 3,000 random positions of the hole.

    The law commands M P^-1 of -A_0 e - A_1 e', and the tool stands still under it with J^T f; the
    unknowns are f and the joints' way from where the outputs rest. The largest one of them comes
    within 5 % of the bound, whose polygons are 1 % wider than the circles.
    """
    tool, mobility = random_tool(3, rows)
    P, J, mass = tool.outputs, tool.jacobian, np.linalg.inv(mobility)
    to_torque, aside, tilt = mass @ np.linalg.inv(P), 0.002, 0.03
    balance = np.block([[to_torque @ tool.stiff @ P, -J.T], [J, np.zeros((rows, rows))]])
    bound = tool.standing(PHASE, aside, tilt)
    draw, largest = np.random.default_rng(0), 0.0
    for _ in range(3000):
        circles = [
            size * np.array([np.cos(angle), np.sin(angle)])
            for size, angle in zip((aside, tilt), draw.uniform(0.0, 2.0 * np.pi, 2), strict=True)
        ]
        lag = draw.choice([0.0, PHASE.lag])
        held = np.concatenate([[lag], *circles])[:rows]
        known = np.concatenate([-to_torque @ tool.damped * PHASE.speed, held])
        force = np.linalg.solve(balance, known)[7 : 7 + 3]
        largest = max(largest, float(np.linalg.norm(force)))
    assert 0.95 * bound.force < largest < bound.force
    assert (bound.lag, bound.aside, bound.tilt) == (PHASE.lag, aside, tilt)


@pytest.mark.parametrize("damping", [0.0, 1e-7, 5.0, 400.0])
def test_the_speed_of_a_damped_fall(damping):
    """By an integrator of SciPy, to ten digits."""

    def down(_, way):
        return way[0] - 3e-4

    down.terminal = True
    fell = solve_ivp(
        lambda _, y: [y[1], 0.8 - damping * y[1]],
        (0.0, 10.0),
        [0.0, 0.0],
        events=down,
        rtol=1e-12,
        atol=1e-15,
        max_step=1.0 / max(damping, 10.0),
    )
    assert_allclose(fall_speed(0.8, damping, 3e-4), fell.y_events[0][0, 1], rtol=1e-8)


@pytest.mark.slow
def test_the_forces_of_the_shipped_peg():
    """Its hole is tilted by 1 degree, has a chamfer of 1 mm and 0.05 mm of clearance.

    A peg that lags pushes along the hole by at least m (p^2 lag + 2 p v), with 33 kg and p = 8/s.
    """
    needs = find_feasibility(scenario("peg_in_hole")).task
    assert needs.problems == ()
    search, insert = needs.holes
    assert (search.phase, insert.phase) == ("Search", "Insert")
    assert 4.0 < search.hit < 15.0
    phase = scenario("peg_in_hole").task.phases[-1]
    tilted = np.hypot(0.014, 0.0105)
    assert_allclose(insert.standing.tilt, tilted + 1e-4 / phase.depth, rtol=1e-3)
    comes_to_rest = 0.006 * phase.over / 2.0
    assert_allclose(
        insert.standing.aside, 1.05e-3 + comes_to_rest + tilted * phase.depth, rtol=1e-3
    )
    push = insert.mass * (64.0 * phase.lag + 16.0 * phase.speed)
    assert push < insert.standing.force < 1.5 * push
    assert f"presses with {insert.standing.force:.3g} N at most" in "\n".join(needs.lines)
