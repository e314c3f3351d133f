"""Linear models against finite differences, transfer functions and closed forms."""

import numpy as np
import pytest
import scipy.linalg
from arms import arm, law
from problems import PROBLEMS, hanging_pendulum
from runs import some
from scipy.optimize import root

from drake_dae.dae import (
    DaeSystem,
    Linearization,
    Structure,
    TrackingLaw,
    find_structure,
    linearize,
    linearize_loop,
    poles,
)

Array = np.ndarray

FREQUENCIES = (0.3j, 2.0j, 17.0j, 1.0 + 0.5j)


def rate_and_output(structure: Structure, x: Array, u: Array) -> tuple[Array, Array]:
    """x' and z of the motion on N* by (9)-(12), (25), as the structure has them."""
    parts = structure.elimination
    values = []
    for constant, slope in ((parts.f_star, parts.h_star), (parts.l_star, parts.n_star)):
        numbers = [
            structure.trace("part", value.reshape((-1, 1)), False)(
                x, structure.system.parameter_values
            )[0]
            for value in (constant, slope)
        ]
        values.append(numbers[0] + numbers[1].reshape(u.size, -1).T @ u)
    return values[0], values[1]


def on_manifold(structure: Structure, x: Array, free: Array, values: Array) -> Array:
    """The state on N* with given values of some states, near a given one, by a solver of SciPy."""
    rest = np.setdiff1d(np.arange(x.size), free)

    def filled(others: Array) -> Array:
        full = x.copy()
        full[free], full[rest] = values, others
        return full

    if not rest.size:
        return filled(x[rest])
    found = root(lambda others: structure.manifold.residual(filled(others)), x[rest], tol=1e-13).x
    np.testing.assert_allclose(structure.manifold.residual(filled(found)), 0.0, atol=1e-12)
    return filled(found)


@pytest.mark.slow
@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("problem", some(PROBLEMS, of=3), indirect=True)
def test_the_minimal_form_is_that_of_finite_differences(problem, moving):
    """Central differences of the motion in the coordinates that were chosen, moving or not."""
    structure = problem.structure
    random = np.random.default_rng(1)
    x = problem.consistent(random) if moving else structure.states[0]
    u = random.standard_normal(problem.system.num_controls)
    found = linearize(problem.system, x, u, structure=structure)
    free, step = found.coordinates, 1e-6

    def motion(values: Array, control: Array) -> Array:
        rate, z = rate_and_output(structure, on_manifold(structure, x, free, values), control)
        return np.concatenate([rate[free], z])

    count = free.size
    np.testing.assert_allclose(
        motion(x[free], u)[:count],
        found.rate[free],
        rtol=1e-9,
        atol=1e-9 * np.abs(found.rate).max(),
    )
    by_state = [
        (motion(x[free] + step * e, u) - motion(x[free] - step * e, u)) / (2 * step)
        for e in np.eye(count)
    ]
    by_control = [
        (motion(x[free], u + step * e) - motion(x[free], u - step * e)) / (2 * step)
        for e in np.eye(u.size)
    ]
    expected = np.vstack(
        [np.array(by_state).reshape(count, count + u.size), np.array(by_control)]
    ).T
    model = found.minimal
    told = np.block([[model.A, model.B], [model.C, model.D]])
    # Round-off over the step, and the step squared times a third derivative.
    np.testing.assert_allclose(told, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())
    assert found.index == structure.index


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


@pytest.mark.parametrize("name", ["pendulum", "two_link_arm", "circuit", "flexible_pendulum"])
def test_a_closed_loop_follows_its_reference(name):
    """With r^(j) = s^j r the outputs are r, whatever the poles: the error (30) has no input."""
    system = PROBLEMS[name]().system
    tracking = TrackingLaw(system, poles(-3.0))
    layout = tracking.layout
    structure = tracking.structure
    chain = tracking.error_coordinates(structure.states[0], np.zeros(layout.reference_size))
    reference = np.zeros(layout.reference_size)
    reference[layout.chained] = chain
    # Constant outputs; where that is no rest, the motion with them is taken in its own right.
    found = linearize_loop(tracking, reference, structure.states[0])
    check_identity(found, layout.degrees)
    values = np.linalg.eigvals(found.minimal.A)
    # The error coordinates are coordinates of N* as well: the poles of (32) are among the rest.
    for degree in layout.degrees:
        if degree:
            assert np.sum(np.abs(values + 3.0) < 1e-3 * 3.0 ** (1 / degree)) >= 1


def check_identity(found: Linearization, degrees: tuple[int, ...]) -> None:
    for s in FREQUENCIES:
        powers = scipy.linalg.block_diag(
            *[np.array([[s**j] for j in range(degree + 1)]) for degree in degrees]
        )
        response = found.minimal.response(s) @ powers
        np.testing.assert_allclose(response, np.eye(len(degrees)), rtol=0, atol=1e-8)
