"""The law: its predicted error, more controls than outputs, and controls that act late."""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from problems import PROBLEMS, closed_loop_outputs, double_integrator, reference_at, wanted_outputs
from runs import roll, scenario, some
from scipy.linalg import expm

from drake_dae import DaeSystem, Parameter, TrackingLaw, poles
from drake_dae.dae import gain_coefficients, gain_matrices
from drake_dae.trace.factorization import nearest_solution


@pytest.mark.slow
@pytest.mark.equation(6, 7, 8, 28, 29, 30, 31, 33, 34)
@pytest.mark.parametrize("problem", some(PROBLEMS), indirect=True)
def test_the_closed_loop_has_exactly_the_predicted_error(problem):
    """(30), (31) from a start with an error, by an independent integrator and elimination."""
    law = TrackingLaw(problem.system, poles(-3.0), structure=problem.structure)
    start = problem.consistent(np.random.default_rng(3))
    times = np.linspace(0.0, problem.horizon, 7)
    outputs, _ = closed_loop_outputs(problem, law, start, times)
    errors = outputs - wanted_outputs(problem, times)
    predicted = law.predicted_error(times, start, reference_at(problem, 0.0))
    # The integrator keeps 1e-11 a step; the largest output, of order 10, is a force.
    np.testing.assert_allclose(errors, predicted, rtol=0, atol=2e-10)
    met = [i for i, degree in enumerate(problem.output_degrees) if degree == 0]
    np.testing.assert_array_equal(predicted[:, met], 0.0)
    if len(met) < len(problem.output_degrees):
        assert np.abs(predicted[0]).max() > 0.01
        # (33): after 30 time constants nothing is left of an error of order 10.
        late = law.predicted_error(10.0, start, reference_at(problem, 0.0))
        assert np.abs(late).max() < 1e-7


@pytest.mark.slow
def test_the_motion_under_the_law_is_that_of_the_system_under_its_control(problem):
    """By elimination, equations (9), (10), (13), (14), off N* too; to the round-off of the control.

    A law that finds its control by B(x), or with friction, gives no motion.
    """
    system = problem.system
    law = TrackingLaw(system, poles(-3.0), structure=problem.structure)
    motion, elimination = law.trace_motion(), law.structure.elimination
    u = ca.SX.sym("u", system.num_controls)
    if motion is None:
        by_matrix = law.structure.derivatives.inverse(law.structure.highest_derivatives, u) is None
        assert by_matrix or system.frictional_contacts or system.control_metric is not None
        return
    rate = elimination.f_star + ca.mtimes(elimination.h_star, u)
    force = elimination.alpha + ca.mtimes(elimination.beta, u)
    plant = system.trace("plant", {"rate": rate, "force": force}, {"u": u})
    random, p = np.random.default_rng(5), system.parameter_values
    start = problem.consistent(random)
    for state in (start, start + 1e-3 * random.standard_normal(start.size)):
        R = reference_at(problem, 0.2)
        control = law.control(state, R)
        size = 1.0 + np.abs(control).max()
        for found, wanted in zip(
            motion(state, R, law.all_parameters()), plant(state, control, p), strict=True
        ):
            np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-12 * size)


LAMBDA_2 = np.array([[11.0, 2.0], [-1.0, 9.0]])


@pytest.mark.equation(5)
def test_control_by_hand():
    """Cart: u = m (r'' - K_2 (x' - r') - K_1 (x - r)) + c x'."""
    cart = double_integrator(f=lambda x: [x[1], -0.3 * x[1] / 4], h=lambda x: [0, 0.25])
    law = TrackingLaw(cart, gain_coefficients([6.0, 5.0]))
    x, r = np.array([2.0, -1.0]), np.array([1.5, 0.5, 3.0])
    expected = 4.0 * (3.0 - 5.0 * (-1.0 - 0.5) - 6.0 * (2.0 - 1.5)) + 0.3 * -1.0
    # Three operations.
    assert law.control(x, r) == pytest.approx([expected], rel=1e-15)
    assert law.error_coordinates(x, r) == pytest.approx([0.5, -1.5], rel=1e-15)
    error = law.function(x, r, law.all_parameters())[1]
    assert error == pytest.approx([0.5], rel=1e-15)


def test_gains_are_parameters_of_the_traced_law():
    """They are those that are not zero: a study changes them without tracing."""
    system = PROBLEMS["gantry"]().system
    first = gain_matrices([np.diag([2.0, 3.0]), LAMBDA_2])
    second = gain_matrices([np.diag([5.0, 7.0]), 2 * LAMBDA_2])
    law = TrackingLaw(system, first)
    changed = TrackingLaw(system, second, structure=law.structure)
    # The diagonals of Lambda_1 and all of Lambda_2.
    assert law.all_parameters().shape == (2 + 4,)
    state, reference = np.linspace(0.5, 1.2, 8), np.linspace(-1.0, 1.0, 8)
    np.testing.assert_array_equal(
        law.function(state, reference, law.all_parameters(gains=second))[0],
        changed.control(state, reference),
    )


@pytest.mark.equation(71, 81)
def test_measured_force_takes_the_place_of_the_models():
    """(71): an output v1 of degree 1 is fed back from the measurement, its gain acts on v1 - r."""
    problem = PROBLEMS["mixed_degrees"]()
    plain = TrackingLaw(problem.system, poles(-3.0), structure=problem.structure)
    measured = TrackingLaw(
        problem.system, poles(-3.0), structure=plain.structure, measured_force=True
    )
    state = problem.consistent(np.random.default_rng(0))
    reference, closed_form = reference_at(problem, 0.3), problem.known(state)
    force = closed_form.alpha  # beta u does not act on v1.
    expected = plain.control(state, reference)
    changed = [
        measured.control(state, reference, measured_force=force + np.array([error, 7.0])) - expected
        for error in (0.0, 0.5)
    ]
    # Ten operations on numbers of order 1.
    np.testing.assert_allclose(changed[0], 0.0, atol=1e-13)
    # B du = (0, -K dv1): the other output does not notice.
    np.testing.assert_allclose(
        closed_form.control_matrix @ changed[1], [0.0, -3.0 * 0.5], rtol=1e-12, atol=1e-13
    )


BY_U = np.array([[1.0, 0.4, -0.7, 0.2], [0.3, -1.1, 0.5, 0.9], [0.2, 0.6, 1.3, -0.8]])
ROOT = np.array(
    [[1.2, 0.0, 0.0, 0.0], [0.3, 0.9, 0.0, 0.0], [-0.2, 0.1, 1.4, 0.0], [0.5, 0.0, 0.2, 1.1]]
)
METRIC = ROOT @ ROOT.T


def sled(**choice) -> DaeSystem:
    """Three masses, four thrusters that move all of them; the third is held on x2 = sin x0.

    With p = (x0, x1, x2) and v = p': p' = v, v' = d(p, v) + G(p)^T lambda + H(p) u, where
    G = (-cos x0, 0, 1); the outputs are x0 and lambda.
    """
    x = ca.SX.sym("x", 6)
    p, v = x[:3], x[3:]
    gradient = ca.vertcat(-ca.cos(p[0]), 0.0, 1.0)
    by_control = ca.SX(BY_U) * (1.0 + 0.1 * p[1])
    drift = ca.vertcat(-ca.sin(p[1]), -p[1] - 0.5 * v[1], -9.81)
    free = Parameter("free", np.zeros(4), "N")
    metric = ca.SX(METRIC) + 0.3 * ca.diag(ca.vertcat(p[0] ** 2, 0.0, 0.0, p[1] ** 2))
    options = {"control_metric": metric, "free_control": free.symbol, **choice}
    return DaeSystem(
        state=x,
        f=ca.vertcat(v, drift),
        g=ca.vertcat(ca.SX(3, 1), gradient),
        h=ca.vertcat(ca.SX(3, 4), by_control),
        k=p[2] - ca.sin(p[0]),
        l=ca.vertcat(p[0], 0.0),
        m=ca.vertcat(0.0, 1.0),
        parameters=(free,),
        name="sled",
        **options,
    )


def by_hand(x, wanted):
    """a, B and W of the sled by NumPy: lambda and x0'' for no control, and for a unit of each."""
    p, v = x[:3], x[3:]
    gradient = np.array([-np.cos(p[0]), 0.0, 1.0])
    columns = BY_U * (1.0 + 0.1 * p[1])
    drift = np.array([-np.sin(p[1]), -p[1] - 0.5 * v[1], -9.81])
    bend = np.sin(p[0]) * v[0] ** 2
    size = gradient @ gradient
    force, by_force = -(gradient @ drift + bend) / size, -(gradient @ columns) / size
    a = np.array([drift[0] + gradient[0] * force, force])
    B = np.vstack([columns[0] + gradient[0] * by_force, by_force])
    W = METRIC + 0.3 * np.diag([p[0] ** 2, 0.0, 0.0, p[1] ** 2])
    inverse = np.linalg.solve(W, B.T) @ np.linalg.inv(B @ np.linalg.solve(W, B.T))
    return inverse @ (wanted - a), np.eye(4) - inverse @ B, W


@pytest.fixture(scope="module")
def law() -> TrackingLaw:
    return TrackingLaw(sled(), poles(-3.0))


def consistent(law, random):
    return law.structure.manifold.project(random.uniform(-1.0, 1.0, 6))


def test_the_nearest_solution_is_that_of_numpy():
    """By the normal equations in NumPy, of matrices with conditions up to 100: 1e-12."""
    random = np.random.default_rng(0)
    for p, size in ((1, 2), (2, 2), (3, 7)):
        B, b = random.standard_normal((p, size)), random.standard_normal(p)
        root, goal = random.standard_normal((size, size)), random.standard_normal(size)
        W = root @ root.T + 0.1 * np.eye(size)
        found, pivot = nearest_solution(*map(ca.SX, (B, b, W, goal)))
        weak = np.linalg.solve(W, B.T)
        expected = goal + weak @ np.linalg.solve(B @ weak, b - B @ goal)
        assert_allclose(ca.DM(found).full().ravel(), expected, rtol=1e-11, atol=1e-11)
        assert 0.0 < float(pivot) <= 1.0
    B[2] = B[0] - B[1]
    assert float(nearest_solution(*map(ca.SX, (B, b, W, goal)))[1]) < 1e-14


def test_the_law_is_the_weighted_right_inverse(law):
    """Against NumPy by hand, with a metric that depends on the state, to round-off."""
    random = np.random.default_rng(1)
    assert law.structure.output_degrees == (2, 0)
    assert law.structure.control_matrix.shape == (2, 4)
    for _ in range(5):
        x, R, free = consistent(law, random), random.uniform(-1, 1, 4), random.uniform(-5, 5, 4)
        ubar = [R[2] - 6.0 * (x[3] - R[1]) - 9.0 * (x[0] - R[0]), R[3]]
        least, onto_null, _ = by_hand(x, np.array(ubar))
        assert_allclose(law.control(x, R), least, rtol=1e-11, atol=1e-11)
        expected = least + onto_null @ free
        assert_allclose(law.control(x, R, parameters=free), expected, rtol=1e-11, atol=1e-11)


INERTIA, DAMPING, PERIOD, POLE = 1e-3, 2.0, 1e-3, -10.0
LATENCY = 1.5 * PERIOD
"""A delay of one sample, and half of the time for which a control is held."""


def joint():
    """I v' + d v = u."""
    return DaeSystem.from_functions(
        ["q", "v"],
        f=lambda x, p: [x[1], -p.d / p.I * x[1]],
        h=lambda x, p: [[0.0], [1.0 / p.I]],
        l=lambda x, p: [x[0]],
        parameters={"I": INERTIA, "d": DAMPING},
    )


def sampled_error(latency, count=600):
    """The largest difference from the wanted decay, by the exact solution between samples."""
    law = TrackingLaw(joint(), poles(POLE), latency=latency)
    A = np.zeros((3, 3))
    A[0, 1], A[1, 1], A[1, 2] = 1.0, -DAMPING / INERTIA, 1.0 / INERTIA
    step = expm(PERIOD * A)[:2]
    state, on_the_way, errors = np.array([1.0, 0.0]), 0.0, []
    for _ in range(count):
        errors.append(state[0])
        (control,) = law.control(state, [0.0, 0.0, 0.0])
        state = step @ np.append(state, on_the_way)
        on_the_way = control
    times = PERIOD * np.arange(count)
    return np.abs(errors - (1.0 - POLE * times) * np.exp(POLE * times)).max()


def test_a_light_damped_joint_decays_as_designed_under_a_late_control():
    """T d / I = 3: without the latency the error is 27 per cent of its start off its decay.

    What is left, 0.8 per cent, is the delay of the feedback, some -POLE * LATENCY / 2.
    """
    assert sampled_error(0.0) > 0.25
    assert sampled_error(LATENCY) < 0.01
    # The latency is neither half nor twice as long.
    assert min(sampled_error(0.5 * LATENCY), sampled_error(2.0 * LATENCY)) > 0.03


def tool_with_drag():
    """Two joints of inertia I with a drag d of their tool along its path, whose gradient is J."""
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    tool = q[0] + q[1] + 0.1 * q[0] ** 2
    along = ca.jacobian(tool, q)
    return DaeSystem(
        state=ca.vertcat(q, v),
        mass_matrix=ca.diagcat(ca.SX.eye(2), INERTIA * ca.SX.eye(2)),
        f=ca.vertcat(v, -DAMPING * ca.mtimes([along.T, along, v])),
        g=ca.SX(4, 0),
        h=ca.DM([[0, 0], [0, 0], [1, 0], [0, 1]]),
        k=ca.SX(0, 1),
        l=q,
        m=ca.SX(2, 0),
    )


def test_damping_of_several_joints_at_once_is_a_matrix():
    """D = J^T d J, with J of the present position, as of a tool that slides with viscous friction.

    With the diagonal of D alone the direction that is not damped would be driven by 1 + T d / I = 4
    times as much as its errors need.
    """
    law = TrackingLaw(tool_with_drag(), poles(POLE), latency=LATENCY)
    position, speed = np.array([0.3, -0.2]), np.array([0.5, 0.4])
    control = law.control([*position, *speed], np.zeros(6))
    along = np.array([[1.0 + 0.2 * position[0], 1.0]])
    damping = DAMPING * along.T @ along
    wanted = -(POLE**2) * position + 2.0 * POLE * speed
    inertia = INERTIA * np.eye(2) + LATENCY * damping
    np.testing.assert_allclose(control, inertia @ wanted + damping @ speed, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.thorough
def test_a_plant_that_steps_damps_by_the_speed_after_the_step():
    """The last joint, of 1e-3 kg m^2 or so with 100 N m s, from 10 mrad off, with poles at -10/s.

    The law acts at each step without a delay. What is left, 0.3 per cent of the start, is contact.
    """
    settings = (
        "plant=!CompliantContact {time_step: 0.001, stiffness: 1.0e5, friction: 0.0}",
        "robot.known_forces=[!JointFriction {joints: [joint7], viscous: 100}]",
        "references={tool.y: 0, tool.z: 0.6, tool.z_axis: 0, joint3: 0, joint7: 0, wall.force: 20}",
        "start.errors={joint7: 0.01}",
        "law.gains=!Poles {all: [-10.0]}",
        "law.constraint_damping=!Poles {all: [-200.0]}",
        "duration=0.5",
    )

    def off(*sampling):
        loop, record = roll(scenario("wall_point_contact", *settings, *sampling))
        place = [s.name for s in loop.signals["controlled_output"]].index("joint7")
        difference = record["tracking_error"] - loop.predicted_error(record)
        return loop.controller.law.latency, np.abs(difference[:, place]).max()

    latency, without_sampling = off("sampling=null")
    assert latency == 0.001
    latency, sampled = off()
    assert latency == 0.002
    assert without_sampling < 1e-4
    assert sampled < 1e-4
