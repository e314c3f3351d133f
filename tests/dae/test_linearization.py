"""Linear models against each other by their transfer functions, and against closed forms."""

import numpy as np
import pytest
import scipy.linalg
from arms import arm, law
from problems import PROBLEMS, hanging_pendulum

from drake_dae.dae import (
    DaeSystem,
    Linearization,
    TrackingLaw,
    find_structure,
    linearize,
    linearize_loop,
    poles,
)

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
