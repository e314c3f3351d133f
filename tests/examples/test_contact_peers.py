"""The laws that `examples/contact_peers` compares with, by other routes, and its table."""

from dataclasses import replace

import numpy as np
import pytest
from arms import parse
from contact_peers.joint_laws import InverseDynamics, JointStiffness
from contact_peers.laws import LAWS
from contact_peers.measure import FAILED, Figures, run_law
from contact_peers.plants import CONDITIONS, FRICTION
from contact_peers.robot import NORMAL, WALL, Goals, Robot
from contact_peers.search import load_gains
from contact_peers.table import FIGURES, OURS, ROWS, Row, better, load_rows, page, short, table
from contact_peers.task_laws import (
    Hybrid,
    ImpedanceWithObserver,
    LeastSquares,
    least_squares,
    modal_damping,
    operational,
)
from numpy.testing import assert_allclose
from pydrake.multibody.tree import MultibodyForces

HELD = np.array([0.0, -0.1938, 0.0, -1.936, 0.0, 0.559, 0.0])


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot(parse("seven_joint_arm"))


@pytest.fixture
def state() -> np.ndarray:
    random = np.random.default_rng(0)
    return np.concatenate([HELD + 0.2 * random.normal(size=7), random.normal(size=7)])


def reference(time: float) -> np.ndarray:
    """R of the circle: y, z, the axis, two joints, each with two derivatives; and the force."""
    turning = np.array([np.sin(time), np.cos(time), -np.sin(time), -np.cos(time)])
    rows = np.zeros((6, 3))
    rows[0], rows[1] = 0.1 * turning[:3], 0.1 * turning[1:]
    rows[1, 0] += 0.6
    return np.append(rows.ravel(), 20.0 + 5.0 * np.sin(2.0 * time))


def test_robot_is_that_of_multibody_plant(robot, state):
    """M v' + bias is Drake's inverse dynamics, and J v, J v' + drift are derivatives."""
    found, acceleration = robot.at(state), np.linspace(-1.0, 1.0, 7)
    context = robot.plant.CreateDefaultContext()
    robot.plant.SetPositionsAndVelocities(context, state)
    forces = MultibodyForces(robot.plant)
    robot.plant.CalcForceElementsContribution(context, forces)
    needed = robot.plant.CalcInverseDynamics(context, acceleration, forces)
    assert_allclose(found.mass @ acceleration + found.bias, needed, atol=1e-9)

    def later(time):
        q = state[:7] + time * state[7:] + 0.5 * time**2 * acceleration
        return robot.at(np.concatenate([q, state[7:] + time * acceleration]))

    # Differences of second order: 1e-5 squared by derivatives of some tens.
    before, after = later(-1e-5), later(1e-5)
    assert_allclose((after.position - before.position) / 2e-5, found.velocity, atol=1e-7)
    slope = (after.velocity - before.velocity) / 2e-5
    assert_allclose(slope, found.jacobian @ acceleration + found.drift, atol=1e-6)


def test_goals_in_joints_are_the_task(robot):
    goals = Goals(robot, HELD, FRICTION)
    now, before, after = (goals.at(reference(time)) for time in (1.0, 0.9999, 1.0001))
    there = robot.at(np.concatenate([now.q, now.v]))
    assert_allclose(there.position, [WALL, *reference(1.0)[[0, 3]], 0.0, 0.0], atol=1e-11)
    assert_allclose(there.velocity, now.velocity, atol=1e-11)
    # Differences of second order of functions with derivatives of about one.
    assert_allclose((after.q - before.q) / 2e-4, now.v, atol=1e-7)
    assert_allclose((after.v - before.v) / 2e-4, now.acceleration_of_joints, atol=1e-7)
    # The wall pushes back, with friction against the motion.
    assert_allclose(now.contact @ NORMAL, now.force, rtol=1e-12)
    along = now.velocity[1:3] / np.linalg.norm(now.velocity[1:3])
    assert_allclose(now.contact[1:], -FRICTION * now.force * along, rtol=1e-3)


def test_operational_forces_give_their_accelerations_and_no_others(robot, state):
    """J v' + J' v = Lambda^-1 f + J' v whatever is free, by M v' + bias = u + J_p^T F."""
    found, random = robot.at(state), np.random.default_rng(1)
    forces, free, contact = (random.normal(size=size) for size in (5, 7, 3))
    u = operational(found, forces, free, contact)
    pull = u - found.bias + found.jacobian[:3].T @ contact
    acceleration = np.linalg.solve(found.mass, pull)
    wanted = found.jacobian @ np.linalg.solve(found.mass, found.jacobian.T @ forces)
    assert_allclose(found.jacobian @ acceleration, wanted, atol=1e-9)


def test_least_squares_is_that_of_the_null_space(robot, state):
    """Against lstsq over what the contact leaves free; the weight costs six digits of sixteen."""
    found, random = robot.at(state), np.random.default_rng(2)
    rows, wanted, held = found.jacobian[1:], random.normal(size=4), random.normal(size=1)
    normal, free, per_force = found.jacobian[:1], random.normal(size=7), random.normal(size=7)
    u = least_squares(found, (rows, wanted), (normal, held), free, per_force, 12.0)
    particular = np.linalg.lstsq(normal, held, rcond=None)[0]
    basis = np.linalg.svd(normal)[2][1:].T
    stacked = np.vstack([rows, 1e-2 * np.eye(7)])
    right = np.concatenate([wanted, 1e-2 * free]) - stacked @ particular
    rest = np.linalg.lstsq(stacked @ basis, right, rcond=None)[0]
    acceleration = particular + basis @ rest
    assert_allclose(u, found.mass @ acceleration + found.bias - 12.0 * per_force, atol=1e-7)


def test_modes_of_an_impedance_have_their_damping_ratio(robot, state):
    """Lambda s^2 + D s + K has its zeros at an angle from the negative axis with cosine 0.7."""
    inertia, stiffness = robot.at(state).inertia, np.array([1e2, 1e4, 2e4, 30.0, 40.0])
    damping = modal_damping(inertia, stiffness, 0.7)
    lower = np.linalg.solve(inertia, np.hstack([-np.diag(stiffness), -damping]))
    zeros = np.linalg.eigvals(np.vstack([np.eye(5, 10, 5), lower]))
    # Eigenvalues of a matrix that is not normal; 1e-9 measured.
    assert_allclose(-zeros.real / np.abs(zeros), 0.7, atol=1e-6)


@pytest.mark.parametrize("law", [InverseDynamics, LeastSquares, JointStiffness])
def test_law_on_its_goal_asks_for_what_the_motion_takes(robot, law):
    """u = M v' + bias - J_p^T F; a stiffness knows neither M v' nor Coriolis forces."""
    goals, time = Goals(robot, HELD, FRICTION), 0.7
    goal = goals.at(reference(time))
    limits = law.LIMITS
    built = law(robot, goals, {name: low for name, (low, _) in limits.items()}, np.zeros(14))
    context = built.CreateDefaultContext()
    there = np.concatenate([goal.q, goal.v])
    built.GetInputPort("estimated_state").FixValue(context, there)
    built.GetInputPort("reference").FixValue(context, reference(time))
    if built.HasInputPort("measured_force"):
        built.GetInputPort("measured_force").FixValue(context, [0.0])
    found = robot.at(there)
    wanted = -found.jacobian[:3].T @ goal.contact
    if law is JointStiffness:
        wanted += robot.at(np.concatenate([goal.q, np.zeros(7)])).bias
    else:
        wanted += found.mass @ goal.acceleration_of_joints + found.bias
    assert_allclose(built.GetOutputPort("control").Eval(context), wanted, atol=1e-7)


@pytest.mark.thorough
def test_force_of_the_hybrid_law_converges():
    """State and reference are of one instant: the tool goes on by 0.1 mm in a sample."""
    found = run_law(CONDITIONS[0], Hybrid, load_gains()[_name(Hybrid)], FRICTION, 1.3, 1.0)
    assert found.position < 0.03
    assert found.force < 0.1


def _name(law: type) -> str:
    return next(name for name, one in LAWS.items() if one is law)


def test_table_reports_what_is_lost_and_what_is_better():
    good, bad = Figures(0.01, 0.02, 0.3, 0.0), Figures(0.5, 0.004, 0.2, 0.0)
    titles = [condition.title for condition in CONDITIONS]
    rows = [
        Row("hybrid", True, dict.fromkeys(titles, bad)),
        Row("admittance", True, dict.fromkeys(titles, FAILED)),
        Row(OURS, True, dict.fromkeys(titles, good)),
        Row(OURS, False, dict.fromkeys(titles, good)),
    ]
    shown = table(rows)
    assert "| hybrid | 0.5 / **0.004** |" in shown
    assert "| admittance | lost |" in shown
    assert f"| {OURS} | **0.01** / 0.02 |" in shown
    (line,) = better(rows)
    assert line.startswith("- hybrid, friction known, force: point 1e5 N/m (0.004 against 0.02)")
    assert [short(value) for value in (31.94, 9.96, 0.0123, 7.1)] == ["32", "10", "0.012", "7.1"]
    assert replace(good, open=0.2).is_lost


def test_a_momentum_observer_finds_a_torque_that_nothing_explains(robot):
    """Controls are late by a sample. The velocity moves in one configuration.

    200 samples at 50 1/s leave 5e-5 of the torque, and so small a one no Coriolis forces.
    """
    gains = {name: low for name, (low, _) in ImpedanceWithObserver.LIMITS.items()}
    start = np.concatenate([HELD, np.zeros(7)])
    goals = Goals(robot, HELD, 0.0)
    law = ImpedanceWithObserver(robot, goals, gains | {"observer": 50.0}, start)
    rows = np.zeros((6, 3))
    rows[:, 0] = [*robot.at(start).position[1:], *HELD[[2, 6]]]
    goal, d = (
        goals.at(np.append(rows.ravel(), 20.0)),
        0.01 * np.array([3.0, -2.0, 1.0, 0.5, -0.5, 0.2, 0.1]),
    )
    memory, v, controls, force = np.zeros(29), np.zeros(7), [np.zeros(7)] * 2, goal.force
    for _ in range(200):
        now = robot.at(np.concatenate([HELD, v]))
        controls.append(law.control(now, goal, force, memory))
        memory = law.next_memory(now, goal, force, memory)
        push = now.jacobian[:3].T @ (NORMAL * force)
        rate = np.linalg.solve(now.mass, controls[-2] + push + d - now.bias)
        v = v + 1e-3 * rate
    assert_allclose(memory[21:28], d, atol=1e-4)


def test_committed_table_is_that_of_the_committed_figures():
    rows = load_rows()
    assert [(row.law, row.knows) for row in rows] == list(ROWS)
    assert FIGURES.with_name("table.md").read_text() == page(rows)
