"""The coordinates (20)-(22) and their inverse, and linear models, by hand and by other routes."""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from actuated import actuated, states
from arms import arm, consistent_states, law, numbers
from problems import PROBLEMS, hanging_pendulum
from runs import some
from two_arms import two_arms

from drake_dae.dae import DaeSystem, NormalForm, find_structure, linearize
from drake_dae.errors import InconsistentStateError

ROBOTS = {
    "two_link": lambda: arm("two_link").structure,
    "seven_joint": lambda: arm("seven_joint").structure,
    "two_arms": lambda: find_structure(two_arms().dae),
    **{
        f"two_link {kind}": lambda kind=kind: actuated("two_link", kind).structure
        for kind in ("flexible", "damped", "motor", "hydraulic", "flexible motor")
    },
    "seven_joint damped": lambda: actuated("seven_joint", "damped").structure,
}


@cache
def form(name: str) -> NormalForm:
    structure = ROBOTS[name]() if name in ROBOTS else find_structure(PROBLEMS[name]().system)
    return NormalForm(structure.system, structure=structure)


@pytest.mark.slow
@pytest.mark.parametrize("name", some([*PROBLEMS, *ROBOTS], of=3))
@pytest.mark.equation(20, 24)
def test_phi_and_its_inverse_compose_to_the_identity(name):
    """Both ways, on N* and off it, from the nominal state as the guess."""
    normal_form = form(name)
    system, structure = normal_form.system, normal_form.structure
    random = np.random.default_rng(1)
    if name in PROBLEMS:
        found = [PROBLEMS[name]().consistent(random) for _ in range(4)]
    elif len(name.split()) > 1 and name.startswith("two_link"):
        found = list(states("two_link", name.removeprefix("two_link "), 4))
    else:
        found = list(structure.states[1:5])
    size = np.abs([*structure.states, *found]).max(axis=0)
    found += [x + 1e-2 * size * random.standard_normal(size.size) for x in found]
    for x in found:
        coordinates = normal_form.coordinates(x)
        back = normal_form.state(coordinates)
        scale = np.maximum(1.0, np.abs(x).max())
        # Round-off times the condition, which is highest (1e3) behind flexible joints and motors.
        np.testing.assert_allclose(back, x, rtol=0, atol=1e-12 * scale)
        again = normal_form.coordinates(back)
        np.testing.assert_allclose(
            again, coordinates, rtol=0, atol=1e-12 * max(1.0, np.abs(coordinates).max())
        )
    assert len(normal_form.coordinate_signals) == system.num_states


@pytest.mark.slow
@pytest.mark.equation(23, 26, 27)
def test_the_vector_field_in_the_coordinates_is_that_of_26(problem):
    """dPhi/dx (f + g v + h u): integrators, then a + B u by hand; y stays; v by hand.

    `rates` has the same of (zeta, xi).
    """
    system = problem.system
    normal_form = NormalForm(system)
    fields = ca.Function(
        "fields",
        [system.state, system.parameter_symbol],
        [ca.densify(e) for e in (system.f, system.g, system.h)],
    )
    random = np.random.default_rng(2)
    # Where the chains of constraints and of outputs end in (y, zeta, xi).
    ends = np.cumsum([*problem.constraint_degrees, *problem.output_degrees]) - 1
    m, dynamic = len(problem.constraint_degrees), np.flatnonzero(problem.output_degrees)
    constraint_ends, output_ends = ends[:m], ends[m:][dynamic]
    for _ in range(3):
        x, u = problem.consistent(random), random.standard_normal(system.num_controls)
        f, g, h = (np.array(e) for e in fields(x, system.parameter_values))
        known = problem.known(x)
        rate = f[:, 0] + g @ (known.alpha + known.beta @ u) + h @ u
        coordinates = normal_form.coordinates(x)
        moving = normal_form.jacobian(x) @ rate
        expected = np.roll(coordinates, -1)
        expected[constraint_ends] = 0.0
        highest = known.drift + known.control_matrix @ u
        expected[output_ends] = highest[dynamic]
        first_xi = system.num_states - problem.zero_dynamics
        scale = max(1.0, np.abs(moving).max())
        np.testing.assert_allclose(
            moving[:first_xi], expected[:first_xi], rtol=0, atol=1e-12 * scale
        )
        residual = problem.derivatives(x)
        np.testing.assert_allclose(coordinates[: residual.size], residual, atol=1e-13)
        found = normal_form.rates(x, u)
        np.testing.assert_allclose(found, moving[residual.size :], rtol=0, atol=1e-11 * scale)


@pytest.mark.parametrize("name", ["two_link", "seven_joint"])
@pytest.mark.equation(21, 50, 51, 52, 53)
def test_robot_coordinates_are_those_of_50_to_53(name):
    """phi, J qd, h_1, P qd from MultibodyPlant alone."""
    normal_form, wall = form(name), {"two_link": 1.2, "seven_joint": 0.7}[name]
    random = np.random.default_rng(4)
    for x in consistent_states(name, 3):
        x = x + 0.05 * random.standard_normal(x.size)  # Off N*, so that y is not zero.
        q, v = np.split(x, 2)
        n = numbers(name, q, v)
        tip = arm(name).plant.CreateDefaultContext()
        arm(name).plant.SetPositions(tip, q)
        pose = arm(name).plant.GetFrameByName("tool").CalcPoseInWorld(tip)
        y = [wall - pose.translation()[0], *(n.constraint_jacobian @ v)]
        zeta = np.column_stack([n.outputs, n.output_jacobian @ v]).reshape(-1)
        # A few hundred operations on numbers of order 1.
        np.testing.assert_allclose(
            normal_form.coordinates(x), [*y, *zeta], rtol=0, atol=1e-13 * max(1, *np.abs(x))
        )


@pytest.mark.equation(58)
def test_robot_inverse_is_58():
    """q = psi(xbar_1) by the model's own search; qd = Q xbar_2 with Q from MultibodyPlant."""
    for name in ("two_link", "seven_joint"):
        normal_form, model = form(name), arm(name).model
        for x in consistent_states(name, 3, seed=5):
            coordinates = normal_form.coordinates(x)
            zeta = coordinates[2:].reshape(-1, 2)
            state = normal_form.state(np.concatenate([[0.0, 0.0], zeta.reshape(-1)]))
            q = model.configuration(zeta[:, 0], np.split(model.dae.nominal_state, 2)[0])
            n = numbers(name, q, np.zeros_like(q))
            both = np.vstack([n.constraint_jacobian, n.output_jacobian])
            v = np.linalg.solve(both, [0.0, *zeta[:, 1]])
            # The configuration is found to 1e-10 or better.
            np.testing.assert_allclose(state, [*q, *v], rtol=0, atol=1e-9)


@pytest.mark.equation(22)
def test_chosen_completions_are_named_states():
    """The shafts' velocities behind damped joints, the knife edge's position."""
    expected = {
        "two_link damped": ["joint1_motor.velocity", "joint2_motor.velocity"],
        "knife_edge": ["x", "y"],
        "two_link": [],
    }
    for name, names in expected.items():
        normal_form = form(name)
        assert [s.name for s in normal_form.completion_signals] == names
        assert not normal_form.margin.is_singular
    signals = form("two_link damped").coordinate_signals
    assert [(s.name, s.unit) for s in signals[-2:]] == [
        ("joint1_motor.velocity", "rad/s"),
        ("joint2_motor.velocity", "rad/s"),
    ]


def test_coordinates_out_of_reach_are_named():
    normal_form = form("pendulum")
    with pytest.raises(InconsistentStateError) as info:
        normal_form.state([0.0, 0.0, 0.9, 0.0])
    assert info.value.residual[2] == pytest.approx(0.1, abs=1e-4)
    # Two links of 1 m reach at most sqrt(4 - 1.2^2) = 1.6 m high on the wall.
    with pytest.raises(InconsistentStateError, match=r"tool\.z.*1\.7"):
        form("two_link").state([0.0, 0.0, 1.7, 0.0])


Array = np.ndarray

FREQUENCIES = (0.3j, 2.0j, 17.0j, 1.0 + 0.5j)


def at_rest() -> list[tuple[str, DaeSystem, Array, Array]]:
    """Systems with a state and a control for which x' = 0, by hand."""
    found = []
    pendulum = hanging_pendulum(1.0)
    found.append(("pendulum", pendulum, np.array([0.0, -1.0, 0.0, 0.0]), np.zeros(1)))
    linear = PROBLEMS["linear"]().system
    found.append(("linear", linear, np.zeros(linear.num_states), np.zeros(2)))
    robot = arm("two_link")
    x = robot.structure.states[0].copy()
    x[robot.model.dae.num_states // 2 :] = 0.0
    x = robot.structure.manifold.project(x)
    still = np.zeros(robot.structure.layout.reference_size)
    tracking = law("two_link")
    chain = tracking.error_coordinates(x, still)
    still[tracking.layout.lowest[tracking.layout.dynamic]] = chain[tracking.layout.heads]
    still[tracking.layout.lowest[tracking.layout.direct]] = 7.0
    found.append(("two links", robot.model.dae, x, tracking.control(x, still)))
    return found


@pytest.mark.parametrize(("system", "x", "u"), [case[1:] for case in at_rest()])
def test_both_forms_have_the_same_transfer_functions(system, x, u):
    found = linearize(system, x, u)
    np.testing.assert_allclose(found.rate, 0.0, atol=1e-10)
    n, m = system.num_states, system.num_constraints
    assert found.descriptor.A.shape == (n + m, n + m)
    assert found.minimal.A.shape[0] == n - sum(find_structure(system).constraint_degrees)
    for s in FREQUENCIES:
        expected = found.descriptor.response(s)
        # Both are solved to round-off; the pencil of index 3 has a condition of up to 1e6.
        np.testing.assert_allclose(
            found.minimal.response(s), expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max()
        )
    names = [signal.name for signal in found.minimal.state_signals]
    assert names == [system.state_signals[i].name for i in found.coordinates]
