import casadi as ca
import numpy as np
import pytest
from problems import PROBLEMS, closed_loop_outputs, double_integrator, reference_at, wanted_outputs
from runs import some

from drake_dae.dae import TrackingLaw, gain_coefficients, gain_matrices, poles


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
