"""Pinned motions and zero dynamics against closed forms, pencils and other integrators."""

import re
import warnings
from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from actuated import OFFSET, actuated, at_rest, drive, rates, start_position
from arms import touching
from problems import (
    PROBLEMS,
    Problem,
    closed_loop_outputs,
    double_integrator,
    in_other_units,
    reference_at,
    wanted_outputs,
)
from scipy.integrate import solve_ivp

import drake_dae.dae.zero_dynamics.pursuit as module
from drake_dae import (
    ConstantReference,
    DaePlant,
    ExpressionReference,
    LoopSettings,
    analyze,
    make_closed_loop,
)
from drake_dae.dae.structure.structure import examine_structure, find_structure
from drake_dae.dae.system.system import DaeSystem
from drake_dae.dae.tracking.gains import poles
from drake_dae.dae.tracking.tracking import TrackingLaw
from drake_dae.dae.zero_dynamics.pinned_motion import PinnedMotion
from drake_dae.dae.zero_dynamics.stability import Verdict
from drake_dae.dae.zero_dynamics.zero_dynamics import ZeroDynamics
from drake_dae.errors import (
    InconsistentStateError,
    ModelError,
    NonFiniteError,
    NonMinimumPhaseWarning,
)
from drake_dae.robots.actuation.flexible_joints import FlexibleJoints

Array = np.ndarray


def zero_dynamics(system: DaeSystem) -> ZeroDynamics:
    return ZeroDynamics(system)


def derivatives(function: Callable[[ca.SX], list], degrees: tuple[int, ...]):
    """t -> R(t) of functions of time, differentiated by CasADi."""
    t = ca.SX.sym("t")
    entries = []
    for value, degree in zip(function(t), degrees, strict=True):
        entries.append(ca.SX(value))
        for _ in range(degree):
            entries.append(ca.jacobian(entries[-1], t))
    traced = ca.Function("reference", [t], [ca.densify(ca.vertcat(*entries))])
    return lambda time: np.array(traced(time))[:, 0]


def following(problem: Problem, count: int = 13) -> tuple[ZeroDynamics, Array, PinnedMotion]:
    """A problem's reference from a random start, without failure."""
    times = np.linspace(0.0, problem.horizon, count)
    dynamics = zero_dynamics(problem.system)
    start = problem.consistent(np.random.default_rng(3))
    motion = dynamics.motion(lambda t: reference_at(problem, t), times, start)
    assert motion.ending is None
    np.testing.assert_array_equal(motion.times, times)
    return dynamics, times, motion


# Systems with zero dynamics that are known by hand.

GRAVITY = 9.81


def cart_pendulum(damping: float = 0.0, angle: float = 0.0) -> DaeSystem:
    """A cart s with a pendulum (x, y) on a rigid rod of length 0.7, pushed; z = s.

    In Cartesian coordinates: m s'' = u - v (x - s), M (x'', y'') = v (x - s, y) - (0, M g), on
    (x - s)^2 + y^2 = L^2. With the cart on s(t) and x - s = L sin a, y = L cos a is left
    L a'' = g sin a - s'' cos a - d L a', with `damping` d as a drag relative to the cart.
    """
    length = 0.7
    s, c = length * np.sin(angle), length * np.cos(angle)

    def drag(x):
        return [-damping * (x[4] - x[3]), -damping * x[5]]

    return DaeSystem.from_functions(
        ["s", "x", "y", "s'", "x'", "y'"],
        f=lambda x: [x[3], x[4], x[5], 0, drag(x)[0], drag(x)[1] - GRAVITY],
        g=lambda x: [0, 0, 0, -(x[1] - x[0]) / 2.0, (x[1] - x[0]) / 0.5, x[2] / 0.5],
        h=lambda x: [0, 0, 0, 1 / 2.0, 0, 0],
        k=lambda x: ((x[1] - x[0]) ** 2 + x[2] ** 2 - length**2) / 2.0,
        l=lambda x: x[0],
        m=lambda x: 0,
        nominal_state=[0.3, 0.3 + s, c, 0.0, 0.0, 0.0],
        output_signals=["s"],
        name="cart with pendulum",
    )


def aircraft(epsilon: float = 0.25) -> DaeSystem:
    """Vertical take-off (Hauser, Sastry and Meyer, 1992), z = (x, y):

    x'' = -sin(a) u1 + eps cos(a) u2, y'' = cos(a) u1 + eps sin(a) u2 - 1, a'' = u2. At a fixed
    position u1 = cos a, u2 = sin(a)/eps: eps a'' = sin a.
    """
    return DaeSystem.from_functions(
        ["x", "y", "a", "x'", "y'", "a'"],
        f=lambda x, p: [x[3], x[4], x[5], 0, -1, 0],
        h=lambda x, p: [
            [0, 0],
            [0, 0],
            [0, 0],
            [-ca.sin(x[2]), p.epsilon * ca.cos(x[2])],
            [ca.cos(x[2]), p.epsilon * ca.sin(x[2])],
            [0, 1],
        ],
        l=lambda x, p: [x[0], x[1]],
        parameters={"epsilon": epsilon},
        output_signals=["x", "y"],
        name="aircraft",
    )


TANK_AREAS, HOLES = np.array([28.0, 32.0, 28.0, 32.0]), np.array([0.071, 0.057, 0.071, 0.057])
TANK_GRAVITY = 981.0
MINIMUM_PHASE = {"pumps": (3.33, 3.35), "valves": (0.70, 0.60), "levels": (12.4, 12.7)}
NON_MINIMUM_PHASE = {"pumps": (3.14, 3.29), "valves": (0.43, 0.34), "levels": (12.6, 13.0)}


def quadruple_tank(pumps, valves, levels) -> DaeSystem:
    """The four tanks of Johansson (2000), in cm and s, z = (h1, h2), u the pumps' voltages.

    Pump i sends the part g_i of k_i u_i to tank i and the rest across to an upper tank, which
    drains into the lower one below it: tank 3 into 1, tank 4 into 2.
    """
    (k1, k2), (g1, g2) = pumps, valves

    def f(x):
        out = [HOLES[i] * ca.sqrt(2 * TANK_GRAVITY * x[i]) for i in range(4)]
        flows = [out[2] - out[0], out[3] - out[1], -out[2], -out[3]]
        return [flow / area for flow, area in zip(flows, TANK_AREAS, strict=True)]

    return DaeSystem.from_functions(
        ["h1", "h2", "h3", "h4"],
        f=f,
        h=lambda x: (
            np.diag(1 / TANK_AREAS)
            @ [[g1 * k1, 0], [0, g2 * k2], [0, (1 - g2) * k2], [(1 - g1) * k1, 0]]
        ),
        l=lambda x: [x[0], x[1]],
        nominal_state=[*levels, 3.0, 3.0],
        output_signals=["h1", "h2"],
        name="four tanks",
    )


def tanks_at_rest(pumps, valves, levels) -> tuple[Array, Array]:
    """Levels and voltages: outflow = inflow of tanks 1 and 2, hence u; then tanks 3 and 4."""
    k, g = np.array(pumps), np.array(valves)
    inflow = np.array([[g[0] * k[0], (1 - g[1]) * k[1]], [(1 - g[0]) * k[0], g[1] * k[1]]])
    out = HOLES[:2] * np.sqrt(2 * TANK_GRAVITY * np.array(levels))
    u = np.linalg.solve(inflow, out)
    upper = np.array([(1 - g[1]) * k[1] * u[1], (1 - g[0]) * k[0] * u[0]])
    return np.concatenate([levels, (upper / HOLES[2:]) ** 2 / (2 * TANK_GRAVITY)]), u


def spring_masses(damping: float) -> DaeSystem:
    """Two masses and a spring, the first pushed and pinned: m q2'' = -k (q2 - q1) - d q2'."""
    return DaeSystem.from_functions(
        ["q1", "q2", "v1", "v2"],
        f=lambda x: [
            x[2],
            x[3],
            8.0 * (x[1] - x[0]),
            (-8.0 * (x[1] - x[0]) - damping * x[3]) / 2.0,
        ],
        h=lambda x: [0, 0, 1, 0],
        l=lambda x: x[0],
        output_signals=["q1"],
        name="two masses",
    )


def internal(rate: Callable, start: float = 1.0) -> DaeSystem:
    """z' = u and an internal state s' = rate(s, z)."""
    return DaeSystem.from_functions(
        ["z", "s"],
        f=lambda x: [0, rate(x[1], x[0])],
        h=lambda x: [1, 0],
        l=lambda x: x[0],
        nominal_state=[0.0, start],
        output_signals=["z"],
        name="internal",
    )


def free_arm() -> DaeSystem:
    """A planar arm with links 1.0 and 0.8 and unit inertias, z the position of its tip."""

    def tip(q):
        return [
            ca.cos(q[0]) + 0.8 * ca.cos(q[0] + q[1]),
            ca.sin(q[0]) + 0.8 * ca.sin(q[0] + q[1]),
        ]

    return DaeSystem.from_functions(
        ["q1", "q2", "v1", "v2"],
        f=lambda x: [x[2], x[3], 0, 0],
        h=lambda x: np.vstack([np.zeros((2, 2)), np.eye(2)]),
        l=tip,
        nominal_state=[0.5, 1.0, 0.0, 0.0],
        output_signals=["x", "y"],
        name="free arm",
    )


def finite_zeros(system: DaeSystem) -> Array:
    """Invariant zeros of a linear system (1)-(3): s where its pencil in (x, v, u) loses rank."""
    x, m, p = system.state, system.num_constraints, system.num_controls

    def slope(expression: ca.SX) -> Array:
        return np.array(ca.DM(ca.jacobian(expression, x)))

    g, h, feedthrough = (np.array(ca.DM(ca.densify(e))) for e in (system.g, system.h, system.m))
    pencil = np.block(
        [
            [slope(system.f), g, h],
            [slope(system.k), np.zeros((m, m + p))],
            [slope(system.l), feedthrough, np.zeros((p, p))],
        ]
    )
    states = np.zeros_like(pencil)
    states[: x.numel(), : x.numel()] = np.eye(x.numel())
    alpha, beta = scipy.linalg.eigvals(pencil, states, homogeneous_eigvals=True)
    # The infinite ones come as beta of the size of round-off, to a power 1/6 as they are defective.
    finite = np.abs(beta) > 1e-6 * np.abs(alpha)
    return alpha[finite] / beta[finite]


def linear_system(seed: int, n: int = 7, m: int = 1, p: int = 2) -> DaeSystem:
    """Numbers without structure: r = 1, mu = 1, so n - m - p zeros."""
    random = np.random.default_rng(seed)
    x = ca.SX.sym("x", n)
    f, k, el = random.normal(size=(n, n)), random.normal(size=(m, n)), random.normal(size=(p, n))
    g, h = random.normal(size=(n, m)), random.normal(size=(n, p))
    return DaeSystem(
        state=x, f=f @ x, g=g, h=h, k=k @ x, l=el @ x, m=np.zeros((p, m)), name="linear"
    )


def assert_same_numbers(found: Array, expected: Array, **tolerance) -> None:
    """Complex numbers, in any order."""
    assert found.shape == expected.shape
    left = list(expected)
    for number in found:
        left_index = int(np.argmin(np.abs(np.array(left) - number)))
        np.testing.assert_allclose(number, left.pop(left_index), **tolerance)


# Pinned motions.


def test_outputs_and_constraints_hold_on_the_whole_motion(problem):
    """By the closed forms of the problem: k and its derivatives, z = l + m (alpha + beta u)."""
    _, times, motion = following(problem)
    system = problem.system
    numbers = ca.Function(
        "lm", [system.state, system.parameter_symbol], [ca.densify(system.l), ca.densify(system.m)]
    )
    for i, x in enumerate(motion.states):
        # Round-off of numbers of order 10.
        np.testing.assert_allclose(problem.derivatives(x), 0.0, atol=1e-13)
        known = problem.known(x)
        force = known.alpha + known.beta @ motion.controls[i]
        np.testing.assert_allclose(motion.constraint_inputs[i], force, rtol=1e-10, atol=1e-10)
        el, em = (np.array(e) for e in numbers(x, system.parameter_values))
        # The promise of 1e-9; Newton's method leaves 1e-12 of a state.
        wanted = wanted_outputs(problem, times[[i]])[0]
        np.testing.assert_allclose(el[:, 0] + em @ force, wanted, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_motions_agree_with_the_closed_loop_started_on_them(problem):
    """The law (28) without an initial error moves the same way; integrated by DOP853."""
    _, times, motion = following(problem)
    law = TrackingLaw(problem.system, poles(-3.0))
    _, states = closed_loop_outputs(problem, law, motion.states[0], times)
    # Internal states: the integration error at TOLERANCE 1e-6, which is 2e-8 at most here.
    np.testing.assert_allclose(motion.states, states, rtol=1e-7, atol=1e-7)
    controls = [
        law.control(x, reference_at(problem, t)) for t, x in zip(times, states, strict=True)
    ]
    # Up to 1000 times as steep in the state, as in a stiff system.
    np.testing.assert_allclose(motion.controls, controls, rtol=1e-5, atol=1e-5)


def test_margins_are_the_singular_values_of_a_and_b(problem):
    _, _, motion = following(problem, 5)
    for i, x in enumerate(motion.states):
        known = problem.known(x)
        expected = np.linalg.svd(known.control_matrix, compute_uv=False)[-1]
        assert motion.control_margins[i] == pytest.approx(expected, rel=1e-9)
        if problem.constraint_degrees:
            expected = np.linalg.svd(known.constraint_matrix, compute_uv=False)[-1]
        else:
            expected = np.inf
        assert motion.constraint_margins[i] == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
def test_shapes(problem):
    dynamics, times, motion = following(problem, 4)
    system, k = problem.system, times.size
    assert dynamics.dimension == problem.zero_dynamics
    assert motion.states.shape == (k, system.num_states)
    assert motion.controls.shape == (k, system.num_controls)
    assert motion.constraint_inputs.shape == (k, system.num_constraints)
    assert motion.constraint_margins.shape == motion.control_margins.shape == (k,)
    assert len(dynamics.residual_signals) == system.num_states - dynamics.dimension


@pytest.mark.slow
def test_a_state_on_the_reference_from_a_guess_off_it(problem):
    dynamics = zero_dynamics(problem.system)
    guess = problem.consistent(np.random.default_rng(3)) + 0.01
    reference = reference_at(problem, 0.0)
    state = dynamics.state(reference, guess)
    law = TrackingLaw(problem.system, poles(-3.0), structure=dynamics.structure)
    # Newton's method ends at the round-off of numbers of order 10.
    np.testing.assert_allclose(problem.derivatives(state), 0.0, atol=1e-13)
    np.testing.assert_allclose(law.error_coordinates(state, reference), 0.0, atol=1e-12)
    # Steps below 1e-12 of the state end the search.
    np.testing.assert_allclose(dynamics.state(reference, state), state, rtol=0, atol=1e-11)


@pytest.mark.parametrize("angle", [0.0, 0.4])
def test_the_internal_motion_of_a_pendulum_on_a_moved_cart(angle):
    """Against L a'' = g sin a - s'' cos a, written and integrated in the angle."""
    system = cart_pendulum(angle=angle)
    reference = derivatives(lambda t: [0.3 * ca.cos(2.0 * t)], (2,))
    times = np.linspace(0.0, 2.0, 21)
    motion = zero_dynamics(system).motion(reference, times)
    assert motion.ending is None

    def angle_rate(t, a):
        pushed = GRAVITY * np.sin(a[0]) - reference(t)[2] * np.cos(a[0])
        return [a[1], pushed / 0.7]

    expected = solve_ivp(
        angle_rate, (0, 2), [angle, 0.0], "DOP853", times, rtol=1e-11, atol=1e-12
    ).y
    found = np.arctan2(motion.states[:, 1] - motion.states[:, 0], motion.states[:, 2])
    # Errors of 1e-9 a step grow by exp(sqrt(g/L) 2 s) = 1800 before it falls over.
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * expected[0]), rtol=0, atol=2e-5)
    np.testing.assert_allclose(motion.states[:, 0], 0.3 * np.cos(2.0 * times), atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two_link", "seven_joint"])
@pytest.mark.parametrize("kind", ["flexible", "damped", "motor"])
def test_motions_of_robots_agree_with_multibody_plant(name, kind):
    """x' by differences of the states, and lambda, against MultibodyPlant with the same control."""
    robot = actuated(name, kind)
    dynamics = ZeroDynamics(robot.structure.system, structure=robot.structure)
    degrees = robot.structure.output_degrees
    rest, _ = at_rest(name, kind, start_position(name), 20.0)

    def function(t):
        moved = [start + 0.03 * (1 - ca.cos(1.3 * t)) ** 3 for start in OFFSET[name]]
        return [*moved, 20.0 + 3.0 * ca.sin(t)]

    step = 1e-3
    times = 1.0 + step * np.arange(-4, 5)
    motion = dynamics.motion(derivatives(function, degrees), [0.0, *times], rest)
    assert motion.ending is None
    states = motion.states[1:]
    weights = np.array([3, -32, 168, -672, 0, 672, -168, 32, -3]) / (840.0 * step)
    slope = weights @ states
    truth = rates(name, drive(name, kind), states[4], motion.controls[5])
    size = np.maximum(1.0, np.abs(truth.state))
    # Differences of order 8: round-off 1e-13/step, and the motion's own 1e-9/step where integrated.
    np.testing.assert_allclose(slope / size, truth.state / size, rtol=0, atol=1e-6)
    np.testing.assert_allclose(motion.constraint_inputs[5], truth.force, rtol=1e-8)
    np.testing.assert_allclose(truth.force, 20.0 + 3.0 * np.sin(1.0), rtol=1e-8)


def test_a_reference_out_of_reach_ends_the_motion_where_the_arm_is_straight():
    """Radially from 1.2 m at 0.3 m/s: the arm of 1.8 m is straight after 2 s."""
    dynamics = zero_dynamics(free_arm())
    direction = np.array([0.6, 0.8])
    times = np.linspace(0.0, 3.0, 31)
    reference = derivatives(lambda t: [(1.2 + 0.3 * t) * d for d in direction], (2, 2))
    motion = dynamics.motion(reference, times)
    assert "the reference leaves what the system can reach at t = 2 s: B(x) " in str(motion.ending)
    # A step below a millionth of the grid's ends the search: twice that is not tried any more.
    assert motion.ending.time == pytest.approx(2.0, abs=2e-6 * 0.1)
    np.testing.assert_allclose(motion.times, times[times < 2.0 - 1e-9])
    # B is the Jacobian of the tip: its determinant is l1 l2 sin q2, its size that of its entries.
    elbow = np.arccos((np.square(1.2 + 0.3 * motion.times) - 1.0 - 0.64) / 1.6)
    np.testing.assert_allclose(motion.states[:, 1], elbow, rtol=1e-9)
    jacobians = [tip_jacobian(q) for q in motion.states]
    singular = np.linalg.svd(jacobians, compute_uv=False)
    np.testing.assert_allclose(motion.control_margins, singular[:, -1], rtol=1e-9)
    assert np.all(np.diff(motion.control_margins[-5:]) < 0.0)


def tip_jacobian(q: Array) -> Array:
    s1, c1, s12, c12 = np.sin(q[0]), np.cos(q[0]), np.sin(q[0] + q[1]), np.cos(q[0] + q[1])
    return np.array([[-s1 - 0.8 * s12, -0.8 * s12], [c1 + 0.8 * c12, 0.8 * c12]])


def test_the_guess_decides_which_solution_is_followed():
    dynamics = zero_dynamics(free_arm())
    reference = derivatives(lambda t: [1.2 + 0.3 * ca.sin(t), 0.5 * ca.cos(t)], (2, 2))
    times = np.linspace(0.0, 6.0, 25)
    up, down = (
        dynamics.motion(reference, times, [0.3, elbow, 0.0, 0.0]).states for elbow in (1.0, -1.0)
    )
    assert up.shape == down.shape == (25, 4)
    assert np.all(up[:, 1] > 0.1)
    # Mirrored at the line to the tip.
    np.testing.assert_allclose(down[:, 1], -up[:, 1], rtol=1e-9)
    # A coarse grid makes more steps between its times, not other jumps.
    coarse = dynamics.motion(reference, times[::12], [0.3, 1.0, 0.0, 0.0]).states
    np.testing.assert_allclose(coarse, up[::12], rtol=1e-9, atol=1e-9)


def test_a_singular_arm_on_the_way():
    """The tip touches the rim of the workspace at t = 1 s and comes back: u is not determined."""
    dynamics = zero_dynamics(free_arm())
    reference = derivatives(lambda t: [1.8 - 0.3 * (t - 1.0) ** 2, 0], (2, 2))
    motion = dynamics.motion(reference, np.linspace(0.0, 2.0, 11), [-0.5, 1.0, 0.0, 0.0])
    assert re.search(r"at t = .* s B\(x\) becomes singular", str(motion.ending))
    assert "the control would be unbounded" in str(motion.ending)
    # Up to where Newton's method cannot tell the two elbows from each other.
    assert motion.ending.time == pytest.approx(1.0, abs=1e-5)


def test_a_singular_b_under_running_zero_dynamics():
    """z' = s u with s' = -1 from 1: s passes 0 at t = 1 s smoothly, u = r'/s does not."""
    system = DaeSystem.from_functions(
        ["z", "s"],
        f=lambda x: [0, -1],
        h=lambda x: [x[1], 0],
        l=lambda x: x[0],
        nominal_state=[0.0, 1.0],
        name="clock",
    )
    times = np.linspace(0.0, 2.1, 8)  # 1 is not among them, and a step may pass it.
    motion = zero_dynamics(system).motion(derivatives(lambda t: [ca.sin(t)], (1,)), times)
    assert "at t = 1 s B(x) becomes singular" in str(motion.ending)
    assert motion.ending.time == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(motion.control_margins, 1.0 - motion.times, atol=1e-12)
    np.testing.assert_allclose(motion.controls[:, 0], np.cos(motion.times) / (1 - motion.times))


def test_unstable_zero_dynamics_end_the_motion_in_growth():
    """s' = s: exp(t) is 1e8 at t = 18.4; s' = s^2 is infinite at t = 1."""
    still = derivatives(lambda t: [0], (1,))
    times = np.linspace(0.0, 30.0, 31)
    slow = zero_dynamics(internal(lambda s, z: s)).motion(still, times)
    assert "the internal states grow without bound while the outputs follow: s = " in str(
        slow.ending
    )
    assert slow.times[-1] == pytest.approx(np.floor(8.0 * np.log(10.0)))
    # 1e-8 a step, 500 steps.
    np.testing.assert_allclose(slow.states[:, 1], np.exp(slow.times), rtol=5e-6)
    fast = zero_dynamics(internal(lambda s, z: s**2)).motion(still, np.linspace(0.0, 2.0, 21))
    assert "grow without bound" in str(fast.ending)
    assert fast.ending.time == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(fast.states[:, 1], 1 / (1 - fast.times), rtol=1e-6)


def test_stiff_zero_dynamics_take_few_steps(monkeypatch):
    """s' = 1e6 (z - s): an explicit integrator would take 300000 steps a second."""
    monkeypatch.setattr(module, "STEPS", 200)
    dynamics = zero_dynamics(internal(lambda s, z: 1e6 * (z - s)))
    motion = dynamics.motion(derivatives(lambda t: [ca.sin(t)], (1,)), [0.0, 5.0, 10.0])
    assert motion.ending is None
    # s lags behind z = sin t by 1e-6 s.
    np.testing.assert_allclose(motion.states[1:, 1], np.sin(motion.times[1:] - 1e-6), atol=1e-8)


@pytest.mark.slow
def test_a_long_motion_does_not_drift(monkeypatch):
    """With errors of 1e-3 a step: outputs and rod to round-off, and the angle to a few steps."""
    monkeypatch.setattr(module, "TOLERANCE", 1e-3)
    reference = derivatives(lambda t: [0.3 * ca.cos(2.0 * t)], (2,))
    times = np.linspace(0.0, 200.0, 11)
    dynamics = zero_dynamics(cart_pendulum(damping=1.0, angle=np.pi))
    motion = dynamics.motion(reference, times)
    assert motion.ending is None
    np.testing.assert_allclose(motion.states[:, 0], 0.3 * np.cos(2.0 * times), atol=1e-11)
    rod = motion.states[:, 1:3] - motion.states[:, :1] * [1.0, 0.0]
    np.testing.assert_allclose(np.hypot(*rod.T), 0.7, atol=1e-11)
    expected = solve_ivp(
        lambda t, a: [
            a[1],
            (GRAVITY * np.sin(a[0]) - reference(t)[2] * np.cos(a[0])) / 0.7 - a[1],
        ],
        (0, 200),
        [np.pi, 0.0],
        "DOP853",
        times,
        rtol=1e-9,
        atol=1e-10,
    ).y
    found = np.pi + np.arctan2(-rod[:, 0], -rod[:, 1])
    np.testing.assert_allclose(found, expected[0], rtol=0, atol=5e-3)


@pytest.mark.slow
def test_long_chains_do_not_drift_away(monkeypatch):
    """z^(4) = u and s' = z - s: an error of 1e-8 in z^(3) is one of 1e-8 t^3/6 in z, 0.7 here."""
    monkeypatch.setattr(module, "TOLERANCE", 1e-3)
    system = DaeSystem.from_functions(
        5,
        f=lambda x: [x[1], x[2], x[3], 0, x[0] - x[4]],
        h=lambda x: [0, 0, 0, 1, 0],
        l=lambda x: x[0],
        nominal_state=[0, 1, 0, -1, -0.5],
    )
    times = np.linspace(0.0, 750.0, 4)
    motion = zero_dynamics(system).motion(derivatives(lambda t: [ca.sin(t)], (4,)), times)
    assert motion.ending is None
    expected = (np.sin(times) - np.cos(times)) / 2.0
    # A few steps of 1e-3; older ones are forgotten.
    np.testing.assert_allclose(motion.states[:, 4], expected, rtol=0, atol=5e-3)


def test_the_work_is_bounded(monkeypatch):
    monkeypatch.setattr(module, "STEPS", 50)
    system = spring_masses(0.0)
    motion = zero_dynamics(system).motion(
        derivatives(lambda t: [0], (2,)), [0.0, 1000.0], [0.0, 1.0, 0.0, 0.0]
    )
    assert "after 50 steps the motion is at t = " in str(motion.ending)
    assert 0.0 < motion.ending.time < 1000.0


def test_motions_end_where_domain_and_reference_do():
    tank = DaeSystem.from_functions(
        ["h"],
        f=lambda x: -ca.sqrt(x[0]),
        h=lambda x: 1,
        l=lambda x: x[0],
        nominal_state=[1.0],
        name="tank",
    )
    dynamics, times = zero_dynamics(tank), np.linspace(0.0, 2.0, 21)
    motion = dynamics.motion(derivatives(lambda t: [1 - 1.003 * t], (1,)), times)
    assert "no state that continues the motion is found beyond t = 0.997" in str(motion.ending)
    assert motion.ending.time == pytest.approx(1 / 1.003, abs=1e-6)
    assert motion.times.size == 10

    def jumping(t: float) -> Array:
        return np.array([1.0 if t < 0.55 else 3.0, 0.0])

    motion = dynamics.motion(jumping, times)
    assert "the reference jumps" in str(motion.ending)
    assert motion.ending.time == pytest.approx(0.55, abs=1e-6)

    def short(t: float) -> Array:
        return np.array([1.0, 0.0]) if t <= 1.0 else np.array([np.nan, 0.0])

    motion = dynamics.motion(short, times)
    assert "the reference is not finite at t = 1.1 s" in str(motion.ending)
    assert motion.times[-1] == 1.0

    def raising(t: float) -> Array:
        if t > 1.0:
            raise NonFiniteError("reference: over", t, [0.0])
        return np.array([1.0, 0.0])

    assert str(dynamics.motion(raising, times).ending) == "reference: over"

    # Upper tanks that run dry: the domain ends inside the integrator.
    tanks = zero_dynamics(quadruple_tank(**MINIMUM_PHASE))
    lowered = derivatives(lambda t: [12.4 - 0.5 * t, 12.7 - 0.5 * t], (1, 1))
    motion = tanks.motion(lowered, np.linspace(0.0, 20.0, 41))
    assert "the domain of the system ends" in str(motion.ending)
    assert 0 < motion.times.size < 41
    assert np.min(motion.states) > 0.0


def test_a_motion_that_has_no_start_is_empty():
    dynamics = zero_dynamics(free_arm())
    motion = dynamics.motion(lambda t: np.array([2.0, 0.0, 0.0, 0.0, 0.0, 0.0]), [0.5, 1.0])
    assert "the outputs x = 2, y = 0 are not reached" in str(motion.ending)
    assert "(t = 0.5 s)" in str(motion.ending)
    assert motion.ending.time == 0.5
    assert motion.states.shape == (0, 4)
    assert motion.controls.shape == (0, 2)
    assert motion.constraint_inputs.shape == (0, 0)
    assert motion.control_margins.shape == motion.constraint_margins.shape == (0,)


def test_a_motion_may_be_one_state():
    motion = zero_dynamics(aircraft()).motion(lambda t: np.zeros(6), [2.0])
    assert motion.ending is None
    np.testing.assert_allclose(motion.states, np.zeros((1, 6)), atol=1e-15)


def test_motions_take_parameters():
    """The zero dynamics of the aircraft with another epsilon, against their own equation."""
    times = np.linspace(0.0, 1.0, 6)
    start = np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0])
    motion = zero_dynamics(aircraft()).motion(lambda t: np.zeros(6), times, start, [0.7])
    expected = solve_ivp(
        lambda t, a: [a[1], np.sin(a[0]) / 0.7],
        (0, 1),
        start[[2, 5]],
        "DOP853",
        times,
        rtol=1e-11,
        atol=1e-12,
    ).y
    # 1e-8 a step.
    np.testing.assert_allclose(motion.states[:, [2, 5]].T, expected, rtol=0, atol=1e-7)
    u1, u2 = np.cos(expected[0]), np.sin(expected[0]) / 0.7
    np.testing.assert_allclose(motion.controls, np.transpose([u1, u2]), rtol=0, atol=1e-7)


def test_wrong_arguments_are_refused():
    dynamics = zero_dynamics(free_arm())
    still = np.array([1.2, 0, 0, 0.5, 0, 0])
    for times in ([], [0.0, 0.0], [1.0, 0.0]):
        with pytest.raises(ModelError, match="times must increase"):
            dynamics.motion(lambda t: still, times)
    with pytest.raises(ModelError, match="times must be finite"):
        dynamics.motion(lambda t: still, [0.0, np.inf])
    with pytest.raises(ModelError, match=r"reference must have size 6 .* \(2, 2\).*got 2"):
        dynamics.motion(lambda t: still[:2], [0.0, 1.0])
    with pytest.raises(ModelError, match=r"reference must be finite and of shape \(6,\)"):
        dynamics.state(still[:2])
    with pytest.raises(ModelError, match=r"state must be finite and of shape \(4,\)"):
        dynamics.state(still, [0, 0, 0])
    with pytest.raises(ModelError, match="guess must be finite real numbers or None"):
        dynamics.state(still, [0, np.nan, 0, 0])
    with pytest.raises(ModelError, match=r"parameters must be finite and of shape \(0,\)"):
        dynamics.state(still, parameters=[1.0])
    with pytest.raises(ModelError, match=r"outputs must be finite and of shape \(2,\)"):
        dynamics.equilibrium([1, 2, 3])
    with pytest.raises(ModelError, match="outputs must be finite real numbers"):
        dynamics.equilibrium(["far", "away"])


def test_outputs_out_of_reach_are_named():
    dynamics = zero_dynamics(free_arm())
    with pytest.raises(InconsistentStateError, match=r"free arm: the outputs x = 2, y = 0") as info:
        dynamics.state([2.0, 0, 0, 0, 0, 0])
    # The nearest the tip gets is 0.2 short.
    assert np.max(np.abs(info.value.residual)) > 0.1
    with pytest.raises(InconsistentStateError, match="have no value near the given state"):
        zero_dynamics(double_integrator(l=lambda x: ca.sqrt(x[0]), nominal_state=[1, 0])).state(
            [1.0, 0.0, 0.0], [-1.0, 0.0]
        )


# Equilibria and eigenvalues.


@pytest.mark.parametrize("plant", [MINIMUM_PHASE, NON_MINIMUM_PHASE])
def test_equilibrium_of_the_four_tanks(plant):
    dynamics = zero_dynamics(quadruple_tank(**plant))
    expected, voltages = tanks_at_rest(**plant)
    found = dynamics.equilibrium(plant["levels"])
    # A dozen operations.
    np.testing.assert_allclose(found, expected, rtol=1e-11)
    motion = dynamics.motion(lambda t: [plant["levels"][0], 0, plant["levels"][1], 0], [0.0], found)
    np.testing.assert_allclose(motion.controls[0], voltages, rtol=1e-10)
    # The published upper levels are measured ones.
    published = (1.8, 1.4) if plant is MINIMUM_PHASE else (4.8, 4.9)
    np.testing.assert_allclose(found[2:], published, atol=0.25)


@pytest.mark.parametrize("plant", [MINIMUM_PHASE, NON_MINIMUM_PHASE])
def test_zeros_of_the_four_tanks(plant):
    """(1 + s T3)(1 + s T4) = (1 - g1)(1 - g2)/(g1 g2), T_i = A_i/a_i sqrt(2 h_i/g)."""
    dynamics = zero_dynamics(quadruple_tank(**plant))
    levels, _ = tanks_at_rest(**plant)
    t3, t4 = (TANK_AREAS / HOLES * np.sqrt(2 * levels / TANK_GRAVITY))[2:]
    g1, g2 = plant["valves"]
    expected = np.roots([t3 * t4, t3 + t4, 1 - (1 - g1) * (1 - g2) / (g1 * g2)])
    found = dynamics.eigenvalues(dynamics.equilibrium(plant["levels"]))
    # An equilibrium to 1e-12.
    np.testing.assert_allclose(found, np.sort(expected)[::-1], rtol=1e-9)
    stability = dynamics.stability()
    np.testing.assert_allclose(stability.eigenvalues, found, rtol=1e-9)
    np.testing.assert_allclose(stability.state, levels, rtol=1e-9)
    if plant is MINIMUM_PHASE:
        assert (stability.verdict, g1 + g2 > 1) == (Verdict.STABLE, True)
        published = (-0.018, -0.060)
    else:
        assert (stability.verdict, g1 + g2 < 1) == (Verdict.UNSTABLE, True)
        assert stability.reason.startswith("non-minimum phase")
        published = (0.013, -0.057)
    # As published, for the measured levels.
    np.testing.assert_allclose(found, published, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_eigenvalues_of_linear_systems_are_their_invariant_zeros(seed):
    system = linear_system(seed, n=7 + seed % 3, m=seed % 3)
    dynamics = zero_dynamics(system)
    zeros = finite_zeros(system)
    assert zeros.shape == (dynamics.dimension,) == (system.num_states - 2 - seed % 3,)
    found = dynamics.eigenvalues(np.zeros(system.num_states))
    # The pencil's infinite zeros are defective and spoil the finite ones a little.
    assert_same_numbers(found, zeros, rtol=1e-7, atol=1e-7)
    assert np.all(np.diff(found.real) <= 0.0)
    stability = dynamics.stability()
    stable = np.max(zeros.real) < 0.0
    assert stability.verdict == (Verdict.STABLE if stable else Verdict.UNSTABLE)


def test_zeros_with_feedthrough():
    """z2 = L2 x + M2 v is met at once: r = (1, 1), mu = (1, 0)."""
    problem = PROBLEMS["linear"]()
    dynamics = zero_dynamics(problem.system)
    found = dynamics.eigenvalues(np.zeros(6))
    assert_same_numbers(found, finite_zeros(problem.system), rtol=1e-8)
    # Anywhere the outputs put it, too: the linear system at rest with outputs (0.3, -0.2).
    rest = dynamics.equilibrium([0.3, -0.2])
    np.testing.assert_allclose(problem.derivatives(rest), 0.0, atol=1e-12)
    assert_same_numbers(dynamics.eigenvalues(rest), found, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size"), [("two_link", 2), ("seven_joint", 7)])
def test_damped_flexible_joints_leave_their_deflections(name, size):
    """K d + D d' = tau: the eigenvalues of -D^-1 K, whatever links and motors do."""
    random = np.random.default_rng(1)

    def positive(scale: float) -> Array:
        root = np.eye(size) + 0.2 * random.normal(size=(size, size))
        return scale * root @ root.T

    stiffness, damping = positive(8000.0), positive(20.0)
    model = touching(name, [FlexibleJoints(stiffness, np.eye(size), damping)])
    dynamics = zero_dynamics(model.dae)
    assert dynamics.dimension == size
    stability = dynamics.stability()
    assert stability.verdict is Verdict.STABLE
    assert "minimum phase" in stability.reason
    expected = np.linalg.eigvals(-np.linalg.solve(damping, stiffness))
    # A state of 28 numbers, and forces that are differences of large ones.
    assert_same_numbers(stability.eigenvalues, expected + 0j, rtol=1e-8)
    rate, still = np.split(stability.state.reshape(4, size), 2)[0][1], stability.state[-size:]
    np.testing.assert_allclose([rate, still], 0.0, atol=1e-10)


def test_equilibrium_of_a_robot_against_multibody_plant():
    name, kind = "two_link", "damped"
    robot = actuated(name, kind)
    expected, _ = at_rest(name, kind, start_position(name), 25.0)
    found = ZeroDynamics(robot.structure.system, structure=robot.structure).equilibrium(
        [*OFFSET[name], 25.0]
    )
    # The plant and the library differ by round-off of forces of 100 N over stiffnesses of 5e3.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


def test_pendulum_on_a_cart_is_not_minimum_phase():
    """Upright +- sqrt(g/L); hanging +- i sqrt(g/L), or damped."""
    rate = np.sqrt(GRAVITY / 0.7)
    upright = zero_dynamics(cart_pendulum()).stability()
    # Rod and cart in Cartesian coordinates, ten operations.
    np.testing.assert_allclose(upright.eigenvalues, [rate, -rate], rtol=1e-10)
    assert upright.verdict is Verdict.UNSTABLE
    assert (
        "non-minimum phase: the largest real part of an eigenvalue is 3.744 1/s" in upright.reason
    )
    assert "at the equilibrium with the outputs s = 0.3" in upright.reason

    hanging = zero_dynamics(cart_pendulum(angle=np.pi)).stability()
    assert_same_numbers(hanging.eigenvalues, np.array([1j, -1j]) * rate, rtol=1e-10, atol=1e-10)
    assert hanging.verdict is Verdict.UNDECIDED
    assert "2 of 2 eigenvalues are on the imaginary axis" in hanging.reason

    # L a'' = -g a - d L a', found from a start beside it.
    swung = zero_dynamics(cart_pendulum(damping=0.8, angle=2.8)).stability()
    assert_same_numbers(swung.eigenvalues, np.roots([1.0, 0.8, rate**2]), rtol=1e-10)
    assert swung.verdict is Verdict.STABLE
    np.testing.assert_allclose(swung.state[:3], [0.3, 0.3, -0.7], rtol=0, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("epsilon", [0.01, 0.25, 4.0])
def test_the_aircraft_is_not_minimum_phase(epsilon):
    """eps a'' = sin a (Hauser, Sastry and Meyer, 1992, section 3)."""
    rate = 1 / np.sqrt(epsilon)
    stability = zero_dynamics(aircraft()).stability(parameters=[epsilon])
    np.testing.assert_allclose(stability.eigenvalues, [rate, -rate], rtol=1e-12)
    assert stability.verdict is Verdict.UNSTABLE
    # Upside down it is a center.
    down = zero_dynamics(aircraft()).stability([0, 0, 3.0, 0, 0, 0], [epsilon])
    np.testing.assert_allclose(down.state[2], np.pi, rtol=1e-10)
    assert down.verdict is Verdict.UNDECIDED


@pytest.mark.parametrize("damping", [0.0, 1e-6, 0.1, -1e-6])
def test_a_center_is_undecided_and_the_least_damping_is_not(damping):
    """2 q2'' + d q2' + 8 q2 = 8 q1."""
    dynamics = zero_dynamics(spring_masses(damping))
    stability = dynamics.stability([0.3, 0.2, 0.1, 0.1])
    np.testing.assert_allclose(stability.state, [0.3, 0.3, 0, 0], atol=1e-12)
    assert_same_numbers(
        stability.eigenvalues, np.roots([2.0, damping, 8.0]) + 0j, rtol=0, atol=1e-13
    )
    expected = {0.0: Verdict.UNDECIDED, -1e-6: Verdict.UNSTABLE}
    assert stability.verdict is expected.get(damping, Verdict.STABLE)


def test_slow_modes_beside_fast_ones_are_decided():
    """s1' = -1e5 s1, s2' = -1e-3 s2, coupled: eigenvalues eight orders apart."""
    system = DaeSystem.from_functions(
        3,
        f=lambda x: [0, -1e5 * x[1] + 3e4 * x[2], -1e-3 * x[2]],
        h=lambda x: [1, 2, 3],
        l=lambda x: x[0],
    )
    # z = x0, u = 0 at rest; u also moves x1, x2: x1' ... with u = r' = 0.
    stability = zero_dynamics(system).stability()
    np.testing.assert_allclose(stability.eigenvalues, [-1e-3, -1e5], rtol=1e-9)
    assert stability.verdict is Verdict.STABLE


def test_a_defective_zero_is_undecided():
    """s1' = s2, s2' = s3, s3' = 0 in turned coordinates: round-off alone moves it by 1e-5."""
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(4, 4)))[0]
    shift = np.zeros((4, 4))
    shift[1, 2] = shift[2, 3] = 1.0
    system = DaeSystem.from_functions(
        4,
        f=lambda x: turn @ shift @ turn.T @ x,
        h=lambda x: turn[:, 0],
        l=lambda x: ca.mtimes(turn[:, :1].T, x),
    )
    stability = zero_dynamics(system).stability()
    assert stability.verdict is Verdict.UNDECIDED
    np.testing.assert_allclose(stability.eigenvalues, 0.0, atol=1e-4)


@pytest.mark.slow
def test_eigenvalues_do_not_depend_on_units():
    system = cart_pendulum(0.3)
    random = np.random.default_rng(0)
    scales = [10.0 ** random.uniform(-3, 3, size) for size in (6, 1, 1, 1, 1)]
    found = zero_dynamics(in_other_units(system, *scales)).stability()
    expected = zero_dynamics(system).stability()
    np.testing.assert_allclose(found.eigenvalues, expected.eigenvalues, rtol=1e-8)
    assert found.verdict is expected.verdict is Verdict.UNSTABLE


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "chosen"),
    [
        (cart_pendulum(0.5), [-2.0, -3.0]),
        (cart_pendulum(0.5, np.pi), [-2.0, -3.0]),
        (aircraft(), [-2.0, -3.5]),
        (quadruple_tank(**NON_MINIMUM_PHASE), [-0.7]),
    ],
)
def test_the_closed_loop_has_the_poles_the_zero_dynamics_and_the_constraints(system, chosen):
    """The spectrum of f* + h* u(x) in all of R^n, with u of the law (28).

    It is that on N* - roots of (32) and zero dynamics - and, across N*, where L_f*^(r_i) k_i = 0,
    r_i zeros for each constraint.
    """
    dynamics = zero_dynamics(system)
    structure, degrees = dynamics.structure, dynamics.structure.output_degrees
    law = TrackingLaw(system, poles(chosen), structure=structure)
    rest = dynamics.stability()
    elimination = structure.elimination
    fields = ca.Function(
        "fields",
        [system.state, system.parameter_symbol],
        [ca.densify(elimination.f_star), ca.densify(elimination.h_star)],
    )
    held = [chain[0] for chain in structure.output_chains]
    outputs = ca.Function("outputs", [system.state], [ca.vertcat(*held)])
    values = np.array(outputs(rest.state))[:, 0]
    reference = np.concatenate(
        [[value, *np.zeros(degree)] for value, degree in zip(values, degrees, strict=True)]
    )

    def rate(x: Array) -> Array:
        f, h = (np.array(e) for e in fields(x, system.parameter_values))
        return f[:, 0] + h @ law.control(x, reference)

    step = 1e-4
    slope = np.array(
        [
            8 * (rate(rest.state + step * e) - rate(rest.state - step * e))
            - (rate(rest.state + 2 * step * e) - rate(rest.state - 2 * step * e))
            for e in np.eye(system.num_states)
        ]
    ).T / (12 * step)
    expected = np.concatenate(
        [
            np.repeat(chosen, len(degrees)),
            rest.eigenvalues,
            np.zeros(sum(structure.constraint_degrees)),
        ]
    )
    # Characteristic polynomials, as multiple roots are sensitive; differences are good to 1e-10.
    np.testing.assert_allclose(np.poly(slope), np.poly(expected).real, rtol=1e-6, atol=1e-7)


def test_eigenvalues_belong_to_equilibria():
    dynamics = zero_dynamics(cart_pendulum())
    with pytest.raises(
        ModelError, match=r"is no regular equilibrium: .*' = .*'equilibrium' finds one"
    ):
        dynamics.eigenvalues([0.0, 0.7 * np.sin(0.3), 0.7 * np.cos(0.3), 0, 0, 0])
    for off in ([0, 0, 0.8, 0, 0, 0], [0, 0, 0.7, 1.0, 1.0, 0]):
        with pytest.raises(ModelError, match="it is off N\\*, or its outputs change"):
            dynamics.eigenvalues(off)
    upright = [0.0, 0.0, 0.7, 0, 0, 0]
    assert dynamics.eigenvalues(upright)[0] == pytest.approx(np.sqrt(GRAVITY / 0.7), rel=1e-10)


def test_singular_states_are_named():
    """The arm stretched out, where its Jacobian is singular."""
    dynamics = zero_dynamics(free_arm())
    with pytest.raises(
        InconsistentStateError, match=r"lead to x = .* A\(x\) or B\(x\) is singular"
    ):
        dynamics.state([1.8, 0, 0, 0, 0, 0], np.zeros(4))
    with pytest.raises(ModelError, match=r"no regular equilibrium: A\(x\) or B\(x\) is singular"):
        dynamics.eigenvalues(np.zeros(4))
    # z' = (s + 1) u, s' = -1 - s: at rest with s = -1 nothing moves z.
    system = DaeSystem.from_functions(
        2, f=lambda x: [0, -1 - x[1]], h=lambda x: [1 + x[1], 0], l=lambda x: x[0]
    )
    stability = zero_dynamics(system).stability()
    assert stability.verdict is Verdict.UNDECIDED
    assert "A(x) or B(x) is singular" in stability.reason


def test_no_equilibrium_is_reported():
    """s' = 1 + s^2 has none, nor has a blade pinned to a speed; with speed 0 it has many."""
    dynamics = zero_dynamics(internal(lambda s, z: 1 + s**2))
    with pytest.raises(
        InconsistentStateError, match=r"z = 0 have no regular state at rest .* s' = "
    ) as e:
        dynamics.equilibrium([0.0])
    assert e.value.residual[1] >= 1.0
    # The motion from there, s = tan t, tells it.
    growing = dynamics.stability()
    assert growing.verdict is Verdict.UNSTABLE
    assert (growing.state, growing.eigenvalues.shape) == (None, (0,))
    assert "no regular state at rest" in growing.reason
    assert "the motion from there grows without bound" in growing.reason

    blade = zero_dynamics(PROBLEMS["knife_edge"]().system)
    with pytest.raises(InconsistentStateError, match=r"V = 0\.8 have no regular state at rest"):
        blade.equilibrium([0.3, 0.8])
    assert blade.stability().verdict is Verdict.UNDECIDED
    guess = np.array([2.0, -1.0, 0.1, 0.2, -0.1, 0.3])
    rest = blade.equilibrium([0.3, 0.0], guess)
    # Of the continuum (x, y) the one at the guess.
    np.testing.assert_allclose(rest, [2.0, -1.0, 0.3, 0.0, 0.0, 0.0], rtol=0, atol=1e-12)
    still = blade.stability(rest)
    assert still.verdict is Verdict.UNDECIDED
    np.testing.assert_allclose(still.eigenvalues, [0.0, 0.0], atol=1e-12)


def test_a_continuum_is_not_left_for_round_off():
    """z'' = u and s1' = s2' = 0 in turned coordinates: any (s1, s2) is at rest."""
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(4, 4)))[0]
    shift = np.zeros((4, 4))
    shift[0, 1] = 1.0
    system = DaeSystem.from_functions(
        4,
        f=lambda x: turn @ shift @ turn.T @ x,
        h=lambda x: turn[:, 1],
        l=lambda x: ca.mtimes(turn[:, :1].T, x),
        state_scale=np.ones(4),  # So that the nearest is that of the turned coordinates.
    )
    rest = zero_dynamics(system).equilibrium([0.7], turn @ [0.1, 0.2, 0.3, -0.4])
    np.testing.assert_allclose(turn.T @ rest, [0.7, 0.0, 0.3, -0.4], rtol=0, atol=1e-12)


def test_tension_as_output():
    """The pendulum with its tension held, by hand.

    At rest the control balances nothing: x = 0 is not regular, so it is held aside at angle a. With
    T = v L constant: m x'' = v x + u, m y'' = v y - m g on the circle; u makes v what it is. With a
    the angle from the vertical and w = -v L > 0: m L a'' = -m g sin a + u cos a and
    w = m L a'^2 + m g cos a + u sin a, so m L a'' = (w cos a - m g) / sin a - m L a'^2 / tan a.
    At rest cos a = m g/w, and the slope there is -w sin a/sin a = -w: m L a'' = -w (a - a_0).
    """
    problem = PROBLEMS["pendulum_tension"]()
    mass, length, gravity = 2.0, 0.8, 9.81
    dynamics, tension = zero_dynamics(problem.system), -30.0
    weight = -tension * length
    angle = np.arccos(mass * gravity / weight)
    rest = dynamics.equilibrium([tension])
    expected = [length * np.sin(angle), -length * np.cos(angle), 0.0, 0.0]
    np.testing.assert_allclose(rest, expected, rtol=0, atol=1e-11)
    rate = np.sqrt(weight / (mass * length))
    found = dynamics.eigenvalues(rest)
    assert_same_numbers(found, np.array([1j, -1j]) * rate, rtol=1e-9, atol=1e-9)
    # Without a given tension it is that of the equilibrium that is found.
    free = dynamics.stability()
    assert free.verdict is Verdict.UNDECIDED
    np.testing.assert_allclose(dynamics.eigenvalues(free.state).imag, free.eigenvalues.imag)


@pytest.mark.slow
def test_verdicts_on_known_systems(problem):
    stability = zero_dynamics(problem.system).stability()
    if problem.zero_dynamics == 0:
        assert stability.verdict is Verdict.STABLE
        assert stability.reason.startswith("no zero dynamics")
        assert (stability.state, stability.eigenvalues.shape) == (None, (0,))
    elif problem.minimum_phase is not None:
        assert (stability.verdict is Verdict.STABLE) == problem.minimum_phase
        assert stability.eigenvalues.shape == (problem.zero_dynamics,)


def test_an_equilibrium_without_zero_dynamics():
    dynamics = zero_dynamics(free_arm())
    rest = dynamics.equilibrium([1.2, 0.5], [0.2, 1.0, 0.3, 0.3])
    np.testing.assert_allclose(rest[2:], 0.0, atol=1e-14)
    assert dynamics.eigenvalues(rest).shape == (0,)


@pytest.mark.parametrize(
    ("columns", "where"),
    [
        (lambda x: [[1, 1], [1, 1]], ""),
        # x1 passes 0 among the states around (0, 0.05).
        (lambda x: [[x[1], 0], [0, 1]], r"x = \[.*, *-?[0-9.]+e-"),
    ],
)
def test_a_singular_b_leaves_undecided_what_has_no_zero_dynamics(columns, where):
    """Two outputs that move alike, and one that is not moved where x1 = 0: n = mu_1 + mu_2."""
    system = DaeSystem.from_functions(
        2, f=lambda x: [0, 0], h=columns, l=lambda x: [x[0], x[1]], nominal_state=[0.0, 0.05]
    )
    structure, violation = examine_structure(system, spread=0.1)
    assert violation is not None
    dynamics = ZeroDynamics(structure.system, structure=structure)
    assert dynamics.dimension == 0
    stability = dynamics.stability()
    assert (stability.verdict, stability.state) == (Verdict.UNDECIDED, None)
    assert re.search(r"B\(x\) of \(16\) is singular at " + where, stability.reason)


def slider() -> DaeSystem:
    """On a floor that pushes with v, and beside it xi' = xi (v - 40); z = (place, v)."""
    return DaeSystem.from_functions(
        ["x", "y", "vx", "vy", "xi"],
        f=lambda s: [s[2], s[3], 0, -9.81, -40 * s[4]],
        g=lambda s: [0, 0, 0, 1, s[4]],
        h=lambda s: [[0, 0], [0, 0], [1, 0], [0, 1], [0, 0]],
        k=lambda s: [s[1]],
        l=lambda s: [s[0], 0],
        m=lambda s: [[0], [1]],
        name="slider",
    )


@pytest.mark.slow
@pytest.mark.parametrize(("force", "rate"), [(20.0, -20.0), (80.0, 40.0)])
def test_the_force_that_is_asked_for_decides(force, rate):
    """The force is met at once, so that no state tells it: the eigenvalue is v - 40."""
    system = slider()
    structure = find_structure(system)
    dynamics = ZeroDynamics(structure.system, structure=structure)
    outputs = [0.0, force]
    rest = dynamics.equilibrium(outputs)
    assert dynamics.eigenvalues(rest, outputs=outputs) == pytest.approx([rate], rel=1e-9)
    verdict = dynamics.stability(outputs=outputs).verdict
    assert verdict is (Verdict.UNSTABLE if rate > 0 else Verdict.STABLE)
    told = analyze(
        system, reference=lambda t: np.array([0.0, 0.0, 0.0, force]), times=np.linspace(0, 0.1, 5)
    )
    assert told.zero_dynamics.verdict is verdict
    law = TrackingLaw(system, poles(-3.0), structure=structure)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make_closed_loop(
            DaePlant(structure.system, structure=structure), law, [ConstantReference(outputs)]
        )
    assert [w.category for w in caught] == [NonMinimumPhaseWarning] * (rate > 0)


def test_a_loop_is_judged_when_it_begins():
    """The force grows from 20 to 60 N in 2 s: unstable above 40 N."""
    law = TrackingLaw(slider(), poles(-3.0))
    force = ExpressionReference(lambda t: [20 + 20 * t])
    for start, unstable in ((0.0, False), (2.0, True)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            make_closed_loop(
                DaePlant(law.structure.system, structure=law.structure),
                law,
                [ConstantReference([0.0]), force],
                LoopSettings(start_time=start),
            )
        assert [w.category for w in caught] == [NonMinimumPhaseWarning] * unstable


@pytest.mark.parametrize(
    ("rate", "nominal"),
    [(lambda x: -(x**2), 0.1), (lambda x: ca.cos(x) - 1, 0.3), (lambda x: 0 * x, 0.2)],
)
def test_an_equilibrium_that_is_found_slowly_decides_nothing(rate, nominal):
    """Its eigenvalue is 0, and Newton's method ends where it is only near 0."""
    system = DaeSystem.from_functions(
        ["y", "xi"],
        f=lambda x: [0, rate(x[1])],
        h=lambda x: [1, 0],
        l=lambda x: [x[0]],
        nominal_state=[0.0, nominal],
    )
    assert ZeroDynamics(system).stability().verdict is Verdict.UNDECIDED


def test_a_zero_at_zero_of_a_linear_system_decides_nothing():
    """The zero is s = 0 exactly; what is left of it after cancellation is round-off."""
    a = [[0, 0, 0], [1, 0, 0], [0, 0, 1]]
    system = DaeSystem.from_functions(
        3,
        f=lambda x: ca.mtimes(ca.DM(a), x),
        h=lambda x: [[-2, 0], [2, 0], [0, 1]],
        l=lambda x: [2 * x[0], x[1] - 2 * x[2]],
    )
    assert ZeroDynamics(system).stability().verdict is Verdict.UNDECIDED


def test_rest_does_not_depend_on_the_unit_of_time():
    """An electrostatic actuator with its voltage held: a plate on a spring, modes of 2e4 1/s.

    Place, speed and charge in units of the gap, 0.1 m/s and q. What is left of x' where Newton's
    method ends is round-off of these, times the rates. At a voltage V the force is
    e V^2 / (2 (gap - x)^2), so that m s^2 + b s + k - e V^2 / (gap - x)^3 = 0.
    """
    mass, damping, stiffness, gap, e, resistance = 1e-9, 1e-6, 1.0, 2e-6, 8.85e-20, 1e3
    q = np.sqrt(2 * e * stiffness * 0.4 * gap)

    def force(x: ca.SX) -> ca.SX:
        return (q * x[2]) ** 2 / (2 * e) - 0.1 * damping * x[1] - stiffness * gap * x[0]

    system = DaeSystem.from_functions(
        3,
        f=lambda x: [
            0.1 * x[1] / gap,
            force(x) / mass / 0.1,
            -gap * x[2] * (1 - x[0]) / e / resistance,
        ],
        h=lambda x: [0, 0, 1 / resistance / q],
        l=lambda x: [q * gap * x[2] * (1 - x[0]) / e],
        nominal_state=[0.42, 0.0, 1.0],
    )
    stability = ZeroDynamics(
        find_structure(system, spread=[0.02, 0.01, 0.02]).system,
        structure=find_structure(system, spread=[0.02, 0.01, 0.02]),
    ).stability()
    assert stability.verdict is Verdict.UNSTABLE
    place, _, charge = stability.state
    voltage = q * gap * charge * (1 - place) / e
    softened = stiffness - e * voltage**2 / (gap * (1 - place)) ** 3
    expected = np.roots([mass, damping, softened])
    # The place is known to 1e-9 of the gap.
    np.testing.assert_allclose(np.sort(stability.eigenvalues.real), np.sort(expected), rtol=1e-8)


def test_a_clock_among_the_states_is_told():
    """A force beside c' = 1, held through a matrix whose round-off was divided by: z1 = 3e13."""
    system = DaeSystem.from_functions(
        ["x", "y", "vx", "vy", "c"],
        f=lambda s: [s[2], s[3], 0, 0, 1],
        g=lambda s: [0, 0, 0, 1, 0],
        h=lambda s: [[0, 0], [0, 0], [1, 0], [0, 1], [0, 0]],
        k=lambda s: [s[1] - ca.sin(s[4])],
        l=lambda s: [s[0], 0],
        m=lambda s: [[0], [1]],
        name="moved",
    )
    dynamics = ZeroDynamics(system)
    for outputs in (None, [0.0, 10.0]):
        stability = dynamics.stability(dynamics.structure.states[0], outputs=outputs)
        assert stability.verdict is Verdict.UNDECIDED
        assert "no state is at rest, since c' = 1" in stability.reason
        assert "z1" not in stability.reason


def test_a_constant_rate_that_something_steers_is_no_clock():
    """x' = 1 + u rests at u = -1, which keeps x, and xi' = -xi + x with it."""
    system = DaeSystem.from_functions(
        ["x", "xi"],
        f=lambda s: [1, s[0] - s[1]],
        h=lambda s: [1, 0],
        l=lambda s: [s[0]],
    )
    dynamics = ZeroDynamics(system)
    assert dynamics.stability(dynamics.structure.states[0]).verdict is Verdict.STABLE
